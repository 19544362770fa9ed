"""Cases of light: hard scenes against the float64 twin, lights and coefficients at their limits, nothing not finite."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.raycast import FINE, difference, sane
from vvgt_cli.checks.scenes import Hard, build, camera, function, hard_scenes, ramp, rough, smooth, step
from vvgt_cli.closed_form import METHODS, VbmOptions, initialise
from vvgt_cli.dvr import Scene, render_view
from vvgt_cli.gaussians.harmonics import view_colors
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.splat import render

STAGE = "light"
SIZE, BUDGET = 64, 200
SLANTED = (0.6, -0.48, 0.64)
ABRUPT = 2.0  # times the error of the same scene without light: the shading of a step is that of its middle
TYPES = ("type >u2", "type <i2", "type >i4", "type <u4", "type <i8", "type >f4", "type >f8", "type <f2", "type i1")
EVERYTHING = Lighting(True, (SLANTED, (0.0, 0.0, 1.0)), shadows=True, occlusion=0.2)


def _lit(row: Hard, lighting: Lighting) -> Scene:
    return row.make().lit(lighting)


def _hard(row: Hard, lighting: Lighting) -> Figure:
    return difference(_lit(row, lighting), camera(fov=row.fov), row.step, ABRUPT * row.error)


def _mapped(row: Hard, degree: int) -> Figure:
    """Colours of the closed form, seen from all sides, are finite and of a size."""
    scene = _lit(row, EVERYTHING)
    made = initialise(scene, VbmOptions(BUDGET, SIZE, degree=degree)).gaussians
    largest = 0.0
    for view in default_views("train", 6, size=SIZE):
        if not len(made):
            break
        seen = view_colors(made, view.position)
        require(np.isfinite(seen).all(), "a colour that is not finite")
        require(np.isfinite(render(made, view)).all(), "a picture that is not finite")
        largest = max(largest, float(np.abs(seen).max()))
    require(made.degree == degree or not len(made), f"harmonics of degree {made.degree}")
    return Figure("largest colour", largest, 4.0)


def _dark() -> Figure:
    """Without coefficients everything is black, and as opaque as before."""
    scene, view = build(smooth(), ramp()), camera()
    black = render_view(scene.lit(replace(EVERYTHING, ambient=0, diffuse=0, specular=0)), view, FINE)
    sane(black)
    require(np.array_equal(black[..., 3], render_view(scene, view, FINE)[..., 3]), "another alpha")
    return Figure("largest colour", float(black[..., :3].max()), 0.0)


def _slab() -> Figure:
    """A homogeneous slab has no gradient: ambient light alone."""
    scene = build(np.full((4, 5, 6), 0.3), function([0, 1], [0.4, 0.4]))
    view = camera()
    lit, plain = (render_view(s, view, FINE)[..., :3] for s in (scene.lit(Lighting(ambient=0.3)), scene))
    return Figure("off the ambient colour", float(np.abs(lit - 0.3 * plain).max()), 1e-6)


def _wall() -> Figure:
    """Behind an opaque wall that fills the box no light arrives."""
    data = np.zeros((16, 12, 12))
    data[10:13] = 1.0
    data[2:5] = 0.6
    scene = build(data, function([0, 0.4, 0.5, 1], [0, 0, 1, 1]))
    lit = scene.lit(Lighting(False, ((0.0, 0.0, 1.0),), 0, 1, 0, shadows=True))
    assert lit.light is not None
    require(lit.light.shade[0, 13].min() > 0.99, "the wall's own upper side is dark")
    return Figure("light behind a wall", float(lit.light.shade[0, 2:5].max()), 1e-3)


def _around(lighting: Lighting, eye: tuple[float, float, float]) -> Figure:
    return difference(build(smooth(), ramp()).lit(lighting), camera(eye=eye), 1 / 32, 5e-3)


def _method(method: str) -> Figure:
    scene = build(smooth(14), ramp()).lit(EVERYTHING)
    made = initialise(scene, VbmOptions(BUDGET, SIZE, method, degree=2)).gaussians
    return Figure("harmonics of another degree", abs(made.degree - 2), 0)


def cases() -> Iterator[Case]:
    """All of them."""
    rows = [row for row in hard_scenes() if not row.name.endswith(TYPES)]
    for row in rows:
        yield Case(STAGE, f"headlight: {row.name}", partial(_hard, row, Lighting()))
    for row in rows[::3]:
        yield Case(STAGE, f"shadows, occlusion: {row.name}", partial(_hard, row, EVERYTHING))
    for n, row in enumerate(rows):
        yield Case(STAGE, f"closed form, degree {n % 4}: {row.name}", partial(_mapped, row, n % 4))
    for method in METHODS:
        yield Case(STAGE, f"{method}, degree 2", partial(_method, method))
    for axis in ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)):
        name = ", ".join(f"{a:g}" for a in axis)
        along = (4 * axis[0], 4 * axis[1], 4 * axis[2])
        yield Case(STAGE, f"a light along {name}, seen along it", partial(_around, Lighting(False, (axis,)), along))
    for power in (0.0, 1000.0):
        yield Case(STAGE, f"power {power:g}", partial(_around, Lighting(specular=1, specular_power=power), (2, -2, 1)))
    yield Case(STAGE, "all coefficients 0", _dark)
    yield Case(STAGE, "a homogeneous slab", _slab)
    yield Case(STAGE, "independent voxels", lambda: difference(_noise(), camera(), 1 / 32, 1e-2))
    yield Case(STAGE, "a step function of independent voxels", partial(_step_of_noise))
    yield Case(STAGE, "behind an opaque wall", _wall)


def _noise() -> Scene:
    return build(rough(), ramp()).lit(EVERYTHING)


def _step_of_noise() -> Figure:
    image = render_view(build(rough(), step(1.0)).lit(EVERYTHING), camera(), FINE)
    sane(image)
    return Figure("largest value", float(image.max()), 1.0)
