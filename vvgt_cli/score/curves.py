"""Runs of reports: their costs, their Pareto front, and their table.

A run is a plain dict with the fields of a `vvgt-conversion` document (docs/report.md), and ``name`` and ``kind``.
"""

from __future__ import annotations

import csv
import io
import json
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vvgt_cli.errors import DataError

Run = dict[str, Any]
FORMATS = ("vvgt-report", "vvgt-conversion")
SCORING = ("test views", "live look", "conditions", "certificate")  # stages that only measure, or write measurements
KINDS = ("closed form", "network", "steps", "baseline", "live", "peer")
STAGES = {  # colours of known stages, in order
    "read": "#8a949e", "scene": "#b4bbc2", "samples": "#8f7bbf", "closed form": "#2f7fbf", "check views": "#f2c76b",
    "views": "#e69f00", "cells by error": "#0f8f8f", "back-projection": "#56b4e9", "network": "#cc79a7",
    "refinement": "#009e73", "training": "#6b7fd1", "values": "#c9b458", "live look": "#dddddd",
    "write": "#777c83", "test views": "#dddddd", "conditions": "#e8e8e8", "certificate": "#c4c4c4",
}  # fmt: skip
OTHER = "#a05d3b"
SCORES = ("psnr", "psnr_foreground", "psnr_white", "psnr_alpha", "ssim", "flip")


@dataclass(frozen=True)
class ReportRuns:
    """The runs of one report.

    Attributes:
        name: name of the report, for legends.
        runs: runs in the order of the report.
        document: the whole report.
    """

    name: str
    runs: list[Run]
    document: dict[str, Any] = field(default_factory=dict)

    def scored(self) -> list[Run]:
        """List the runs that have scores and took time."""
        return [run for run in self.runs if psnr(run) is not None and cost(run) > 0]


def cost(run: Run) -> float:
    """Return the wall seconds to the file, of all stages except scoring."""
    return float(sum(stage["seconds"] for stage in run["stages"] if stage["name"] not in SCORING))


def psnr(run: Run) -> float | None:
    """Return the PSNR (dB) on the test views, whole frame over black; None without scores."""
    return None if not run.get("scores") else run["scores"]["psnr"]


def worst_condition(run: Run) -> float | None:
    """Return the PSNR (dB) under the worst viewing condition (`vvgt_cli.score.viewing`); None without scores."""
    return min((condition["psnr"] for condition in run.get("conditions") or ()), default=None)


def pareto(runs: Sequence[Run]) -> list[Run]:
    """Return the Pareto front by time: runs that no other beats in both time and PSNR."""
    best, kept = -math.inf, []
    for run in sorted(runs, key=lambda run: (cost(run), -(psnr(run) or 0))):
        reached = psnr(run)
        if reached is not None and reached > best:
            best = reached
            kept.append(run)
    return kept


def knee(runs: Sequence[Run]) -> Run | None:
    """Return the run farthest above the line from the first to the last of the front, over the logarithm of seconds."""
    ends = pareto(runs)
    if len(ends) < 3:
        return ends[-1] if ends else None
    x = [math.log(cost(run)) for run in ends]
    y = [float(psnr(run) or 0) for run in ends]
    wide, high = x[-1] - x[0] or 1.0, y[-1] - y[0] or 1.0
    above = [(b - y[0]) / high - (a - x[0]) / wide for a, b in zip(x, y, strict=True)]
    return ends[above.index(max(above))]


def unit_costs(runs: Sequence[Run]) -> dict[str, float]:
    """Return the medians over runs of the seconds of a stage per unit of its work.

    Keys name the unit: a training view, a step of refinement, a megabyte, a run.
    """
    costs: dict[str, list[float]] = {}

    def note(key: str, seconds: float, units: float) -> None:
        if units > 0:
            costs.setdefault(key, []).append(seconds / units)

    for run in runs:
        for stage in run["stages"]:
            name, seconds = stage["name"], stage["seconds"]
            if name == "views":
                note("views, a view", seconds, run.get("views") or 0)
            elif name == "refinement" and run["kind"] == "steps":
                note("refinement, a step", seconds, (run.get("refinement") or {}).get("steps") or 0)
            elif name == "write":
                note("write, a megabyte", seconds, run["bytes"] / 1e6)
            elif name not in SCORING and run["kind"] not in ("baseline", "peer"):
                note(f"{name}, a run", seconds, 1)
    return {key: statistics.median(values) for key, values in costs.items()}


def table(runs: Sequence[Run]) -> str:
    """Return CSV with a row per run: name, kind, seconds, Gaussians, bytes, scores, and a column per stage."""
    stages = stage_names(runs)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    heads = ("name", "kind", "seconds", "gaussians", "bytes", *SCORES, "worst_condition", "pareto")
    writer.writerow([*heads, *(f"seconds: {s}" for s in stages)])
    best = {id(run) for run in pareto(runs)}
    for run in runs:
        scores = run.get("scores") or {}
        row = [run["name"], run["kind"], f"{cost(run):.4f}", run["gaussians"], run["bytes"]]
        numbers = [*(scores.get(key) for key in SCORES), worst_condition(run)]
        row += ["" if number is None else f"{number:.4f}" for number in numbers]
        seconds = _seconds(run)
        row += [int(id(run) in best), *(f"{seconds[s]:.4f}" if s in seconds else "" for s in stages)]
        writer.writerow(row)
    return stream.getvalue()


def stage_names(runs: Sequence[Run]) -> list[str]:
    """List the stages of all runs: known ones in their order, then others."""
    names = {stage["name"] for run in runs for stage in run["stages"]}
    return [name for name in STAGES if name in names] + sorted(names - set(STAGES))


def _seconds(run: Run) -> dict[str, float]:
    """Return seconds by stage; stages of one name are added."""
    seconds: dict[str, float] = {}
    for stage in run["stages"]:
        seconds[stage["name"]] = seconds.get(stage["name"], 0.0) + float(stage["seconds"])
    return seconds


def read_series(path: str) -> ReportRuns:
    """Read the runs of a `report.json`, or the one run of a `--report` of convert, or raise DataError without any."""
    try:
        document = json.loads(Path(path).read_text("utf-8"))
        kind = document["format"]
        if kind not in FORMATS:
            raise DataError(f"{path}: a {kind} document; expected one that 'vvgt report' or 'convert --report' wrote")
        runs = document["runs"] if kind == "vvgt-report" else [_named(document)]
        own = Path(path)
        title = own.resolve().parent.name if own.name == "report.json" else own.stem
        series = ReportRuns(title, runs, document)
        for run in runs:
            _check(run)
        count = len(series.scored())
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError, AttributeError) as error:
        what = error.strerror if isinstance(error, OSError) else f"{type(error).__name__} {error}"
        raise DataError(f"{path}: not a report ({what}); expected report.json of 'vvgt report'") from None
    if not count:
        raise DataError(f"{path}: no run with scores; expected report.json, or --report of 'vvgt convert'")
    return series


def _check(run: Run) -> None:
    """Raise ValueError or TypeError where a field of a run that tables and charts use is invalid."""
    if run["kind"] not in KINDS:
        raise ValueError(f"a run of kind {run['kind']!r}")
    if not (isinstance(run["name"], str) and isinstance(run["gaussians"], int) and isinstance(run["bytes"], int)):
        raise TypeError("a run's name, Gaussians or bytes")


def _named(document: dict[str, Any]) -> Run:
    options = document["options"]
    steps = (document.get("refinement") or {}).get("steps") or 0
    budget = options.get("max_gaussians") or document["gaussians"]
    name = f"{document['command']}, K {short(budget)}" + (f", {steps} steps" if steps else "")
    return document | {"name": name, "kind": "steps" if steps else "closed form"}


def short(number: float) -> str:
    """Abbreviate a number: 1536 to 1.54k, 100000 to 100k, 2500000 to 2.5M."""
    for size, suffix in ((1e6, "M"), (1e3, "k")):
        if number >= size:
            return f"{number / size:.3g}{suffix}"
    return f"{number:g}"
