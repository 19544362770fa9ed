"""Have kernels compiled by another process."""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numba

from vvgt_cli.jit.numba_internals import config
from vvgt_cli.jit.store import PACKAGE, folder_for_writing, folders, warn_once
from vvgt_cli.progress import ProgressCallback
from vvgt_cli.resources import kill_group

VOLUMES = ("uint8", "uint16", "float32")  # types of a volume's values that kernels read


@dataclass(frozen=True)
class CompileJob:
    """A kernel to compile.

    Attributes:
        module, function: where it is.
        types: numba types of its arguments.
        file: name that the caller will look for; a worker that finds other sources refuses.
    """

    module: str
    function: str
    types: tuple[Any, ...]
    file: str

    def kernel(self) -> Any:
        """Return the dispatcher."""
        return getattr(import_module(self.module), self.function)


def usual_jobs(names: Iterable[str], volumes: Sequence[str] = VOLUMES) -> list[CompileJob]:
    """Return jobs for the declared types of kernels ("vvgt_cli.room.module:function"); none where numba is off."""
    jobs: list[CompileJob] = []
    for name in [] if config.DISABLE_JIT else dict.fromkeys(names):
        module, function = name.split(":")
        kernel = getattr(import_module(module), function)
        for types in dict.fromkeys(usual_types(kernel, kind) for kind in volumes):
            jobs.append(CompileJob(module, function, types, kernel.kernel_cache.file(types)))
    return jobs


def usual_types(kernel: Any, volume: str) -> tuple[Any, ...]:
    """Return the numba types that a kernel declares.

    `V` are read-only values (nz, ny, nx) of type ``volume``, `E` of float32.
    """
    tuples = {kind.__name__: (kind, fields) for kind, fields in kernel.tuples.items()}

    def types(usual: str) -> tuple[Any, ...]:
        kinds: list[Any] = []
        for word in usual.split():
            name, _, axes = word.partition(":")
            if name in tuples:
                kind, fields = tuples[name]
                kinds.append(numba.types.BaseTuple.from_types(types(fields), kind))
            elif name in ("V", "E"):
                values = getattr(numba.types, volume if name == "V" else "float32")
                kinds.append(numba.types.Array(values, 3, "C", readonly=True))
            else:
                scalar = getattr(numba.types, name)
                kinds.append(numba.types.Array(scalar, int(axes), "C") if axes else scalar)
        return tuple(kinds)

    return types(kernel.usual)


def missing(jobs: Iterable[CompileJob]) -> list[CompileJob]:
    """Return those of ``jobs`` whose code is not on disk."""
    return [job for job in jobs if job.kernel().kernel_cache.find(job.file) is None]


def compile_in_subprocess(jobs: Sequence[CompileJob], progress: ProgressCallback | None = None) -> bool:
    """Compile ``jobs`` in another process, one at a time on each processor.

    Args:
        jobs: what to compile.
        progress: called after each with (done, total).

    Returns:
        Whether all went well; whoever asked for a kernel that could not be compiled finds no file.
    """
    folder = folder_for_writing()
    if folder is None or not sys.executable:
        return False
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, [str(PACKAGE.parent), os.environ.get("PYTHONPATH")])),
        "PYTHONHASHSEED": "0",  # numba walks through sets of names
    }
    try:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "vvgt_cli.jit.worker"], env=environment, start_new_session=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    except OSError as error:
        warn_once(f"kernels cannot be compiled by another process: {error}")
        return False
    try:
        return _follow(process, pickle.dumps((folder, list(jobs))), len(jobs), progress)
    finally:
        if process.poll() is None:
            kill_group(process)
        process.wait()


def _follow(process: Any, order: bytes, count: int, progress: ProgressCallback | None) -> bool:
    """Send the order and follow what the worker prints, a line per kernel; return whether all went well."""
    with contextlib.suppress(BrokenPipeError):
        process.stdin.write(order)
        process.stdin.close()
    for done, _ in enumerate(process.stdout, 1):
        if progress:
            progress(done, count)
    return bool(process.wait() == 0)


def compile_ahead(names: Iterable[str], progress: ProgressCallback | None = None) -> tuple[int, int, Path | None]:
    """Compile kernels that are not on disk, for every type of values.

    Args:
        names: of `vvgt_cli.jit.ahead`.
        progress: called after each with (done, total).

    Returns:
        How many were missing, how many still are, and the folder in which later runs look, None where none can be kept.
    """
    todo = missing(usual_jobs(names))
    if todo:
        compile_in_subprocess(todo, progress)
    kept = folder_for_writing() if todo else next((f for f in folders() if f.is_dir()), None)
    return len(todo), len(missing(todo)), kept if kept in folders() else None
