"""Who does the tasks: this process, processes of this machine, or a Dask cluster."""

from __future__ import annotations

import os
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from threading import Thread
from typing import TYPE_CHECKING, Any, Protocol, Self

from vvgt_cli.errors import DataError
from vvgt_cli.files import discard_leftovers

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing.connection import Connection

Progress = Callable[[int, int], None]
IDLE = 3  # pools that broke one after the other without a block done: it is not chance


class Task(Protocol):
    """Does one block and leaves its part, of a kind."""

    @property
    def kind(self) -> str: ...

    def __len__(self) -> int: ...

    def __call__(self, number: int) -> None: ...


class Runner(Protocol):
    """Does tasks, each at least once; ``workers`` are at work at once. A context: with it ends what was started."""

    @property
    def workers(self) -> int: ...

    def __enter__(self) -> Any: ...

    def __exit__(self, *error: object) -> None: ...

    def run(self, task: Task, numbers: Sequence[int], progress: Progress | None) -> None: ...


class Alone:
    """A runner of which nothing is left between two passes."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None: ...


class InProcess(Alone):
    """One block after the other, in this process."""

    workers = 1

    def run(self, task: Task, numbers: Sequence[int], progress: Progress | None) -> None:
        """Do the tasks in the order of ``numbers``."""
        for done, number in enumerate(numbers, 1):
            task(number)
            if progress:
                progress(done, len(numbers))


def _begin(threads: int, alive: Connection) -> None:
    """Before a process imports its kernels: how many threads they have; what is to be said the first process says."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    os.environ["NUMBA_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = str(threads)
    Thread(target=_end, args=(alive,), daemon=True).start()


def _end(alive: Connection) -> None:
    """End, within a block too, when the other end is closed: by the first process, or because that has ended."""
    with suppress(OSError):
        alive.poll(None)
    discard_leftovers()
    os._exit(1)


@contextmanager
def _deaf() -> Iterator[None]:
    """Processes begun within hear no interrupt, which a terminal sends to all; the first one does, afterwards."""
    mask = getattr(signal, "pthread_sigmask", lambda *_: ())
    before = mask(getattr(signal, "SIG_BLOCK", 0), {signal.SIGINT})
    try:
        yield
    finally:
        mask(getattr(signal, "SIG_SETMASK", 0), before)


class Processes:
    """Processes of this machine, kept for all passes; what a killed one had begun is begun anew by others."""

    def __init__(self, workers: int, threads: int) -> None:
        """Of ``threads`` in all."""
        self.workers, self.threads = workers, max(threads // workers, 1)
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=error[0] is None, cancel_futures=True)
            self._alive.close()
            self._pool = None

    def run(self, task: Task, numbers: Sequence[int], progress: Progress | None) -> None:
        """Do the tasks.

        Raises:
            DataError: processes end again and again without a block done.
        """
        from concurrent.futures import ProcessPoolExecutor, as_completed
        from concurrent.futures.process import BrokenProcessPool

        left, idle = list(numbers), 0 if self._pool is None else -1  # that of an earlier pass may have broken since
        while left:
            before = len(left)
            if self._pool is None:
                context = get_context("spawn")
                reader, self._alive = context.Pipe(duplex=False)
                self._pool = ProcessPoolExecutor(self.workers, context, _begin, (self.threads, reader))
            try:
                with _deaf():
                    waiting = {self._pool.submit(task, number): number for number in left}
                for future in as_completed(waiting):
                    future.result()
                    left.remove(waiting[future])
                    if progress:
                        progress(len(numbers) - len(left), len(numbers))
            except BrokenProcessPool:
                self.__exit__(None)
                idle = idle + 1 if len(left) == before else 0
            except BaseException as error:
                self.__exit__(error)
                raise
            if idle >= IDLE:
                raise DataError(
                    f"worker processes were ended {IDLE} times without a block done (out of memory?); try --blocks "
                    "with a smaller size, fewer --workers, or more --memory"
                )
