"""What a run says on standard error: one line a stage, and bars where someone is watching."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, TextIO

ProgressCallback = Callable[[int, int], None]
_WIDTH = 24  # characters of a bar
_INTERVAL = 0.1  # seconds between two drawings of a bar
_LINES = 30.0  # seconds between two lines where nobody watches


class MessageStream:
    """A text stream of messages that never fails: on a full disk or a closed pipe they are lost, the work is not."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        with suppress(OSError, ValueError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def uninterrupted(say: Callable[[str], None]) -> Iterator[Callable[[], bool]]:
    """A block in which interrupts are what they always are."""
    yield lambda: False


Interruption = Callable[[Callable[[str], None]], AbstractContextManager[Callable[[], bool]]]


@dataclass
class Console:
    """Messages on standard error; standard output is for data.

    Attributes:
        quiet: say nothing (errors are printed by the command line itself).
        stream: where to; standard error unless told otherwise.
        interruption: given what says a line, a block within which a first interrupt makes its function return True; the
            command line's, since handlers of signals are the program's and not a library's.
    """

    quiet: bool = False
    stream: TextIO = field(default_factory=lambda: sys.stderr)
    interruption: Interruption = uninterrupted

    def message(self, line: str) -> None:
        """Print one line: what separates lines in it (in the name of a file, say) becomes a blank."""
        if not self.quiet:
            print(" ".join(line.splitlines()), file=self.stream, flush=True)

    def stage(self, name: str, seconds: float, detail: str = "") -> None:
        """Print a stage's line: name, wall seconds, and what there is to say about it."""
        self.message(f"{name:<16}{seconds:8.2f} s  {detail}".rstrip())

    def bar(self, label: str) -> ProgressCallback | None:
        """A callback ``(done, total)`` that draws a bar, or where no terminal is says a line every half minute."""
        if self.quiet:
            return None
        terminal = self.stream.isatty()
        start = last = time.monotonic()

        def draw(done: int, total: int) -> None:
            nonlocal last
            now = time.monotonic()
            if not terminal:
                if done < total and now - last >= _LINES:
                    last = now
                    self.message(f"{label:<16}{now - start:8.2f} s  {100 * done / total:.0f} %")
                return
            if done >= total:
                self.stream.write("\r\x1b[K")  # the stage's line follows
            elif now - last >= _INTERVAL:
                last = now
                filled = "#" * (_WIDTH * done // max(total, 1))
                self.stream.write(f"\r{label:<16}[{filled:<{_WIDTH}}] {done}/{total} {now - start:6.1f} s\x1b[K")
            self.stream.flush()

        return draw
