"""The report of `vvgt check`: cases are run, and their outcomes listed; the stiffness of a scene."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, field
from itertools import groupby
from typing import Any

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.checks import Case, Outcome, run_case
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.progress import Console, ProgressCallback, counted
from vvgt_cli.score.record import document

STEPS = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125, 0.0625)  # voxels
FINEST = 1 / 64
SIZE, VIEWS = 128, 2
SLAB = 1 << 21  # voxels that are compared at a time


@dataclass
class CheckReport:
    """Outcomes of a check; docs/report.md describes `to_json`.

    Attributes:
        outcomes: one for each case.
        volume, transfer_function: records of the scene, if one was given.
        stiffness: of the scene; None for a file of Gaussians.
        splats: name, number, size and rule of the file of Gaussians, if one was given.
    """

    outcomes: list[Outcome] = field(default_factory=list)
    volume: dict[str, Any] | None = None
    transfer_function: dict[str, Any] | None = None
    stiffness: Stiffness | None = None
    splats: dict[str, Any] | None = None

    @property
    def failed(self) -> list[Outcome]:
        """Return the outcomes that did not pass."""
        return [outcome for outcome in self.outcomes if not outcome.passed]

    def to_json(self) -> str:
        """Return JSON with machine and versions."""
        counts = {"cases": len(self.outcomes), "failed": len(self.failed)}
        return document("vvgt-check", counts | asdict(self))

    def table(self) -> str:
        """Return a table: a row for each case and each stage, and the scene's stiffness."""
        stage, name = (max(len(getattr(o, key)) for o in self.outcomes) for key in ("stage", "name"))
        lines = [f"{'':<6}{'stage':<{stage}}  {'case':<{name}}  {'measured':>9} {'limit':>9}  of what"]
        for o in self.outcomes:
            numbers = f"{_number(o.value)} {_number(o.limit)}"
            row = f"{'ok' if o.passed else 'FAIL':<6}{o.stage:<{stage}}  {o.name:<{name}}  {numbers}"
            lines.append(f"{row}  {o.what if o.passed else o.problem}".rstrip())
        cases, failed = (Counter(o.stage for o in some) for some in (self.outcomes, self.failed))
        lines += ["", *(f"{key:<{stage}}  {cases[key]:>4} cases, {failed[key] or 'none'} failed" for key in cases)]
        if self.stiffness:
            lines += ["", *_stiffness_lines(self.stiffness)]
        return "\n".join(lines) + "\n"


def _number(value: float | None) -> str:
    return f"{'-' if value is None else f'{value:.3g}':>9}"


def _stiffness_lines(result: Stiffness) -> list[str]:
    needed = result.needed_step
    steps = f"{needed:g} voxels" if needed is not None else f"less than {min(map(float, result.errors)):g} voxels"
    rows = {
        "largest optical depth of a step of 0.5": f"{result.depth_per_step:.4g}",
        "largest change of extinction per voxel": f"{result.change_per_voxel:.4g} of the largest extinction",
        "neighbours that differ by more than half of it": f"{100 * result.abrupt:.3g} % of the visible pairs",
        "explicit Euler overshoots with steps above": f"{result.explicit_step:.3g} voxels (this renderer never does)",
        "error by step in voxels (RMS of RGBA)": ", ".join(f"{k}: {v:.2g}" for k, v in result.errors.items()),
        f"largest step with an error of at most {result.tolerance:g}": steps,
    }
    width = max(map(len, rows))
    return [f"{key:<{width}}  {value}" for key, value in rows.items()]


def run_cases(cases: list[Case], console: Console) -> list[Outcome]:
    """Run cases, with a line on the console for each stage."""
    outcomes: list[Outcome] = []
    for stage, group in groupby(counted(cases, console.bar("check")), lambda case: case.stage):
        done = [run_case(case) for case in group]
        outcomes += done
        failed = sum(not o.passed for o in done)
        console.stage(stage, sum(o.seconds for o in done), f"{len(done)} cases, {failed or 'none'} failed")
    return outcomes


@dataclass(frozen=True)
class Stiffness:
    """Stiffness of a scene.

    Attributes:
        depth_per_step: largest optical depth of half the shortest voxel edge, the default step of views.
        change_per_voxel: largest change of extinction between neighbouring voxels, including all values between theirs,
            relative to the largest extinction; 1 for a step function.
        abrupt: share of the visible pairs of neighbours whose change is above one half.
        explicit_step: step in voxels (shortest edge) above which explicit Euler integration overshoots (depth 1).
        tolerance: the requested RMS error of RGBA.
        errors: RMS error of RGBA of two views of 128 px by step in voxels, against steps of 1/64.
        needed_step: largest step for which this and all smaller steps are within the tolerance; None if there is none.
    """

    depth_per_step: float
    change_per_voxel: float
    abrupt: float
    explicit_step: float
    tolerance: float
    errors: dict[str, float]
    needed_step: float | None


class _Ranges:
    """Minimum and maximum extinction over any interval of the table, from intervals of doubling length."""

    def __init__(self, tau: np.ndarray) -> None:
        self.low, self.high = [tau], [tau]
        width = 1
        while 2 * width <= len(tau):
            self.low.append(np.minimum(self.low[-1][:-width], self.low[-1][width:]))
            self.high.append(np.maximum(self.high[-1][:-width], self.high[-1][width:]))
            width *= 2

    def change(self, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return maximum - minimum and maximum over nodes ``first`` to ``last``, inclusive, arrays of one shape."""
        level = np.frexp(last - first + 1)[1] - 1  # floor of log2
        low, high = np.empty(first.shape), np.empty(first.shape)
        for n in np.unique(level):
            at = level == n
            a, b = first[at], last[at] + 1 - (1 << int(n))
            low[at] = np.minimum(self.low[n][a], self.low[n][b])
            high[at] = np.maximum(self.high[n][a], self.high[n][b])
        return high - low, high


def measure_changes(scene: Scene, progress: ProgressCallback | None = None) -> tuple[float, float]:
    """Measure `Stiffness.change_per_voxel` and `Stiffness.abrupt`, skipping neighbours that are not finite."""
    ranges = None if scene.grid is not None else _Ranges(scene.optics.nodes[:, 3])  # a grid stores extinction
    top = scene.optics.largest_extinction()
    nz, ny, nx = scene.values.shape
    thick = max(1, SLAB // (ny * nx))
    largest, abrupt, visible = 0.0, 0, 0
    for z in range(0, nz, thick):
        u = scene.values[z : z + thick + 1]
        u = u.astype(np.float64) if ranges is None else scene.optics.coordinate(u)
        for axis in range(3):
            count = u.shape[axis]
            a, b = np.take(u, range(count - 1), axis), np.take(u, range(1, count), axis)
            if axis:  # the last slice is counted with the next slab
                a, b = a[:thick], b[:thick]
            known = np.isfinite(a) & np.isfinite(b)
            a, b = a[known], b[known]
            if not a.size:
                continue
            first, last = np.minimum(a, b), np.maximum(a, b)
            if ranges is None:
                change, high = last - first, last
            else:
                change, high = ranges.change(np.floor(first).astype(np.int64), np.ceil(last).astype(np.int64))
            largest = max(largest, float(change.max()))
            abrupt += int(np.count_nonzero(change > top / 2))
            visible += int(np.count_nonzero(high > 0))
        if progress:
            progress(min(z + thick, nz), nz)
    return (largest / top if top > 0 else 0.0), abrupt / max(visible, 1)


def measure_step_errors(scene: Scene) -> dict[float, float]:
    """Measure `Stiffness.errors`, by step in voxels."""
    cameras = default_views("check", VIEWS, size=SIZE)
    fine = [render_view(scene, camera, RenderSettings(step=FINEST, samples=1)) for camera in cameras]
    errors = {}
    for step in STEPS:
        views = [render_view(scene, camera, RenderSettings(step=step, samples=1)) for camera in cameras]
        errors[step] = float(np.sqrt(np.mean(np.square(np.stack(views) - np.stack(fine)))))
    return errors


def measure_stiffness(scene: Scene, tolerance: float, progress: ProgressCallback | None = None) -> Stiffness:
    """Measure the stiffness of a scene; ``tolerance`` is the RMS error of RGBA that views may have."""
    change, abrupt = measure_changes(scene, progress)
    depth_per_voxel = scene.optics.largest_extinction() * float(scene.step.min())
    errors = measure_step_errors(scene)
    needed = None
    for step in reversed(STEPS):  # finest first
        if errors[step] > tolerance:
            break
        needed = step
    return Stiffness(
        depth_per_step=depth_per_voxel * RenderSettings().step,
        change_per_voxel=change,
        abrupt=abrupt,
        explicit_step=1 / depth_per_voxel if depth_per_voxel > 0 else float("inf"),
        tolerance=tolerance,
        errors={f"{step:g}": error for step, error in errors.items()},
        needed_step=needed,
    )
