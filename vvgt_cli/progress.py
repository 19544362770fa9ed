"""Messages of a run on standard error: a line for each stage, and progress bars on a terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, TextIO, TypeVar

T = TypeVar("T")
ProgressCallback = Callable[[int, int], None]
_WIDTH = 24  # characters of a bar
_INTERVAL = 0.1  # seconds between two drawings of a bar
_LINES = 30.0  # seconds between two lines without a terminal


def counted(items: Collection[T], progress: ProgressCallback | None) -> Iterator[T]:
    """Yield items, and call ``progress(done, all)`` behind the work on each."""
    for done, item in enumerate(items, 1):
        yield item
        if progress:
            progress(done, len(items))


class MessageStream:
    """A text stream that never fails: on a full disk or a closed pipe messages are lost, but no work."""

    def __init__(self, stream: TextIO) -> None:
        """Wrap ``stream``."""
        self._stream = stream

    def write(self, text: str) -> int:
        """Write text if possible, and return its length."""
        with suppress(OSError, ValueError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream if possible."""
        with suppress(OSError, ValueError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        """Return other attributes of the stream."""
        return getattr(self._stream, name)


@contextmanager
def uninterrupted(message: Callable[[str], None]) -> Iterator[Callable[[], bool]]:
    """Leave interrupts as they are within the block; the yielded function returns False."""
    yield lambda: False


Interruption = Callable[[Callable[[str], None]], AbstractContextManager[Callable[[], bool]]]


class Once:
    """Messages, each shown once, whatever it is about: the name before the first ": " does not count."""

    def __init__(self) -> None:
        """Start without messages."""
        self._said: dict[str, tuple[str, int]] = {}

    def first(self, line: str) -> bool:
        """Return whether a message is new, and count it."""
        _, _, text = line.partition(": ")
        first, count = self._said.get(text or line, (line, 0))
        self._said[text or line] = first, count + 1
        return not count

    def repeated(self) -> list[str]:
        """Return a line for each message that came again: its beginning as it first came, and how often it came."""
        said = ((first.partition("; ")[0], count) for first, count in self._said.values())
        return [f"{first}: {count} times in all" for first, count in said if count > 1]


@dataclass
class Console:
    """Messages on standard error; standard output is for data.

    Attributes:
        quiet: print nothing (errors are printed by the command line itself).
        stream: destination, standard error by default.
        interruption: takes a function that prints a line, and returns a context manager within which a first Ctrl-C
            makes the yielded function return True; only the command line sets one, as libraries install no handlers.
        once: messages so far, where each is shown once, as those of a batch are; None to show all.
    """

    quiet: bool = False
    stream: TextIO = field(default_factory=lambda: sys.stderr)
    interruption: Interruption = uninterrupted
    once: Once | None = None

    def message(self, line: str) -> None:
        """Print one line, once of all items of a batch; lines that tell of the work done are `progress`."""
        if self.once is None or self.once.first(line):
            self.progress(line)

    def progress(self, line: str) -> None:
        """Print one line, as often as it comes; line breaks within it, as in a file's name, become blanks."""
        if not self.quiet:
            print(" ".join(line.splitlines()), file=self.stream, flush=True)

    def stage(self, name: str, seconds: float, detail: str = "") -> None:
        """Print the line of a stage: name, wall seconds and details."""
        self.progress(f"{name:<16}{seconds:8.2f} s  {detail}".rstrip())

    def bar(self, label: str) -> ProgressCallback | None:
        """Return a callback ``(done, total)`` that draws a bar, or without a terminal prints a line at times."""
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
                    self.progress(f"{label:<16}{now - start:8.2f} s  {100 * done / total:.0f} %")
                return
            if done >= total:
                self.stream.write("\r\x1b[K")  # the line of the stage follows
            elif now - last >= _INTERVAL:
                last = now
                filled = "#" * (_WIDTH * done // max(total, 1))
                self.stream.write(f"\r{label:<16}[{filled:<{_WIDTH}}] {done}/{total} {now - start:6.1f} s\x1b[K")
            self.stream.flush()

        return draw
