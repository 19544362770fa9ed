"""Who does the tasks: this process, processes of this machine, or a Dask cluster."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from multiprocessing import get_context, parent_process
from threading import Thread
from typing import TYPE_CHECKING, Any, Protocol, Self

from vvgt_cli.errors import DataError

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor

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


class Here(Alone):
    """One block after the other, in this process."""

    workers = 1

    def run(self, task: Task, numbers: Sequence[int], progress: Progress | None) -> None:
        """Do the tasks in the order of ``numbers``."""
        for done, number in enumerate(numbers, 1):
            task(number)
            if progress:
                progress(done, len(numbers))


def _begin(threads: int) -> None:
    """Before a process imports its kernels: how many threads they have; what is to be said the first process says."""
    warnings.simplefilter("ignore")
    os.environ["NUMBA_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = str(threads)
    Thread(target=_end, daemon=True).start()


def _end() -> None:
    """End with the process that has started this one, however that ends."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


class Processes:
    """Processes of this machine, of use to all passes; what a killed one had begun is begun anew by others."""

    def __init__(self, workers: int, threads: int) -> None:
        """Of ``threads`` in all."""
        self.workers, self.threads = workers, max(threads // workers, 1)
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=error[0] is None, cancel_futures=True)
            self._pool = None

    def run(self, task: Task, numbers: Sequence[int], progress: Progress | None) -> None:
        """Do the tasks.

        Raises:
            DataError: processes end again and again without a block done.
        """
        from concurrent.futures import ProcessPoolExecutor, as_completed
        from concurrent.futures.process import BrokenProcessPool

        left, idle = list(numbers), 0
        while left:
            before = len(left)
            if self._pool is None:
                self._pool = ProcessPoolExecutor(self.workers, get_context("spawn"), _begin, (self.threads,))
            try:
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
