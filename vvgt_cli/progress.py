"""What a run says on standard error: one line a stage, and bars where someone is watching."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TextIO

ProgressCallback = Callable[[int, int], None]
_WIDTH = 24  # characters of a bar
_INTERVAL = 0.1  # seconds between two drawings of a bar


@dataclass
class Console:
    """Talk on standard error; standard output is for data.

    Attributes:
        quiet: say nothing (errors are printed by the command line itself).
        stream: where to; standard error unless told otherwise.
    """

    quiet: bool = False
    stream: TextIO = field(default_factory=lambda: sys.stderr)

    def say(self, line: str) -> None:
        """Print one line: what separates lines in it (in the name of a file, say) becomes a blank."""
        if not self.quiet:
            print(" ".join(line.splitlines()), file=self.stream, flush=True)

    def stage(self, name: str, seconds: float, detail: str = "") -> None:
        """Print a stage's line: name, wall seconds, and what there is to say about it."""
        self.say(f"{name:<16}{seconds:8.2f} s  {detail}".rstrip())

    def bar(self, label: str) -> ProgressCallback | None:
        """A callback ``(done, total)`` that draws a bar, or None where the stream is not a terminal."""
        if self.quiet or not self.stream.isatty():
            return None
        start = last = time.monotonic()

        def draw(done: int, total: int) -> None:
            nonlocal last
            now = time.monotonic()
            if done >= total:
                self.stream.write("\r\x1b[K")  # the stage's line follows
            elif now - last >= _INTERVAL:
                last = now
                filled = "#" * (_WIDTH * done // max(total, 1))
                self.stream.write(f"\r{label:<16}[{filled:<{_WIDTH}}] {done}/{total} {now - start:6.1f} s\x1b[K")
            self.stream.flush()

        return draw
