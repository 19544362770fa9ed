"""Blocks on Dask's workers: of this machine, or of a scheduler that is there already."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from vvgt_cli.errors import DataError
from vvgt_cli.scale.runners import Progress, Task

TRIES = 3  # of a block whose worker was lost
WAIT = "15s"  # for a scheduler to answer


def _need(name: str) -> Any:
    """A package of the extra `cluster`.

    Raises:
        DataError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise DataError(f"--scheduler: {name} is not installed; try: pip install 'vvgt[cluster]'") from None


class Dask:
    """See the module.

    Attributes:
        workers: that are asked for.
    """

    def __init__(self, scheduler: str, workers: int, threads: int) -> None:
        """``scheduler`` is "local" or an address; ``threads`` of all local workers.

        Raises:
            DataError: Dask is not installed.
        """
        _need("distributed")
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # errors are lines of our own
        self._scheduler, self.workers = scheduler, workers
        self._threads = max(threads // workers, 1)

    def run(self, task: Task, numbers: Sequence[int], progress: Progress | None) -> None:
        """Do the tasks; those of a worker that was lost are done anew, by another.

        Raises:
            DataError: no scheduler, or workers that are lost again and again.
        """
        if not numbers:
            return
        distributed = _need("distributed")
        with self._client() as client:
            futures = client.map(task, list(numbers), retries=TRIES, pure=False)
            try:
                for done, future in enumerate(distributed.as_completed(futures), 1):
                    future.result()
                    if progress:
                        progress(done, len(numbers))
            except distributed.KilledWorker as error:
                raise DataError(
                    f"workers were ended {TRIES} times at one block (out of memory?); try --blocks with a smaller size"
                ) from error

    @contextmanager
    def _client(self) -> Iterator[Any]:
        """A client of the scheduler; what was started for it ends with the block."""
        distributed = _need("distributed")
        if self._scheduler != "local":
            try:
                client = distributed.Client(self._scheduler, timeout=WAIT)
            except (OSError, ValueError) as error:
                raise DataError(
                    f"--scheduler {self._scheduler}: no Dask scheduler answers there; start one with 'dask scheduler' "
                    "(it says its address), or try --scheduler local"
                ) from error
            with client:
                yield client
            return
        with self._cluster() as cluster, distributed.Client(cluster) as client:
            yield client

    def _cluster(self) -> Any:
        dask = _need("dask")
        threads = {name: str(self._threads) for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
        dask.config.set({"distributed.nanny.pre-spawn-environ": threads})
        return _need("distributed").LocalCluster(
            n_workers=self.workers, threads_per_worker=1, dashboard_address=None, memory_limit=0,
            silence_logs=logging.CRITICAL,
        )  # fmt: skip
