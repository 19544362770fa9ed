"""Runners of tasks: this process, worker processes of this machine, or Dask workers (also in SLURM jobs)."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import subprocess
import threading
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import get_context
from threading import Thread
from typing import TYPE_CHECKING, Any, Protocol, Self

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import discard_leftovers
from vvgt_cli.progress import ProgressCallback, counted
from vvgt_cli.resources import memory_limit
from vvgt_cli.volume.libraries import need

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing.connection import Connection


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


class Runner:
    """A runner that processes each block at least once, here one after the other, and the context of its workers.

    Attributes:
        workers: number of workers that run in parallel.
    """

    workers = 1

    def __enter__(self) -> Self:
        """Return the runner."""
        return self

    def __exit__(self, *error: object) -> None:
        """End the workers."""

    def run(self, task: Task, numbers: Sequence[int], progress: ProgressCallback | None) -> None:
        """Process the blocks ``numbers``."""
        for number in counted(numbers, progress):
            task(number)


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


class Processes(Runner):
    """A pool of worker processes for all passes; blocks of a killed worker are repeated by others."""

    def __init__(self, workers: int, threads: int) -> None:
        """Share ``threads`` among ``workers``."""
        self.workers, self.threads = workers, max(threads // workers, 1)
        self._pool: ProcessPoolExecutor | None = None

    def __exit__(self, *error: object) -> None:
        """End the pool, without waiting for it after an error."""
        if self._pool is not None:
            self._pool.shutdown(wait=error[0] is None, cancel_futures=True)
            self._alive.close()
            self._pool = None

    def run(self, task: Task, numbers: Sequence[int], progress: ProgressCallback | None) -> None:
        """Process the blocks ``numbers``; raise DataError if workers are killed repeatedly without finishing one."""
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


LOCAL, SLURM = "local", "slurm"
AGAIN = 30.0  # seconds between checks for jobs that have ended
ANSWER = 120.0  # seconds for SLURM to answer
TRIES = 3  # of a block whose worker was lost
WAIT = "15s"  # for a scheduler to answer


def _need(name: str) -> Any:
    """Import a package of the extra `cluster`; raise DataError if it is not installed."""
    return need(name, "cluster", "--scheduler", "Dask")


class DaskRunner(Runner):
    """A runner on Dask workers, and the context within which workers started for it stay alive."""

    def __init__(self, scheduler: str, workers: int, threads: int) -> None:
        """Check the scheduler: "local", "slurm" or an address; ``threads`` are shared by local workers, or per job.

        Raises:
            DataError: Dask or SLURM is not installed.
            UsageError: SLURM jobs have no memory size.
        """
        _need("distributed")
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # errors are lines of our own
        self._scheduler, self.workers, self._threads = scheduler, workers, threads
        self._stack, self._client = ExitStack(), None
        self._futures: Sequence[Any] = ()
        self._lost: str | None = None  # why no worker will ever answer
        if scheduler == SLURM:
            _need("dask_jobqueue")
            if shutil.which("sbatch") is None:
                raise DataError(
                    "--scheduler slurm: sbatch not found; run this on a node that submits jobs, or try local"
                )
            if memory_limit() is None:
                raise UsageError("--scheduler slurm: no memory size for its jobs; expected --memory, as --memory 16G")

    def __exit__(self, *error: object) -> None:
        """End the workers that were started."""
        self._stack.close()

    def run(self, task: Task, numbers: Sequence[int], progress: ProgressCallback | None) -> None:
        """Run the tasks; those of a lost worker are repeated on another.

        Raises:
            DataError: there is no scheduler, jobs are refused or have all ended, or workers are lost repeatedly.
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
                f"workers were killed {TRIES} times at one block (out of memory?); try --blocks with a smaller size"
            ) from error
        except CancelledError:
            ended = f"--scheduler {self._scheduler}: it ended or cancelled the blocks; run the same command to resume"
            raise DataError(self._lost or ended) from None

    def _connected(self) -> Any:
        """Return a client of the scheduler; a cluster started for it ends with the context."""
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
                "(it prints its address), or try --scheduler local"
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
        """Return a cluster of one worker per job; account, partition and time are Dask's settings, `jobqueue.slurm`.

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
            raise DataError(f"--scheduler slurm: {error}; check jobqueue.slurm in Dask's settings") from error
        try:
            tried = _asked(["sbatch", "--test-only"], cluster.job_script())
        except subprocess.TimeoutExpired:
            cluster.close()
            raise DataError(f"--scheduler slurm: sbatch does not answer within {ANSWER:g} s; try later") from None
        if tried.returncode:
            cluster.close()
            lines = [line.strip() for line in tried.stderr.splitlines() if line.strip()] or ["no reason given"]
            why = next((line for line in lines if "error" in line.lower()), lines[-1])
            raise DataError(
                f"--scheduler slurm: sbatch refuses the job ({why}); check account, partition and time in "
                "jobqueue.slurm in Dask's settings"
            )
        return cluster

    def _keep(self, cluster: Any) -> None:
        """Submit the jobs, and replacements for those that end early, until the context ends.

        If all jobs have ended and no worker answers, the tasks are cancelled. A job that ends before its worker has
        answered is replaced, `TRIES` times per requested worker.
        """
        cluster.scale(jobs=self.workers)
        closed = threading.Event()

        async def again(names: Sequence[Any]) -> None:
            await cluster.scale_down(names)  # otherwise it waits for their workers forever, and reuses a name
            cluster.scale(jobs=self.workers)

        def watch() -> None:
            before: set[str] = set()
            left = TRIES * self.workers
            while not closed.wait(AGAIN):
                ended, none_left = jobs_gone(cluster)
                if closed.is_set() or self._client is None:
                    continue
                gone = {name: job for name, job in ended.items() if job in before}  # not one that has only just ended
                before = set(ended.values())
                if gone and none_left:
                    self._lost = (
                        "--scheduler slurm: all jobs ended before all blocks were done; see their output "
                        f"(slurm-{min(gone.values(), key=int)}.out, or where jobqueue.slurm in Dask's settings puts "
                        "it), then run the same command to resume"
                    )
                    with suppress(Exception):  # the pass may have just ended: the next check sees the next pass
                        self._client.cancel(self._futures, force=True)
                    continue
                names = list(gone)[:left]
                left -= len(names)
                cluster.loop.add_callback(again, names)

        self._stack.callback(closed.set)
        threading.Thread(target=watch, daemon=True).start()


def jobs_gone(cluster: Any) -> tuple[dict[Any, str], bool]:
    """Find the jobs of a cluster that SLURM no longer knows and whose workers do not answer.

    Returns:
        Job numbers by the cluster's name for their worker, and whether no other job and no worker is left.
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
    if asked.returncode and "nvalid job id" not in asked.stderr:  # squeue's error for jobs that ended long ago
        return {}, False
    known = set(asked.stdout.split())
    gone = {name: job for name, job in silent.items() if job not in known}
    return gone, not answering and len(gone) == len(silent)


def _asked(command: list[str], given: str = "") -> subprocess.CompletedProcess[str]:
    """Run a SLURM command."""
    plain = {name: value for name, value in os.environ.items() if not name.startswith("SQUEUE_")}  # no filters
    return subprocess.run(command, input=given, capture_output=True, text=True, timeout=ANSWER, env=plain)


def _environment(threads: int) -> dict[str, str]:
    """Return the environment variables of a worker with this number of threads."""
    return {name: str(threads) for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
