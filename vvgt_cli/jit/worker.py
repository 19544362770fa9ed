"""The process that compiles kernels: ``python -m vvgt_cli.jit.worker``, with its order on standard input.

Each kernel is compiled in a fork (on Windows, a process) that has compiled nothing before, so that its machine code
does not depend on what else is asked for. Two runs that want the same kernel at once share the work: the second waits,
and finds it.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

MAX_WORKERS = 8  # kernels at once: 0.3 GB each


@contextlib.contextmanager
def claim(folder: Path, file: str) -> Iterator[None]:
    """Hold the right to write ``file``; go on without it where the file system has no locks."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with (folder / "lock").open("a") as stream:
        with contextlib.suppress(OSError):
            fcntl.lockf(stream, fcntl.LOCK_EX, 1, int(file.split("-")[-1][:8], 16))
        yield


def make(folder: Path, job: Any) -> None:
    """Compile one kernel, unless another worker has meanwhile."""
    from vvgt_cli.jit import store
    from vvgt_cli.jit.numba_internals import number_symbols

    kernel = job.kernel()
    if kernel.kernel_cache.file(job.types) != job.file:
        raise RuntimeError(f"{job.function}: other sources than the caller's")
    with claim(folder, job.file):
        if store.read(folder / job.file) is None:
            number_symbols(int(job.file.split("-")[-1][:12], 16) << 16)
            store.WORKING = folder / job.file
            kernel.compile(job.types)
            store.WORKING = None


def _attempt(folder: Path, job: Any) -> int:
    try:
        make(folder, job)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def _finished(running: set[int]) -> int:
    """Wait for a fork and return its exit status."""
    number, status = os.wait()
    running.discard(number)
    print("done", flush=True)
    return status


def _prepare(modules: set[str]) -> None:
    from vvgt_cli.jit.numba_internals import refresh_targets, use_wide_vectors

    use_wide_vectors()
    for module in sorted(modules):
        importlib.import_module(module)
    refresh_targets()
    gc.disable()  # a fork's objects live as long as it does


def _attempt_alone(folder: Path, job: Any) -> int:
    _prepare({job.module})
    return _attempt(folder, job)


def _run_without_fork(folder: Path, jobs: list[Any], most: int) -> int:
    """Compile each of ``jobs`` in a new process, which takes a second longer than a fork."""
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from multiprocessing import get_context

    failed = 0
    with ProcessPoolExecutor(most, get_context("spawn"), max_tasks_per_child=1) as pool:
        for job in as_completed([pool.submit(_attempt_alone, folder, job) for job in jobs]):
            failed |= job.result()
            print("done", flush=True)
    return failed


def run(folder: Path, jobs: list[Any]) -> int:
    """Compile all ``jobs`` into ``folder``; return 0 where all went well."""
    from vvgt_cli.resources import processors

    failed, most = 0, min(MAX_WORKERS, processors())
    if not hasattr(os, "fork"):
        return _run_without_fork(folder, jobs, most)
    _prepare({job.module for job in jobs})
    running: set[int] = set()
    for job in jobs:
        if len(running) >= most:
            failed |= _finished(running)
        child = os.fork()
        if child == 0:
            os._exit(_attempt(folder, job))
        running.add(child)
    while running:
        failed |= _finished(running)
    return int(failed != 0)


if __name__ == "__main__":
    import pickle

    sys.exit(run(*pickle.load(sys.stdin.buffer)))
