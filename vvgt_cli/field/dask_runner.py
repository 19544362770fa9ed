"""Blocks on Dask's workers: of this machine, of a scheduler that is there already, or of jobs under SLURM."""

from __future__ import annotations

import importlib
import logging
import os
import shutil
import subprocess
import threading
from collections.abc import Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, suppress
from typing import Any

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.runners import Progress, Task
from vvgt_cli.resources import memory_limit

LOCAL, SLURM = "local", "slurm"
AGAIN = 30.0  # seconds until a job that has ended is followed by another
ANSWER = 120.0  # seconds for SLURM to answer
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
    """See the module. A context: workers that are started for it stay from pass to pass, and end with it.

    Attributes:
        workers: that are asked for.
    """

    def __init__(self, scheduler: str, workers: int, threads: int) -> None:
        """``scheduler`` is "local", "slurm" or an address; ``threads`` of all local workers, or of each job.

        Raises:
            DataError: Dask is not installed, or SLURM.
            UsageError: jobs without a size of memory.
        """
        _need("distributed")
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # errors are lines of our own
        self._scheduler, self.workers, self._threads = scheduler, workers, threads
        self._stack, self._client = ExitStack(), None
        self._futures: Sequence[Any] = ()
        self._lost: str | None = None  # why no worker will come any more
        if scheduler == SLURM:
            _need("dask_jobqueue")
            if shutil.which("sbatch") is None:
                raise DataError(
                    "--scheduler slurm: there is no sbatch here; run it on a node that submits jobs, or try local"
                )
            if memory_limit() is None:
                raise UsageError("--scheduler slurm: give --memory, which every job asks for, as --memory 16G")

    def __enter__(self) -> Dask:
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def run(self, task: Task, numbers: Sequence[int], progress: Progress | None) -> None:
        """Do the tasks; those of a worker that was lost are done anew, by another.

        Raises:
            DataError: no scheduler, jobs that are refused or have all ended, or workers that are lost again and again.
        """
        if not numbers:
            return
        distributed = _need("distributed")
        client = self._client = self._client or self._connected()
        futures = self._futures = client.map(task, list(numbers), retries=TRIES, pure=False)
        try:
            for done, future in enumerate(distributed.as_completed(futures, loop=client.loop), 1):
                future.result()
                if progress:
                    progress(done, len(numbers))
        except distributed.KilledWorker as error:
            raise DataError(
                f"workers were ended {TRIES} times at one block (out of memory?); try --blocks with a smaller size"
            ) from error
        except CancelledError:
            told = f"--scheduler {self._scheduler}: it has ended, or cancelled the blocks; the same command goes on"
            raise DataError(self._lost or told) from None

    def _connected(self) -> Any:
        """A client of the scheduler; what is started for it ends with the context."""
        distributed = _need("distributed")
        if self._scheduler in (LOCAL, SLURM):
            cluster = self._stack.enter_context(self._local() if self._scheduler == LOCAL else self._jobs())
            if self._scheduler == SLURM:
                self._keep(cluster)
            return self._stack.enter_context(distributed.Client(cluster, set_as_default=False))
        try:
            client = distributed.Client(self._scheduler, timeout=WAIT, set_as_default=False)
        except (OSError, ValueError) as error:
            raise DataError(
                f"--scheduler {self._scheduler}: no Dask scheduler answers there; start one with 'dask scheduler' "
                "(it says its address), or try --scheduler local"
            ) from error
        return self._stack.enter_context(client)

    def _local(self) -> Any:
        dask = _need("dask")
        threads = _environment(max(self._threads // self.workers, 1))
        dask.config.set({"distributed.nanny.pre-spawn-environ": threads})
        return _need("distributed").LocalCluster(
            n_workers=self.workers, threads_per_worker=1, dashboard_address=None, memory_limit=0,
            silence_logs=logging.CRITICAL,
        )  # fmt: skip

    def _jobs(self) -> Any:
        """One worker a job; account, partition and time are those of Dask's own settings, `jobqueue.slurm`.

        Raises:
            DataError: a job is refused, or SLURM does not answer.
        """
        jobqueue = _need("dask_jobqueue")
        try:
            cluster = jobqueue.SLURMCluster(
                job_name="vvgt-blocks", processes=1, cores=1, job_cpu=self._threads, memory=f"{memory_limit()}B",
                job_script_prologue=[f"export {name}={n}" for name, n in _environment(self._threads).items()],
                worker_extra_args=["--memory-limit", "0"], silence_logs=logging.CRITICAL,
                scheduler_options={"dashboard_address": None},
            )  # fmt: skip
        except (OSError, RuntimeError, TypeError, ValueError) as error:
            raise DataError(f"--scheduler slurm: {error}; settings are those of jobqueue.slurm in Dask's") from error
        try:
            tried = _asked(["sbatch", "--test-only"], cluster.job_script())
        except subprocess.TimeoutExpired:
            cluster.close()
            raise DataError(f"--scheduler slurm: sbatch does not answer within {ANSWER:g} s; try later") from None
        if tried.returncode:
            cluster.close()
            said = [line.strip() for line in tried.stderr.splitlines() if line.strip()] or ["no reason given"]
            why = next((line for line in said if "error" in line.lower()), said[-1])
            raise DataError(
                f"--scheduler slurm: sbatch refuses the job ({why}); account, partition and time are those of "
                "jobqueue.slurm in Dask's settings"
            )
        return cluster

    def _keep(self, cluster: Any) -> None:
        """Ask for the jobs, and again for those that have ended, until the context does.

        Where all have ended and no worker answers, the tasks are cancelled. A job that ends before its worker has
        answered is followed by another, `TRIES` times for each that was asked for.
        """
        cluster.scale(jobs=self.workers)
        over = threading.Event()

        async def again(names: Sequence[Any]) -> None:
            await cluster.scale_down(names)  # or it waits for their workers for ever, and gives one's name anew
            cluster.scale(jobs=self.workers)

        def watch() -> None:
            before: set[str] = set()
            left = TRIES * self.workers
            while not over.wait(AGAIN):
                found, all_of_them = jobs_gone(cluster)
                if over.is_set() or self._client is None:
                    continue
                gone = {name: job for name, job in found.items() if job in before}  # no job that has only just ended
                before = set(found.values())
                if gone and all_of_them:
                    self._lost = (
                        "--scheduler slurm: all jobs have ended, with blocks left to do; why is in the files of their "
                        f"output (slurm-{min(gone.values(), key=int)}.out, or where jobqueue.slurm in Dask's settings "
                        "puts it); the same command goes on with what is done"
                    )
                    with suppress(Exception):  # a pass that has just ended: the next look has the next one's blocks
                        self._client.cancel(self._futures, force=True)
                    continue
                names = list(gone)[:left]
                left -= len(names)
                cluster.loop.add_callback(again, names)

        self._stack.callback(over.set)
        threading.Thread(target=watch, daemon=True).start()


def jobs_gone(cluster: Any) -> tuple[dict[Any, str], bool]:
    """Numbers of the jobs of a cluster that SLURM does not know any more, without a worker that answers.

    Returns:
        Them by the cluster's name of their workers, and whether there are no others and no worker at all.
    """
    answering = {worker.get("name") for worker in cluster.scheduler_info["workers"].values()}
    silent = {
        name: str(job.job_id)
        for name, job in list(cluster.workers.items())
        if job.job_id and name not in answering and name in cluster.worker_spec
    }
    elsewhere = any(line.startswith(("#SBATCH -M", "#SBATCH --cluster")) for line in cluster.job_script().splitlines())
    if not silent or elsewhere:
        return {}, False
    try:
        asked = _asked(["squeue", "--all", "--noheader", "--format=%A", f"--jobs={','.join(sorted(silent.values()))}"])
    except (OSError, subprocess.TimeoutExpired):
        return {}, False
    if asked.returncode and "nvalid job id" not in asked.stderr:  # what squeue says of jobs long ended
        return {}, False
    known = set(asked.stdout.split())
    gone = {name: job for name, job in silent.items() if job not in known}
    return gone, not answering and len(gone) == len(silent)


def _asked(command: list[str], given: str = "") -> subprocess.CompletedProcess[str]:
    """What a command of SLURM says."""
    plain = {name: value for name, value in os.environ.items() if not name.startswith("SQUEUE_")}  # no filters
    return subprocess.run(command, input=given, capture_output=True, text=True, timeout=ANSWER, env=plain)


def _environment(threads: int) -> dict[str, str]:
    """Of a worker of so many threads."""
    return {name: str(threads) for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
