"""What the process has of the system: its three streams, whatever they are, and an end within seconds when asked."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from vvgt_cli.files import discard_leftovers
from vvgt_cli.progress import MessageStream

GRACE = 0.5  # seconds to end as an exception does, after which the process ends as it is
ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
heard: list[int] = []  # signals that have ended the present run; what is raised after one is its doing


def open_streams() -> None:
    """Put something where standard input, output or error are closed, and let talk fail unheard.

    Otherwise the next file that is opened would get their numbers, and what libraries print would end in it. Writing
    to a standard output that is closed fails, as it must.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_WRONLY if number == 2 else os.O_RDONLY)  # gets the lowest number that is free
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115 - lives as long as the process
    stderr: Any = MessageStream(sys.stderr)
    sys.stderr = stderr


def end_on_signals() -> None:
    """Let SIGTERM, SIGINT and SIGHUP (unless it is ignored, as under nohup) end the process as an exception does.

    A compiled kernel that is being called at that moment turns the exception into another, so the signal is noted in
    `heard` as well, and `vvgt_cli.cli.main.run` goes by that.
    Python runs handlers between two steps of its own, so that one second in a kernel would go by unanswered, or
    twenty. So another thread listens too: what has not ended after `GRACE` seconds ends without unwinding, its
    temporary files removed. Where somebody else has taken a signal over (training does), it is theirs.
    """
    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    if os.name == "posix":
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        threading.Thread(target=_listen, args=(reader,), daemon=True).start()


def ended_by(status: int) -> str | None:
    """Name of the signal that an exit status stands for, None where it is another's."""
    return next((signal.Signals(number).name for number in ENDING if status == 128 + number), None)


@contextmanager
def interruption(message: Callable[[str], None]) -> Iterator[Callable[[], bool]]:
    """Within the block a first interrupt (Ctrl-C) only makes the given function return True; a second one ends all."""
    stopped = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stopped.is_set  # handlers belong to the main thread
        return

    def note(number: int, frame: object) -> None:
        stopped.set()
        signal.signal(signal.SIGINT, before)
        message("interrupted: the result so far will be written; press Ctrl-C again to quit without saving")

    before = signal.signal(signal.SIGINT, note)
    try:
        yield stopped.is_set
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def ending() -> Iterator[list[int]]:
    """Within the block signals to end only put their number into the list: the step ends first, and is saved."""
    told: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield told  # handlers belong to the main thread
        return
    names = ("SIGTERM", "SIGINT", "SIGHUP")
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    numbers = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]  # as under nohup
    before = [signal.signal(number, lambda n, frame: told.append(n)) for number in numbers]
    try:
        yield told
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def first_of_group() -> bool:
    """Whether this process is the one that talks, of those that `torchrun` has started; alone it is."""
    return os.environ.get("RANK", "0") == "0" or "TORCHELASTIC_RUN_ID" not in os.environ


def _end(number: int, frame: object) -> None:
    heard.append(number)
    sys.exit(128 + number)


def _interrupt(number: int, frame: object) -> None:
    heard.append(number)
    raise KeyboardInterrupt


def _listen(reader: int) -> None:
    while numbers := os.read(reader, 64):
        for number in numbers:
            if number in ENDING and signal.getsignal(number) is _end:
                time.sleep(GRACE)
                _leave(number)


def _leave(number: int) -> None:
    discard_leftovers()
    if first_of_group():
        with suppress(OSError):
            os.write(2, f"vvgt: error: ended by {signal.Signals(number).name}\n".encode())
    os._exit(128 + number)
