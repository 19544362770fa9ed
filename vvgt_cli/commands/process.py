"""Standard streams and signals of the process: streams that may be closed, and an exit within seconds of a signal."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

from vvgt_cli.files import discard_leftovers
from vvgt_cli.progress import MessageStream

GRACE = 0.5  # seconds to end as an exception does, after which the process ends as it is
ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
received: list[int] = []  # signals that ended the current run; later exceptions are their effect


def open_streams() -> None:
    """Replace closed standard streams, and ignore failures to write messages.

    Otherwise the next opened file would get a standard stream's number, and printed text would end up in it. Writing to
    a closed standard output still fails.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_WRONLY if number == 2 else os.O_RDONLY)  # gets the lowest number that is free
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115 - lives as long as the process
    if os.name == "nt" and hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(encoding="utf-8", newline="\n")  # a pipe would get the system's code page
    stderr: Any = MessageStream(sys.stderr)
    sys.stderr = stderr


def end_on_signals() -> None:
    """Make SIGTERM, SIGINT and SIGHUP (unless ignored, as under nohup) end the process like an exception.

    A compiled kernel that is running may replace the exception, so the signal is also recorded in `received`, which
    `vvgt_cli.commands.main.run` reads.

    Python runs signal handlers between its own instructions, so a long kernel would delay them. A second thread
    therefore ends a process that has not ended after `GRACE` seconds, without unwinding but without temporary files
    left. Signals that other code handles (training does) are left to it.
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


def leave(status: int) -> NoReturn:
    """End the process with a status, without freeing its objects one by one, which takes 0.3 s after a conversion.

    Functions registered with `atexit` run, and standard streams are flushed; other open files are not. A process with
    other threads to wait for ends as usual.
    """
    if all(thread.daemon for thread in threading.enumerate() if thread is not threading.main_thread()):
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)
    sys.exit(status)


@contextmanager
def interruption(message: Callable[[str], None]) -> Iterator[Callable[[], bool]]:
    """Make the first interrupt (Ctrl-C) in the block only set the yielded function's result; a second one raises."""
    stopped = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stopped.is_set  # handlers belong to the main thread
        return

    def note(number: int, frame: object) -> None:
        stopped.set()
        signal.signal(signal.SIGINT, before)
        message("interrupted: saving the result so far; press Ctrl-C again to quit without saving")

    before = signal.signal(signal.SIGINT, note)
    try:
        yield stopped.is_set
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def ending() -> Iterator[list[int]]:
    """Yield a list that receives the number of a signal to end, so that the current step can finish and be saved."""
    caught: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield caught  # handlers belong to the main thread
        return
    names = ("SIGTERM", "SIGINT", "SIGHUP")
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    numbers = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]  # as under nohup
    before = [signal.signal(number, lambda n, frame: caught.append(n)) for number in numbers]
    try:
        yield caught
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def first_of_group() -> bool:
    """Return whether this process prints for those that `torchrun` started; true for a single process."""
    return os.environ.get("RANK", "0") == "0" or "TORCHELASTIC_RUN_ID" not in os.environ


def _end(number: int, frame: object) -> None:
    received.append(number)
    sys.exit(128 + number)


def _interrupt(number: int, frame: object) -> None:
    received.append(number)
    raise KeyboardInterrupt


def _listen(reader: int) -> None:
    while numbers := os.read(reader, 64):
        for number in numbers:
            if number in ENDING and signal.getsignal(number) is _end:
                time.sleep(GRACE)
                _exit_now(number)


def _exit_now(number: int) -> None:
    discard_leftovers()
    if first_of_group():
        with suppress(OSError):
            os.write(2, f"vvgt: error: ended by {signal.Signals(number).name}\n".encode())
    os._exit(128 + number)
