"""The record of a run: its options, results and machine (docs/report.md)."""

from __future__ import annotations

import json
import math
import os
import platform
import sys
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, is_dataclass
from typing import Any

from vvgt_cli.progress import Console
from vvgt_cli.version import VERSION

SCHEMA = 1  # of the JSON documents; raised when a field changes its meaning


@dataclass
class StageRecord:
    """The record of one stage of a run.

    Attributes:
        name: name of the stage.
        seconds: wall time.
        psnr, psnr_before: dB on the check views after and before it, None where not measured.
        kept: False where the result was dropped because the error was not lower.
        note: further details, one line.
    """

    name: str
    seconds: float = 0.0
    psnr: float | None = None
    kept: bool = True
    note: str = ""
    psnr_before: float | None = None

    def detail(self) -> str:
        """Return the result of the stage as a message."""
        parts = [self.note] if self.note else []
        if self.psnr is not None:
            parts.append(f"check views {self.psnr:.2f} dB")
        if not self.kept:
            parts.append("no gain: dropped")
        return ", ".join(parts)


@dataclass
class ConversionReport:
    """The report of `vvgt convert`, `vvgt init` or `vvgt optimize`; `to_json` is the `--report` file.

    Attributes:
        command: "convert", "init" or "optimize".
        volume, transfer_function, options: inputs, plain values.
        stages: stages in the order they ran.
        gaussians, bytes: counts of the written file.
        scores: scores on the test views, None for `init`.
        conditions: `convert`'s scores under each viewing condition (`vvgt_cli.score.viewing`), worst first.
        texture: `convert`'s texture on smooth areas in its `texture_cameras`.
        plan: `convert`'s plan (`vvgt_cli.conversion.plan.Plan`): stages, seconds, bytes, memory.
        skipped: (stage, reason) of skipped stages.
        refinement: record of gradient descent (`vvgt_cli.refine.OptimizeRecord`), None without it.
        seconds: wall time of the whole run, without the start of the interpreter.
    """

    command: str
    volume: dict[str, Any] = field(default_factory=dict)
    transfer_function: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    stages: list[StageRecord] = field(default_factory=list)
    gaussians: int = 0
    bytes: int = 0
    scores: dict[str, Any] | None = None
    conditions: list[dict[str, Any]] | None = None
    texture: dict[str, Any] | None = None
    refinement: dict[str, Any] | None = None
    plan: dict[str, Any] | None = None
    skipped: list[tuple[str, str]] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def interrupted(self) -> bool:
        """Return whether Ctrl-C ended gradient descent early."""
        return self.refinement is not None and self.refinement["reason"] == "interrupted"

    def to_json(self) -> str:
        """Return the report, machine and versions as JSON; see docs/report.md."""
        return document("vvgt-conversion", asdict(self))


def document(kind: str, body: dict[str, Any]) -> str:
    """Return a JSON document of kind, schema, body, machine and versions; values that are not finite become null."""
    whole = {"format": kind, "schema": SCHEMA, **body, "machine": machine(), "versions": versions()}
    return json.dumps(plain(whole), indent=2, allow_nan=False) + "\n"


def plain(value: Any) -> Any:
    """Convert dataclasses, tuples and numpy numbers to JSON types; floats that are not finite become None."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _cpu() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
            return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "unknown"


def peak_memory() -> int | None:
    """Return the peak resident size of this process in bytes, None where the system does not report it."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def machine() -> dict[str, Any]:
    """Return what times depend on: CPU, threads, load; never the host name."""
    threads = os.environ.get("NUMBA_NUM_THREADS")
    if "numba" in sys.modules:
        import numba

        threads = str(numba.get_num_threads())
    return {
        "system": platform.system(),
        "architecture": platform.machine(),
        "cpu": _cpu(),
        "cpus": os.cpu_count(),
        "threads": int(threads) if threads else None,
        "load": list(os.getloadavg()) if hasattr(os, "getloadavg") else None,
        "peak_memory_bytes": peak_memory(),
    }


def versions() -> dict[str, str]:
    """Return the versions of this program and of imported libraries that its numbers depend on."""
    known = {"vvgt": VERSION, "python": platform.python_version()}
    for name in ("numpy", "numba", "vtkmodules"):
        module = sys.modules.get(name)
        version = getattr(module, "__version__", None)
        if version:
            known["vtk" if name == "vtkmodules" else name] = str(version)
    return known


@dataclass
class Run:
    """A run, which times stages, prints messages and fills the report."""

    console: Console
    report: ConversionReport
    start: float = field(default_factory=time.perf_counter)

    @contextmanager
    def stage(self, name: str) -> Iterator[StageRecord]:
        """Time a block as a stage; the block sets psnr, kept and note of the yielded record."""
        stage = StageRecord(name)
        begin = time.perf_counter()
        yield stage
        stage.seconds = time.perf_counter() - begin
        self.report.stages.append(stage)
        self.console.stage(name, stage.seconds, stage.detail())

    def compile(self, kernels: Collection[str], volume: str | None = None) -> None:
        """Compile kernels that are not cached on disk: a stage of a first run, nothing in later ones.

        Args:
            kernels: kernels of `vvgt_cli.jit.ahead`.
            volume: type of the volume's values, where kernels read them.
        """
        from vvgt_cli.jit.compile import VOLUMES, compile_in_subprocess, missing, usual_jobs

        todo = missing(usual_jobs(kernels, (volume,) if volume else VOLUMES))
        if todo:
            with self.stage("compile") as stage:
                compile_in_subprocess(todo, self.console.bar("compile"))
                stage.note = f"{len(todo)} kernels, on a first run (vvgt warmup does it beforehand)"

    def elapsed(self) -> float:
        """Return the wall seconds since the run began."""
        return time.perf_counter() - self.start

    def skip(self, stage: str, why: str) -> None:
        """Report that a stage is skipped, and why."""
        self.report.skipped.append((stage, why))
        self.console.message(f"skipped: {stage} ({why})")

    def finish(self) -> ConversionReport:
        """Set the time of the whole run, and return the report."""
        self.report.seconds = self.elapsed()
        return self.report
