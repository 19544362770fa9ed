"""Stiffness of a volume under its transfer function, and the sampling step that views of it need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.progress import ProgressCallback

STEPS = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125, 0.0625)  # voxels
FINEST = 1 / 64
SIZE, VIEWS = 128, 2
SLAB = 1 << 21  # voxels that are compared at a time


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
