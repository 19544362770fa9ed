"""Cases of the closed form: optical mass against quadrature in float64, budgets kept, nothing that is not finite."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.scenes import Hard, build, camera, function, hard_scenes, ramp, rough, smooth, step
from vvgt_cli.closed_form import METHODS, VbmOptions, backproject, initialise
from vvgt_cli.dvr import RenderSettings, Scene, render_views
from vvgt_cli.dvr.reference import optics_at
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.splat import render
from vvgt_cli.volume import Volume

if TYPE_CHECKING:
    from vvgt_cli.closed_form.tree import Tree

STAGE = "closed form"
SIZE = 64  # pixels


def quadrature(scene: Scene, points: int) -> float:
    """Optical mass of a scene, the integral of its extinction: midpoint rule in float64, ``points``^3 a voxel."""
    axes = [(np.arange(n * points) + 0.5) / points - 0.5 for n in scene.volume.dims]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    tau, _ = optics_at(scene, grid)
    return float(tau.sum() * np.prod(scene.step / points))


def sound(gaussians: Gaussians, scene: Scene, budget: int) -> None:
    """As many as the budget allows, opacities and colours in range, centres in the box."""
    require(0 < len(gaussians) <= budget, f"{len(gaussians)} Gaussians for a budget of {budget}")
    opacity = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    require(opacity.max() <= 0.9901, f"opacity {opacity.max():.6g}")
    require(gaussians.colors.min() >= -1e-6, f"colour {gaussians.colors.min():.3g}")
    require(gaussians.colors.max() <= 1 + 1e-6, f"colour {gaussians.colors.max():.3g}")
    beyond = (np.abs(gaussians.means) - scene.half * (1 + 1e-6)).max()
    require(beyond <= 0, f"a centre {beyond:.3g} outside the box")
    require(gaussians.log_scales.max() < 1, f"a scale of {np.exp(float(gaussians.log_scales.max())):.3g}")


def hard(row: Hard) -> Figure:
    """Mass of the base cells against quadrature; the pyramid keeps it, and every cut through it."""
    from vvgt_cli.closed_form.closed_form import closed_form
    from vvgt_cli.closed_form.moments import base_cells

    scene = row.make()
    cells = base_cells(scene, np.zeros(3, np.int64))
    require(np.isfinite(cells.moments).all(), "moments that are not finite")
    exact, mass = quadrature(scene, row.points), float(cells.moments[:, 0].sum())
    cameras = default_views("train", size=SIZE)
    form = closed_form(scene, 300, SIZE, cameras)
    if len(form.tree):
        cuts(form.tree)
        sound(form.gaussians(), scene, 300)
    else:  # thinner than the gaps between rays
        seen = render_views(scene, cameras, RenderSettings(samples=1))
        require(not seen.any(), "no Gaussians of what the ray caster shows")
    return Figure("optical mass off, relative", abs(mass / exact - 1) if exact else float("nan"), row.mass)


def cuts(tree: Tree) -> None:
    """No cut through the pyramid gains or loses mass, or exceeds its budget."""
    from vvgt_cli.closed_form.tree import leaves_of, select

    whole = float(tree.moments[-1, 0])
    for budget in (1, 10, 300):
        ids = select(tree, budget)
        kept = float(leaves_of(tree, ids).moments[:, 0].sum())
        require(len(ids) <= budget, f"{len(ids)} cells for a budget of {budget}")
        require(abs(kept - whole) <= 1e-9 * whole, f"{kept / whole - 1:.3g} of the mass gained by a cut of {budget}")


def levels(scene: Scene) -> Figure:
    """Cells of two voxels have the mass of cells of one, as near as points tell; no cut of the pyramid changes it."""
    from vvgt_cli.closed_form.closed_form import closed_form
    from vvgt_cli.closed_form.linear_ranges import BEND  # by a sixth of which its mean may be missed
    from vvgt_cli.closed_form.moments import base_cells

    fine, coarse = (base_cells(scene, np.full(3, level)).moments[:, 0].sum() for level in (0, 1))
    form = closed_form(scene, 1000, SIZE)
    require(len(form.tree), "no view sees anything")
    cuts(form.tree)
    sound(form.gaussians(), scene, 1000)
    return Figure("optical mass off, relative", abs(float(coarse / fine) - 1), BEND / 6)


def _budget(method: str, budget: int) -> Figure:
    scene = build(smooth(14), ramp(), 1.0)
    made = initialise(scene, VbmOptions(budget, SIZE, method)).gaussians
    sound(made, scene, budget)
    require(np.isfinite(render(made, camera(SIZE, SIZE))).all(), "a picture that is not finite")
    return Figure("Gaussians over the budget", max(len(made) - budget, 0), 0)


def _no_budget() -> Figure:
    try:
        VbmOptions(0)
    except UsageError:
        return Figure("accepted", 0, 0)
    return Figure("accepted", 1, 0)


def _nothing(method: str) -> Figure:
    """Nothing visible: no Gaussians, no error."""
    scene = build(smooth(), function([0, 1], [0, 0]), 1.0)
    return Figure("Gaussians of nothing", len(initialise(scene, VbmOptions(100, SIZE, method)).gaussians), 0)


def _depth_of_one() -> Figure:
    """One Gaussian of a faint ball keeps its optical mass: the picture's alpha adds up to the ray caster's."""
    at = (np.arange(12) + 0.5) / 6 - 1
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    volume = Volume(np.exp(-(x * x + y * y + z * z) / (2 * 0.25**2)))
    scene = build(volume, function([0, 1], [0, 0.02]), 1.0)
    view = camera(SIZE, SIZE)
    ours = render(initialise(scene, VbmOptions(1, SIZE)).gaussians, view)[..., 3].sum()
    exact = render_views(scene, [view], RenderSettings(step=0.25, samples=1))[0, ..., 3].sum()
    return Figure("alpha off, relative", abs(float(ours) / float(exact) - 1), 0.05)  # the cut at 1/255


def _back_projected(scene: Scene) -> Figure:
    """What back-projection makes of it is finite, and no farther from the views."""
    cameras = [camera(SIZE, SIZE, eye) for eye in ((2.2, -1.6, 1.1), (-2.0, 2.0, 0.5), (0.3, 0.2, -3.0))]
    views = render_views(scene, cameras, RenderSettings(step=0.25, samples=2))
    start = initialise(scene, VbmOptions(200, SIZE))
    refitted, _ = backproject(start, cameras, views)
    require(len(refitted) <= 200, f"{len(refitted)} Gaussians for a budget of 200")
    require(0 <= refitted.colors.min() <= refitted.colors.max() <= 2, "colours outside [0, 2]")

    def error(gaussians: Gaussians) -> float:
        off = [render(gaussians, c)[..., :3] - v[..., :3] for c, v in zip(cameras, views, strict=True)]
        return float(np.sqrt(np.mean(np.square(off))))

    return Figure("error over the error before", error(refitted) / max(error(start.gaussians), 1e-9), 1.0)


def cases() -> Iterator[Case]:
    """All of them."""
    for row in hard_scenes():
        yield Case(STAGE, row.name, partial(hard, row))
    yield Case(STAGE, "K = 0", _no_budget)
    for method in METHODS:
        for budget in (1, 10, 1_000_000):
            yield Case(STAGE, f"{method}, K = {budget:,}", partial(_budget, method, budget))
        yield Case(STAGE, f"{method}, nothing visible", partial(_nothing, method))
    yield Case(STAGE, "one Gaussian keeps the mass of a ball", _depth_of_one)
    scenes = {
        "step function of opacity 1": lambda: build(smooth(), step(1.0), 1.0),
        "independent voxels": lambda: build(rough(), ramp(), 1.0),
        "constant": lambda: build(np.full((4, 5, 6), 0.5), ramp(), 1.0),
        "one slice": lambda: build(rough((1, 9, 9)), ramp(), 1.0),
    }
    for name, make in scenes.items():
        yield Case(STAGE, f"back-projected: {name}", partial(lambda make: _back_projected(make()), make))
