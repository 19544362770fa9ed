"""Runners of tasks: this process, or worker processes of this machine."""

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
IDLE = 3  # consecutive pools that broke without finishing a block


class Task(Protocol):
    """A task that processes blocks one by one, and saves results of one kind."""

    @property
    def kind(self) -> str:
        """Kind of the results."""

    def __len__(self) -> int:
        """Return the number of blocks."""

    def __call__(self, number: int) -> None:
        """Process block ``number`` and save its result."""


class Runner(Protocol):
    """A runner that processes each block at least once, and the context of its workers."""

    @property
    def workers(self) -> int:
        """Number of workers that run in parallel."""

    def __enter__(self) -> Any:
        """Return the runner."""

    def __exit__(self, *error: object) -> None:
        """End the workers."""

    def run(self, task: Task, numbers: Sequence[int], progress: Progress | None) -> None:
        """Process the blocks ``numbers``."""


class InProcess:
    """A runner that processes one block after the other in this process."""

    workers = 1

    def __enter__(self) -> Self:
        """Return the runner."""
        return self

    def __exit__(self, *error: object) -> None:
        """Do nothing: there are no workers."""

    def run(self, task: Task, numbers: Sequence[int], progress: Progress | None) -> None:
        """Process blocks in the order of ``numbers``."""
        for done, number in enumerate(numbers, 1):
            task(number)
            if progress:
                progress(done, len(numbers))


def _start_worker(threads: int, alive: Connection) -> None:
    """Set up a worker before it imports kernels: their threads, and no warnings, which the parent process prints."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    os.environ["NUMBA_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = str(threads)
    Thread(target=_exit_with_parent, args=(alive,), daemon=True).start()


def _exit_with_parent(alive: Connection) -> None:
    """Exit, even within a block, when the parent process closes its end of the pipe or dies."""
    with suppress(OSError):
        alive.poll(None)
    discard_leftovers()
    os._exit(1)


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block the interrupt signal, which terminals send to all processes, in processes started within the context."""
    mask = getattr(signal, "pthread_sigmask", lambda *_: ())
    before = mask(getattr(signal, "SIG_BLOCK", 0), {signal.SIGINT})
    try:
        yield
    finally:
        mask(getattr(signal, "SIG_SETMASK", 0), before)


class Processes:
    """A pool of worker processes for all passes; blocks of a killed worker are repeated by others."""

    def __init__(self, workers: int, threads: int) -> None:
        """Share ``threads`` among ``workers``."""
        self.workers, self.threads = workers, max(threads // workers, 1)
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        """Return the runner."""
        return self

    def __exit__(self, *error: object) -> None:
        """End the pool, without waiting for it after an error."""
        if self._pool is not None:
            self._pool.shutdown(wait=error[0] is None, cancel_futures=True)
            self._alive.close()
            self._pool = None

    def run(self, task: Task, numbers: Sequence[int], progress: Progress | None) -> None:
        """Process the blocks ``numbers``.

        Raises:
            DataError: workers are killed repeatedly without finishing a block.
        """
        from concurrent.futures import ProcessPoolExecutor, as_completed
        from concurrent.futures.process import BrokenProcessPool

        left, idle = list(numbers), 0 if self._pool is None else -1  # an earlier pass's pool may have broken since
        while left:
            before = len(left)
            if self._pool is None:
                context = get_context("spawn")
                reader, self._alive = context.Pipe(duplex=False)
                self._pool = ProcessPoolExecutor(self.workers, context, _start_worker, (self.threads, reader))
            try:
                with _interrupts_blocked():
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
                    f"workers were killed {IDLE} times before finishing a block (out of memory?); try --blocks "
                    "with a smaller size, fewer --workers, or more --memory"
                )
