"""`Workload`: the counts and timings that stage costs depend on (fit: docs/optimize.md, "The plan")."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras.blocks import FEW, drawn_pixels
from vvgt_cli.gaussians import Gaussians, as_stored

if TYPE_CHECKING:
    from vvgt_cli.dvr import Scene

SPLAT = 3.35e-3  # seconds of `_splats`'s picture on the two cores that costs were fitted on
PROBE = 80  # pixels along the edge of the timed view
VIEW, FINER = 0.7, 1.2  # time of a training view per timed view, and of a reference view per training view
LARGE, SMALL = 300, 200  # largest edge of training views in pixels: larger ones gain nothing (docs/optimize.md)
PROGRAM = 2.6e8  # bytes: interpreter, libraries and kernels


@dataclass(frozen=True)
class Workload:
    """Counts of a scene, and the speed of the machine.

    Attributes:
        gaussians: expected number of Gaussians: the budget, or the number of cells if smaller.
        cells: base cells of the closed form.
        voxels: voxels in non-empty bricks.
        size: edge of the target screen in pixels.
        view: seconds for a training view of ``edge`` px with one ray per pixel.
        pace: time taken relative to the machine that the costs were fitted on.
        base_bytes: memory in use by the program and the volume when the plan is made.
        degree: degree of the Gaussians' harmonics.
        visible: approximate number of voxels with extinction.
        step: (3,) voxel edges, unit frame.
    """

    gaussians: int
    cells: float
    voxels: float
    size: int
    view: float
    pace: float = 1.0
    base_bytes: float = PROGRAM
    degree: int = 0
    visible: float = 0.0
    step: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def edge(self) -> int:
        """Edge of a large training view in pixels."""
        return view_edge(self.size, small=False)

    @cached_property
    def test_view_pixels(self) -> int:
        """Number of pixels that are rendered of a test view: all, or those of blocks."""
        return drawn_pixels(self.size)

    @cached_property
    def check_view_pixels(self) -> int:
        """Number of pixels that are rendered of a check view: all, or those of blocks."""
        return drawn_pixels(self.size, FEW)

    def reference_seconds(self, pixels: int) -> float:
        """Return the seconds for a reference of this many pixels."""
        return FINER * self.view * pixels / self.edge**2

    @property
    def check_view_seconds(self) -> float:
        """Seconds for the reference of a check view."""
        return self.reference_seconds(self.check_view_pixels)

    def at(self, pace: float) -> Workload:
        """Return the workload on a machine that takes ``pace`` times as long; measured times stay."""
        return replace(self, pace=self.pace * pace)


def view_edge(size: int, small: bool) -> int:
    """Return the edge of a training view in pixels: the target size, or half of it, within bounds."""
    return min(size // 2, SMALL) if small else min(size, LARGE)


def measure(scene: Scene, size: int, gaussians: int) -> Workload:
    """Measure a scene's workload: count it, time a small view, and time a picture of Gaussians for the pace."""
    from vvgt_cli.closed_form.samples import visible_voxels
    from vvgt_cli.dvr.layout import BRICK

    x, y, z = (float(edge) for edge in scene.step)
    workload = Workload(
        gaussians=gaussians,
        cells=0.0,
        voxels=float(np.count_nonzero(scene.empty == 0)) * BRICK**3,
        size=size,
        view=VIEW * _view_seconds(scene, view_edge(size, small=False)),
        pace=pace(),
        base_bytes=PROGRAM + _volume_bytes(scene),
        visible=visible_voxels(scene),
        step=(x, y, z),
    )
    return for_budget(workload, gaussians)


def for_budget(workload: Workload, gaussians: int) -> Workload:
    """Return the workload for another budget, without measuring again."""
    from vvgt_cli.closed_form.closed_form import expected_cells

    cells = expected_cells(workload.visible, np.array(workload.step), workload.size, gaussians)
    return replace(workload, cells=cells, gaussians=int(min(gaussians, cells)))


def _volume_bytes(scene: Scene) -> int:
    """Return the bytes of the values and grids, and of the copy if the kernels need another type."""
    data, values = scene.volume.data, scene.values
    mixed = (scene.mixture.grid, scene.mixture.scalars) if scene.mixture and scene.mixed else ()
    grids = scene.grid, scene.relief, *mixed
    grid: int = sum(one.nbytes for one in grids if one is not None)
    return data.nbytes + grid + (0 if np.may_share_memory(data, values) else values.nbytes)


def _view_seconds(scene: Scene, size: int) -> float:
    """Estimate the seconds for a check view with one ray per pixel and half-voxel steps from one of `PROBE` px."""
    from vvgt_cli.cameras import default_views
    from vvgt_cli.dvr import RenderSettings, render_view

    settings = RenderSettings(samples=1)
    camera = default_views("check", size=PROBE)[0]
    render_view(scene, camera, settings)  # compiled, or loaded
    return _quickest(lambda: render_view(scene, camera, settings)) * (size / PROBE) ** 2


def _quickest(call: Callable[[], object], calls: int = 3) -> float:
    """Return the seconds of the fastest call."""
    taken = []
    for _ in range(calls):
        begin = time.perf_counter()
        call()
        taken.append(time.perf_counter() - begin)
    return min(taken)


@cache
def pace() -> float:
    """Return this machine's time relative to the machine of the fit, drawing Gaussians on as many threads.

    It is measured once a process: a batch asks for it at every frame.
    """
    from vvgt_cli.cameras import default_views
    from vvgt_cli.splat import render

    cloud, camera = _splats(20_000, 0.012), default_views("check", 1, size=200)[0]
    render(cloud, camera)  # compiled, or loaded
    return _quickest(lambda: render(cloud, camera), 5) / SPLAT


def _splats(count: int, width: float) -> Gaussians:
    """Return faint balls of standard deviation ``width``, the same each time."""
    rng = np.random.default_rng(0)
    means, colors = rng.uniform(-0.5, 0.5, (count, 3)), rng.random((count, 3))
    quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return as_stored(Gaussians(means, np.full((count, 3), np.log(width)), quaternions, np.full(count, -1.5), colors))
