"""Cases of a file of Gaussians by any program: rows and values, place in the volume, and drawing order."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import permutations, product

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.checks import Case, Figure
from vvgt_cli.gaussians import INRIA, MIN_ALPHA, Gaussians, Rule
from vvgt_cli.gaussians.formats.splats import Splats
from vvgt_cli.gaussians.frames import transform
from vvgt_cli.splat import project, render

COLUMNS = {
    "centres": "means", "sizes": "log_scales", "rotations": "quaternions", "opacities": "logits", "colours": "f_dc",
    "harmonics": "f_rest",
}  # fmt: skip
EYE_RADIUS = 3.0  # of the default views, unit frame
MARGIN = 0.03  # of the box's edge, within which a centre outside may still belong to its surface
ORIENTATION_SIZE = 96  # pixels of the pictures that orientations are compared by
ROUNDING = 2.0**-25  # largest relative rounding of float32


def finite_rows(columns: Splats) -> np.ndarray:
    """Return which rows have only finite numbers and a rotation that is not 0, (K,) bool."""
    rows = [np.isfinite(getattr(columns, name)).reshape(len(columns), -1).all(axis=1) for name in COLUMNS.values()]
    return np.logical_and.reduce(rows)


def row_cases(columns: Splats, good: np.ndarray) -> Iterator[Case]:
    """Yield cases of rows that cannot be drawn or that float32 rounds too coarsely; ``good``: from `finite_rows`."""

    def broken(name: str) -> Figure:
        rows = np.isfinite(getattr(columns, name)).reshape(len(columns), -1).all(axis=1)
        return Figure(f"rows of {len(columns)}", int(np.count_nonzero(~rows)), 0)

    for what, name in COLUMNS.items():
        yield Case("file", f"{what} that are not finite", partial(broken, name))

    def rounded() -> Figure:
        far = np.abs(columns.means[good].astype(np.float64)).max(axis=1)
        largest = np.exp(np.clip(columns.log_scales[good].astype(np.float64), -700, 700)).max(axis=1)
        return Figure("share of Gaussians", float(np.mean(far * ROUNDING > largest / 10)), 1e-3)

    yield Case("file", "centres that float32 rounds by a tenth of sigma", rounded)


def value_cases(gaussians: Gaussians, edge: float | None, size: int) -> Iterator[Case]:
    """Yield cases of extreme sizes, opacities and colours, on a screen of ``size`` px.

    ``edge`` is the longest of the volume, in whose unit frame the Gaussians are; None: the extent of most centres.
    """
    sigma = np.exp(np.clip(gaussians.log_scales.astype(np.float64), -700, 700))
    length = edge or 0.0
    if not edge:
        low, high = np.percentile(gaussians.means.astype(np.float64), (1, 99), axis=0)
        length = float((high - low).max() + 6 * np.median(sigma))
    alpha, largest = gaussians.opacity, sigma.max(axis=1)

    def share(values: np.ndarray) -> float:
        return float(np.average(values, weights=np.maximum(alpha, 1e-12)))

    def faint() -> Figure:
        return Figure("share of Gaussians", float(np.mean(alpha < MIN_ALPHA)), 0.5)

    def tiny() -> Figure:
        pixels = largest / (length / 2) * size / (2 * np.tan(np.radians(20)) * EYE_RADIUS)
        return Figure("share of the opacity", share(pixels < 0.25), 0.5)

    yield Case("values", "largest sigma", lambda: Figure("of the longest edge", float(largest.max() / length), 1.0))
    yield Case("values", f"sigma below a quarter of a pixel at {size} px", tiny)
    yield Case("values", "too faint for viewers to draw", faint)
    gaudy = np.abs(gaussians.colors - 0.5).max(axis=1) > 1.0
    yield Case("values", "colours outside -0.5 to 1.5", lambda: Figure("share of the opacity", share(gaudy), 0.01))


def place_cases(
    gaussians: Gaussians, world: Gaussians, half: np.ndarray, seen: list[np.ndarray], rule: Rule = INRIA
) -> Iterator[Case]:
    """Yield cases of the position and orientation of Gaussians in the volume's box.

    Args:
        gaussians: in the box frame.
        world: the same with the numbers of the file taken as world coordinates.
        half: half edges of the box, (3,).
        seen: views of the volume by `orientation_cameras`, (h, w, 4) float32 each.
        rule: to draw by at that size.
    """

    def share(cloud: Gaussians) -> float:
        beyond = (np.abs(cloud.means.astype(np.float64)) > half + 2 * MARGIN).any(axis=1)
        return float(np.average(beyond, weights=cloud.opacity + 1e-12))

    def outside() -> Figure:
        inside, other = share(gaussians), share(world)
        hint = f" ({other:.2g} if read as world coordinates)" if other < inside / 10 else ""
        return Figure(f"share of the opacity{hint}", inside, 0.002)

    def turned() -> Figure:
        error = {}
        for name, matrix in orientations():
            pictures = [render(transform(gaussians, matrix), camera, rule) for camera in orientation_cameras()]
            error[name] = float(np.mean([np.square(a - b).mean() for a, b in zip(seen, pictures, strict=True)]))
        own, best = error["x y z"], min(error, key=lambda name: error[name])
        gain = 10 * np.log10((own + 1e-12) / (error[best] + 1e-12))
        hint = "" if best == "x y z" else f" with axes {best}{', a mirror image' if is_mirror(best) else ''}"
        return Figure(f"dB closer to the volume{hint}", float(gain), 1.0)

    yield Case("place", "centres outside the volume's box", outside)
    yield Case("place", "axes swapped or mirrored", turned)


def orientation_cameras() -> list[Camera]:
    """Return the cameras whose views decide the orientation."""
    cameras = default_views("check", size=ORIENTATION_SIZE)
    return [cameras[i] for i in (0, 1, 2)]


def orientations() -> Iterator[tuple[str, np.ndarray]]:
    """Yield the 48 ways to lay the axes of a file: name, such as ``x -z y``, and matrix (3, 3)."""
    for order in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            name = " ".join(f"{'-' if sign < 0 else ''}{'xyz'[axis]}" for axis, sign in zip(order, signs, strict=True))
            yield name, np.eye(3)[list(order)] * np.array(signs)[:, None]


def is_mirror(name: str) -> bool:
    """Return whether an orientation shows a mirror image."""
    return float(np.linalg.det(dict(orientations())[name])) < 0


def order_cases(gaussians: Gaussians, camera: Camera) -> Iterator[Case]:
    """Yield cases of the drawing order and the amount to draw; ``gaussians`` are in the box frame."""

    def order() -> Figure:
        far = project(gaussians, camera, by_distance=True)
        a, b = render(gaussians, camera), render(gaussians, camera, projection=far)
        return Figure("RMS of RGBA", float(np.sqrt(np.mean(np.square(a - b)))), 0.02)

    def deepest() -> Figure:
        tiles = np.diff(project(gaussians, camera).start)
        return Figure("Gaussians over 16 x 16 pixels", int(tiles.max(initial=0)), 65536)

    def bright() -> Figure:
        return Figure("of a pixel's channel", float(render(gaussians, camera).max(initial=0)), 1.5)

    yield Case("order", "sorted by distance, not by depth", order)
    yield Case("order", "the deepest tile", deepest)
    yield Case("order", "the brightest pixel", bright)
