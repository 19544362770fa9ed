"""How stiff a volume is under its function, and the step that views of it need; cases of one scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.checks import Case, mapping, raycast
from vvgt_cli.checks.whole import whole
from vvgt_cli.dvr import RenderSettings, Scene, render_view

STEPS = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125, 0.0625)  # voxels
FINEST = 1 / 64
SIZE, VIEWS = 128, 2
SLAB = 1 << 21  # voxels looked at together


@dataclass(frozen=True)
class Stiffness:
    """Figures of a scene.

    Attributes:
        depth_per_step: largest optical depth of half the shortest voxel edge, the step that views are made with.
        change_per_voxel: largest change of extinction between two neighbouring voxels, every value between theirs
            included, over the largest extinction: 1 where all of it comes within a voxel.
        abrupt: share of the neighbours that show anything whose change is above a half.
        explicit_step: voxels (shortest edge) above which explicit Euler steps overshoot: depth 1.
        tolerance: root-mean-square error of RGBA that was asked for.
        errors: root-mean-square error of RGBA of two views of 128 px by step in voxels, against 1/64.
        needed_step: largest of these steps from which on no error exceeds the tolerance; None: none of them.
    """

    depth_per_step: float
    change_per_voxel: float
    abrupt: float
    explicit_step: float
    tolerance: float
    errors: dict[str, float]
    needed_step: float | None


class _Ranges:
    """Least and greatest extinction of any interval of the table, by doubling intervals."""

    def __init__(self, tau: np.ndarray) -> None:
        self.low, self.high = [tau], [tau]
        width = 1
        while 2 * width <= len(tau):
            self.low.append(np.minimum(self.low[-1][:-width], self.low[-1][width:]))
            self.high.append(np.maximum(self.high[-1][:-width], self.high[-1][width:]))
            width *= 2

    def change(self, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(greatest - least, greatest) over nodes ``first`` to ``last``, inclusive, of one shape."""
        level = np.frexp(last - first + 1)[1] - 1  # floor of log2
        low, high = np.empty(first.shape), np.empty(first.shape)
        for n in np.unique(level):
            at = level == n
            a, b = first[at], last[at] + 1 - (1 << int(n))
            low[at] = np.minimum(self.low[n][a], self.low[n][b])
            high[at] = np.maximum(self.high[n][a], self.high[n][b])
        return high - low, high


def changes(scene: Scene, progress: Callable[[int, int], None] | None = None) -> tuple[float, float]:
    """`Stiffness.change_per_voxel` and `Stiffness.abrupt`; neighbours that are not finite are left out."""
    ranges = None if scene.grid is not None else _Ranges(scene.optics.nodes[:, 3])  # a grid holds extinction itself
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
            if axis:  # the slice that the next slab begins with counts there
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


def step_errors(scene: Scene) -> dict[float, float]:
    """`Stiffness.errors`."""
    cameras = default_views("check", VIEWS, size=SIZE)
    fine = [render_view(scene, camera, RenderSettings(step=FINEST, samples=1)) for camera in cameras]
    errors = {}
    for step in STEPS:
        views = [render_view(scene, camera, RenderSettings(step=step, samples=1)) for camera in cameras]
        errors[step] = float(np.sqrt(np.mean(np.square(np.stack(views) - np.stack(fine)))))
    return errors


def stiffness(scene: Scene, tolerance: float, progress: Callable[[int, int], None] | None = None) -> Stiffness:
    """Measure a scene; ``tolerance`` is the root-mean-square error of RGBA that views may have."""
    change, abrupt = changes(scene, progress)
    depth = scene.optics.largest_extinction() * float(scene.step.min())  # of one voxel
    errors = step_errors(scene)
    needed = None
    for step in reversed(STEPS):  # from the finest on
        if errors[step] > tolerance:
            break
        needed = step
    return Stiffness(
        depth_per_step=depth * RenderSettings().step,
        change_per_voxel=change,
        abrupt=abrupt,
        explicit_step=1 / depth if depth > 0 else float("inf"),
        tolerance=tolerance,
        errors={f"{step:g}": error for step, error in errors.items()},
        needed_step=needed,
    )


def scene_cases(scene: Scene) -> Iterator[Case]:
    """Cases of one scene, as `all_cases` has them of the hard ones."""
    view = default_views("check", size=16)[0]
    twin = partial(raycast.difference, scene, view, 1 / 8, 2e-2, empty=True)
    yield Case(raycast.STAGE, "16 x 16 pixels against the twin", twin)
    yield Case(raycast.STAGE, "steps of four voxels", partial(raycast.bounded, scene, view))
    yield Case(mapping.STAGE, "optical mass, K = 1,000", partial(mapping.levels, scene))
    yield Case("whole way", "K = 200, 48 px, 25 steps", partial(whole, scene))
