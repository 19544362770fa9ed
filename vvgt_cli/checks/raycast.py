"""Cases of the ray caster: every hard scene against its float64 twin, and cameras and images at their limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.scenes import Hard, build, camera, function, hard_scenes, ramp, rough, smooth, step
from vvgt_cli.dvr import RenderSettings, Scene, render_view, render_view_reference

STAGE = "ray caster"
FINE = RenderSettings(step=0.125, samples=1)
LIMIT = 3e-3


def sane(image: np.ndarray) -> None:
    """Premultiplied colours of at most 1: finite, not below 0, none brighter than its alpha."""
    require(np.isfinite(image).all(), f"{np.count_nonzero(~np.isfinite(image))} values are not finite")
    require(image.min() >= 0, f"a value of {image.min():.3g}")
    require(image[..., 3].max() <= 1, f"alpha {image[..., 3].max():.9g}")
    require((image[..., :3] <= image[..., 3:] + 2e-6).all(), "a colour brighter than its alpha")


def difference(scene: Scene, view: Camera, twin_step: float, limit: float = LIMIT, empty: bool = False) -> Figure:
    """Mean difference from the twin over the twin's largest value; ``empty``: there may be nothing to see."""
    image = render_view(scene, view, FINE)
    sane(image)
    twin = render_view_reference(scene, view, step=twin_step)
    require(empty or twin.any(), "the twin shows nothing: the case compares nothing")
    scale = max(float(twin.max()), 1e-12)
    return Figure("difference from the twin, mean", float(np.abs(image - twin).mean() / scale), limit)


def _hard(row: Hard) -> Figure:
    return difference(row.make(), camera(fov=row.fov), row.step, row.error)


def _long_steps(row: Hard) -> Figure:
    return bounded(row.make(), camera(fov=row.fov))


def bounded(scene: Scene, view: Camera) -> Figure:
    """Steps of four voxels: wrong perhaps, but bounded."""
    image = render_view(scene, view, RenderSettings(step=4.0, samples=1))
    sane(image)
    return Figure("largest value", float(image.max()), 1.0)


def _plain() -> Scene:
    return build(rough((8, 8, 8), 5), ramp(), 1.0)


def _view(view: Camera, limit: float = LIMIT, empty: bool = False) -> Figure:
    return difference(_plain(), view, 1 / 32, limit, empty)


def _slab(depth: float, size: float) -> Figure:
    """Absorption in a homogeneous slab: 1 - exp(-depth), at any step; a ray ends at 0.001 x step^2."""
    opacity = -math.expm1(-depth / 8)  # per voxel of eight
    scene = build(np.full((4, 4, 8), 3.0), function([0, 1], [opacity, opacity]), 1.0)
    image = render_view(scene, camera(1, 1, (5, 0, 0)), RenderSettings(step=size, samples=1))
    limit = 1e-3 * size**2 if math.exp(-depth) < 1e-3 * size**2 else 0.0
    return Figure("alpha off, relative", abs(float(image[0, 0, 3]) / -math.expm1(-depth) - 1), max(3e-7, limit))


def _wide() -> Figure:
    """4096 x 16 pixels: as 16 x 16 ones in the middle, and nothing that is not finite at the ends."""
    scene = build(smooth(), step(0.5), 1.0)
    image = render_view(scene, camera(4096, 16), FINE)
    sane(image)
    middle = render_view(scene, camera(16, 16), FINE)
    return Figure("difference of the middle", float(np.abs(image[:, 2040:2056] - middle).max()), 1e-6)


def _leaps() -> Figure:
    """Empty space that is leaped over changes nothing."""
    data = np.zeros((40, 33, 50))
    data[10:14, 20:30, 33:36] = rough((4, 10, 3), 8)
    scene = build(data, ramp(), 1.0)
    require(scene.empty.max() > 1, "no empty space found")
    full = Scene(**{**vars(scene), "empty": np.zeros_like(scene.empty)})
    settings = RenderSettings(samples=1)
    off = [np.abs(render_view(scene, c, settings) - render_view(full, c, settings)).max() for c in _eyes()]
    return Figure("difference", float(max(off)), 1e-6)


def _eyes() -> list[Camera]:
    return [camera(24, 24, eye) for eye in ((2.2, -1.6, 1.1), (3.0, 0.0, 0.0), (0.1, 0.1, 0.1))]


def _same_bytes() -> Figure:
    first, second = (render_view(_plain(), camera(33, 17)) for _ in range(2))
    return Figure("pixels that differ", float((first != second).any(axis=-1).sum()), 0)


def cases() -> Iterator[Case]:
    """All of them."""
    rows = hard_scenes()
    for row in rows:
        yield Case(STAGE, row.name, partial(_hard, row))
    for row in rows:
        if "1e+06 a voxel" in row.name or row.name in ("checkerboard of voxels", "spacing 1000:1 along y"):
            yield Case(STAGE, f"{row.name}, steps of four voxels", partial(_long_steps, row))
    for depth in (1e-6, 1.0, 10.0):
        for size in (0.25, 4.0):
            yield Case(STAGE, f"slab of depth {depth:g}, step {size:g}", partial(_slab, depth, size))
    for eye in ((0.0, 0.0, 0.0), (0.1, 0.2, -0.3), (0.999, 0.0, 0.0)):
        name = ", ".join(f"{e:g}" for e in eye)
        inside = look_at(eye, target=(0.2, -0.9, 0.4), width=16, height=16, fov=80)
        yield Case(STAGE, f"an eye inside, at {name}", partial(_view, inside))
    for eye in ((4.0, 0.0, 0.0), (0.0, -4.0, 0.0), (0.0, 0.0, 4.0)):
        yield Case(STAGE, f"rays along an axis, from {eye}", partial(_view, camera(5, 5, eye), 5e-3))
    yield Case(STAGE, "an eye a thousand boxes away", partial(_view, camera(16, 16, (1800.0, -1300.0, 900.0), 0.06)))
    away = look_at((3.0, 0, 0), target=(9.0, 0, 0), width=8, height=8)
    yield Case(STAGE, "a view that misses the box", partial(_view, away, empty=True))
    for width, height in ((1, 1), (1, 37), (37, 1)):
        yield Case(STAGE, f"{width} x {height} pixels", partial(_view, camera(width, height)))
    yield Case(STAGE, "4096 x 16 pixels", _wide)
    yield Case(STAGE, "leaping over empty space", _leaps)
    yield Case(STAGE, "the same bytes twice", _same_bytes)
