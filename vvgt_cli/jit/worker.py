"""The process that compiles kernels: ``python -m vvgt_cli.jit.worker``, with its orders on standard input.

Each kernel is compiled in a fork that has compiled nothing before, so that its machine code does not depend on what
else is asked for. Two runs that want the same kernel at once share the work: who comes second waits, and finds it.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

MOST = 8  # kernels at once: 0.3 GB each


@contextlib.contextmanager
def claim(folder: Path, file: str) -> Iterator[None]:
    """Hold the right to write ``file``; without it where the file system has no locks."""
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
    """Compile one kernel, unless somebody else has meanwhile."""
    import importlib
    import itertools

    from numba.core import bytecode
    from numba.core.registry import cpu_target

    from vvgt_cli.jit import store

    dispatcher = getattr(importlib.import_module(job.module), job.function)
    file = dispatcher._cache.file(job.types, cpu_target.target_context.codegen())
    if file != job.file:
        raise RuntimeError(f"{job.function}: other sources than the caller's")
    with claim(folder, file):
        if store.read(folder / file) is None:
            # names of symbols hold this number: those of two kernels, loaded by one process, must not meet
            bytecode.FunctionIdentity._unique_ids = itertools.count(int(file.split("-")[-1][:12], 16) << 16)
            store.WORKING = folder / file
            dispatcher.compile(job.types)
            store.WORKING = None


def _attempt(folder: Path, job: Any) -> int:
    try:
        make(folder, job)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def _finished(running: set[int]) -> int:
    """Wait for a fork; its exit status."""
    number, status = os.wait()
    running.discard(number)
    print("done", flush=True)
    return status


def run(folder: Path, jobs: list[Any]) -> int:
    """Compile all; 0 where all went well."""
    import importlib

    from numba.core.registry import cpu_target

    from vvgt_cli.jit.target import widen
    from vvgt_cli.resources import processors

    widen()
    for module in sorted({job.module for job in jobs}):
        importlib.import_module(module)
    cpu_target.typing_context.refresh()  # once, rather than in every fork
    cpu_target.target_context.refresh()
    gc.disable()  # what a fork makes lives as long as it does
    failed = 0
    if not hasattr(os, "fork"):
        return sum(_attempt(folder, job) for job in jobs)
    most = min(MOST, processors())
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
