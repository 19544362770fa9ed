"""`Workload`: what of a scene and a machine the costs of stages depend on (docs/optimize.md, "The plan")."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras.blocks import BLOCK, ENOUGH, FEW, spread_blocks
from vvgt_cli.gaussians import Gaussians, as_stored

if TYPE_CHECKING:
    from vvgt_cli.dvr import Scene

SPLAT = 3.35e-3  # seconds of `_splats`'s picture on the two cores that costs were fitted on
PROBE = 80  # pixels along the edge of the view that is timed
VIEW, FINER = 0.7, 1.2  # of the view that is timed: a training view, and as much again where it is to judge by
LARGE, SMALL = 300, 200  # pixels along the edge of a training view, at most: more show no more (docs/optimize.md)
PROGRAM = 2.6e8  # bytes: interpreter, libraries and kernels


@dataclass(frozen=True)
class Workload:
    """Counts of a scene, and a machine's pace.

    Attributes:
        gaussians: that there will be: the budget, or as many as there are cells.
        cells: of the closed form's base.
        voxels: in bricks that are not empty.
        size: pixels along the edge of the screen that the file is made for.
        view: seconds of a training view of ``edge`` px, one ray a pixel.
        pace: how many times as long as the machine of the fit this one takes.
        there: bytes that the program and the volume have taken when the plan is made.
        degree: of the Gaussians' harmonics.
        visible: voxels that have extinction, about.
        step: (3,) voxel edges, unit frame.
    """

    gaussians: int
    cells: float
    voxels: float
    size: int
    view: float
    pace: float = 1.0
    there: float = PROGRAM
    degree: int = 0
    visible: float = 0.0
    step: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def edge(self) -> int:
        """Pixels along the edge of a large training view."""
        return view_edge(self.size, small=False)

    @cached_property
    def judged(self) -> int:
        """Pixels of a test view that are drawn: all, or blocks."""
        return self._pixels(ENOUGH)

    @cached_property
    def check_view_pixels(self) -> int:
        """Pixels of a check view that are drawn: all, or blocks."""
        return self._pixels(FEW)

    def _pixels(self, enough: int) -> int:
        blocks = spread_blocks(self.size, self.size, enough=enough)
        return self.size**2 if blocks is None else blocks.numbers.size * BLOCK**2

    def judging(self, pixels: int) -> float:
        """Seconds of a reference of so many pixels."""
        return FINER * self.view * pixels / self.edge**2

    @property
    def check_view_seconds(self) -> float:
        """Seconds of a check view's reference."""
        return self.judging(self.check_view_pixels)

    def at(self, pace: float) -> Workload:
        """The same on a machine that takes ``pace`` times as long; what was timed stays."""
        return replace(self, pace=self.pace * pace)


def view_edge(size: int, small: bool) -> int:
    """Pixels along the edge of a training view: the size that the file is made for, or half of it, within bounds."""
    return min(size // 2, SMALL) if small else min(size, LARGE)


def expected_wide(gaussians: int, size: int) -> bool:
    """A guess before the Gaussians are there: fewer than pixels of a view twice as large as small ones are wide."""
    return gaussians <= (2 * view_edge(size, small=True)) ** 2


def measure(scene: Scene, size: int, gaussians: int) -> Workload:
    """The case of a scene: counted, a small view timed, the machine's pace by a picture of Gaussians."""
    from vvgt_cli.closed_form.samples import visible_voxels
    from vvgt_cli.dvr.layout import BRICK

    x, y, z = (float(edge) for edge in scene.step)
    case = Workload(
        gaussians=gaussians,
        cells=0.0,
        voxels=float(np.count_nonzero(scene.empty == 0)) * BRICK**3,
        size=size,
        view=VIEW * _view_seconds(scene, view_edge(size, small=False)),
        pace=pace(),
        there=PROGRAM + _volume_bytes(scene),
        visible=visible_voxels(scene),
        step=(x, y, z),
    )
    return for_budget(case, gaussians)


def for_budget(case: Workload, gaussians: int) -> Workload:
    """The same case with another budget; nothing is timed again."""
    from vvgt_cli.closed_form.closed_form import expected_cells

    cells = expected_cells(case.visible, np.array(case.step), case.size, gaussians)
    return replace(case, cells=cells, gaussians=int(min(gaussians, cells)))


def _volume_bytes(scene: Scene) -> int:
    """Of the values, and of the copy where the kernels need another type."""
    data, values = scene.volume.data, scene.values
    grid = 0 if scene.grid is None else scene.grid.nbytes
    return data.nbytes + grid + (0 if np.may_share_memory(data, values) else values.nbytes)


def _view_seconds(scene: Scene, size: int) -> float:
    """Of a check view with one ray a pixel and half-voxel steps, from one of `PROBE` px."""
    from vvgt_cli.cameras import default_views
    from vvgt_cli.dvr import RenderSettings, render_view

    settings = RenderSettings(samples=1)
    camera = default_views("check", size=PROBE)[0]
    render_view(scene, camera, settings)  # compiled, or loaded
    return _quickest(lambda: render_view(scene, camera, settings)) * (size / PROBE) ** 2


def _quickest(call: Callable[[], object], calls: int = 3) -> float:
    """Seconds of the quickest of some calls."""
    taken = []
    for _ in range(calls):
        begin = time.perf_counter()
        call()
        taken.append(time.perf_counter() - begin)
    return min(taken)


def pace() -> float:
    """How many times as long as the machine of the fit this one takes: to draw Gaussians, on as many threads."""
    from vvgt_cli.cameras import default_views
    from vvgt_cli.splat import render

    cloud, camera = _splats(20_000, 0.012), default_views("check", 1, size=200)[0]
    render(cloud, camera)  # compiled, or loaded
    return _quickest(lambda: render(cloud, camera), 5) / SPLAT


def _splats(count: int, width: float) -> Gaussians:
    """Faint balls of standard deviation ``width``, the same each time."""
    rng = np.random.default_rng(0)
    means, colors = rng.uniform(-0.5, 0.5, (count, 3)), rng.random((count, 3))
    quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return as_stored(Gaussians(means, np.full((count, 3), np.log(width)), quaternions, np.full(count, -1.5), colors))
