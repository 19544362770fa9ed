"""Input arrays of the network, from Gaussians, cameras and views, in numpy for both torch and onnxruntime.

Gradients of the image error by each Gaussian, the input of a network that predicts a step, are taken in its own axes,
``mu + R S d``, ``log s + e``, ``q (1, w / 2)``, so that they mean the same at any size and in any direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.types import quaternion
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import INRIA, Gaussians, Rule
from vvgt_cli.network import tables
from vvgt_cli.network.config import STEP, NetworkConfig

UNIT_RADIUS = math.sqrt(3)  # half-diagonal of the unit frame's cube


@dataclass(frozen=True)
class Prepared:
    """Input of the network.

    Attributes:
        config: of the network.
        views: ``images`` (n, channels, size, size), ``poses`` (n, 9), ``matrices`` (n, 3, 4), ``eyes`` (n, 3);
            empty for a network that reads no views.
        rows: (K, 14) Gaussians in canonical order.
        gradients: (K, `SLOPES`), None for a network that takes none.
        order: (K,) row of the given Gaussians that each of ``rows`` is.
    """

    config: NetworkConfig
    views: dict[str, np.ndarray]
    rows: np.ndarray
    gradients: np.ndarray | None
    order: np.ndarray

    def part(self, start: int = 0, stop: int | None = None) -> dict[str, np.ndarray]:
        """Return the input of the geometry side for rows [start, stop): Gaussians, gradients and tables."""
        rows = self.rows[start:stop]
        arrays = {"gaussians": rows, **tables.build(rows[:, :3], self.config.geometry, tables.bound(self.rows[:, :3]))}
        if self.gradients is not None:
            arrays["gradients"] = self.gradients[start:stop]
        return arrays

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all input of `Vvgt.forward`."""
        return self.views | (self.part() if self.config.has_geometry else {})

    def accept(self, rows: np.ndarray, cameras: Sequence[Camera], images: np.ndarray, rule: Rule = INRIA) -> Gaussians:
        """Return the output ``rows`` as Gaussians; steps are damped on the views (`damped`)."""
        if self.config.geometry.head != "step":
            return self.restore(rows)
        return damped(self.restore(self.rows), self.restore(rows), cameras, images, rule)[0]

    def restore(self, rows: np.ndarray) -> Gaussians:
        """Return the output (K, 14) as Gaussians in the given order; "wo_3dt" has an order of its own."""
        if not self.config.has_geometry:
            return unpack(rows)
        given = np.empty_like(rows)
        given[self.order] = rows
        return unpack(given)


def pack(gaussians: Gaussians) -> np.ndarray:
    """Return (K, 14) float32, unit quaternions with their first non-zero component positive, or raise DataError."""
    if gaussians.harmonics is not None:
        raise DataError(
            f"spherical harmonics of degree {gaussians.degree}: a network supports only colours that do not "
            "depend on the view; expected Gaussians of degree 0 ('vvgt optimize --sh-degree 0' drops the harmonics)"
        )
    q = gaussians.quaternions.astype(np.float64)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    first = np.take_along_axis(q, (q != 0).argmax(axis=1)[:, None], axis=1)
    q *= np.sign(first)
    columns = [gaussians.means, gaussians.log_scales, q, gaussians.opacity_logits[:, None], gaussians.colors]
    return np.concatenate(columns, axis=1, dtype=np.float32, casting="same_kind")


def unpack(rows: np.ndarray) -> Gaussians:
    """Return the Gaussians of `pack`'s rows."""
    return Gaussians(rows[:, :3], rows[:, 3:6], rows[:, 6:10], rows[:, 10], rows[:, 11:])


def prepare(
    gaussians: Gaussians, cameras: Sequence[Camera], images: np.ndarray, config: NetworkConfig, rule: Rule = INRIA
) -> Prepared:
    """Return the input of the network for a scene.

    Args:
        gaussians: to be improved, unit frame.
        cameras: of the views.
        images: (n, h, w, 4) float32 premultiplied, of any size.
        config: of the network.
        rule: by which the views are drawn.

    Raises:
        DataError: no Gaussians, Gaussians with harmonics, or no views for a network that needs some.
    """
    if not len(gaussians):
        raise DataError("no Gaussians: the network needs at least one")
    needs_views = config.has_images or (config.has_geometry and config.geometry.gradients)
    if needs_views and not len(cameras):
        raise DataError("no views: this network reads at least one")
    rows = pack(gaussians)
    gaussians = unpack(rows)  # the gradient of q is minus that of -q
    order = tables.canonical_order(rows)
    views: dict[str, np.ndarray] = {}
    if config.has_images:
        views = {**view_arrays(cameras), "images": image_arrays(gaussians, cameras, images, config, rule)}
    gradients = None
    if config.has_geometry and config.geometry.gradients:
        gradients = slope_rows(gaussians, cameras, images, rule)[order]
    return Prepared(config, views, rows[order], gradients, order)


def view_arrays(cameras: Sequence[Camera]) -> dict[str, np.ndarray]:
    """Return ``poses`` (n, 9), ``matrices`` (n, 3, 4) to (u w, v w, w), u and v in [0, 1], ``eyes`` (n, 3), float32.

    A pose is world-to-camera: translation in half-diagonals of the unit cube, quaternion with w >= 0, field of view
    (h, w) in radians. It is absolute: relative to the first view the volume's frame would be lost.
    """
    poses, matrices = [], []
    for c in cameras:
        translation = c.translation / UNIT_RADIUS
        fov = 2 * np.arctan([c.height / (2 * c.fy), c.width / (2 * c.fx)])
        poses.append(np.concatenate([translation, quaternion(c.rotation), fov]))
        lens = np.array([[c.fx / c.width, 0, c.cx / c.width], [0, c.fy / c.height, c.cy / c.height], [0, 0, 1]])
        matrices.append(lens @ np.column_stack([c.rotation, c.translation]))
    eyes = [c.position for c in cameras]
    return {
        name: np.array(values, np.float32)
        for name, values in {"poses": poses, "matrices": matrices, "eyes": eyes}.items()
    }


def image_arrays(
    gaussians: Gaussians, cameras: Sequence[Camera], images: np.ndarray, config: NetworkConfig, rule: Rule
) -> np.ndarray:
    """Return (n, channels, size, size) float32: targets, and for some networks the Gaussians' own rendering."""
    size = config.image.size
    out = np.empty((len(cameras), config.channels, size, size), np.float32)
    for i, camera in enumerate(cameras):
        out[i, :4] = resize(images[i], size)
        if config.rendering:
            from vvgt_cli.splat import render

            out[i, 4:] = resize(render(gaussians, camera, rule), size)
    return out


def resize(image: np.ndarray, size: int) -> np.ndarray:
    """Resample (h, w, c) to (c, size, size) by a triangle filter as wide as the coarser of the two grids."""
    rows, columns = filter_matrix(image.shape[0], size), filter_matrix(image.shape[1], size)
    return np.einsum("ih,hwc,jw->cij", rows, image, columns, optimize=True)


def filter_matrix(old: int, new: int) -> np.ndarray:
    """Return (new, old) float32 weights; each row's sum is 1."""
    if old == new:
        return np.eye(new, dtype=np.float32)
    ratio = old / new
    centre = (np.arange(new) + 0.5) * ratio - 0.5  # in old pixels
    weights = np.maximum(0, 1 - np.abs(centre[:, None] - np.arange(old)) / max(ratio, 1.0))
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


VIEWS = 3  # of those that the network has read
SMALLEST = 1 / 16  # share of a step; below it none is taken


def interpolate(start: Gaussians, end: Gaussians, share: float) -> Gaussians:
    """Return the Gaussians ``share`` of the way; quaternions of norm 1, on the short arc's chord."""
    mix = lambda a, b: a + np.float32(share) * (b - a)  # noqa: E731
    fields = {field: mix(array, getattr(end, field)) for field, array in start.arrays().items()}
    fields["quaternions"] /= np.linalg.norm(fields["quaternions"], axis=1, keepdims=True)
    return Gaussians(**fields)


def damped(
    start: Gaussians, end: Gaussians, cameras: Sequence[Camera], images: np.ndarray, rule: Rule = INRIA
) -> tuple[Gaussians, float]:
    """Return the step from ``start`` to ``end`` shortened by halving while that lowers the error, and its share.

    On scenes unlike those it was trained on, a network errs first by the size of its steps. The error is the squared
    one of RGBA over `VIEWS` of the given views, averaged 2 x 2; the share is 0 if none lowers it.
    """
    from vvgt_cli.splat import render

    some = np.linspace(0, len(cameras) - 1, min(VIEWS, len(cameras))).round().astype(int)
    few, views, rule = halved([cameras[i] for i in some], images[some], rule)

    def error(gaussians: Gaussians) -> float:
        total = 0.0
        for camera, view in zip(few, views, strict=True):
            picture = render(gaussians, camera, rule)
            total += float(np.square(picture - view, dtype=np.float64).sum())
        return total

    share, best, lowest = 1.0, end, error(end)
    while share > SMALLEST:
        closer = interpolate(start, end, share / 2)
        now = error(closer)
        if now >= lowest:
            break
        share, best, lowest = share / 2, closer, now
    return (best, share) if lowest < error(start) else (start, 0.0)


FIELDS = ((0, 3), (3, 6), (6, 9), (9, 10), (10, 13))  # d, e, w, logit, colour: columns of a step


def slope_rows(gaussians: Gaussians, cameras: Sequence[Camera], images: np.ndarray, rule: Rule = INRIA) -> np.ndarray:
    """Return (K, `SLOPES`) float32 of Gaussians with unit quaternions; L is half a view's sum of squared RGBA errors.

    Columns, g_v the (13,) gradient of view v's L in the own axes, n views:
    - 13: ``sum g / sqrt(n sum g^2)`` in [-1, 1]: the direction, and how far the views agree on it;
    - 5, one per field: log of ``sqrt(sum g^2 / n)``, its mean over the field, per pixel of blending weight and error;
    - log of the blending weight per view (pixels), log of the error below it, over that of the scene;
    - log of the scene's RMS error; log of a pixel's width at the origin, less that of a standard deviation.
    """
    from vvgt_cli.splat import gather, project, render
    from vvgt_cli.splat.render import pair_sums, step_slopes

    g, count = gaussians, len(gaussians)
    total, squares = np.zeros((count, STEP), np.float32), np.zeros((count, STEP), np.float32)
    weights, error = np.zeros((count, 5)), 0.0
    pixel = float(np.median([np.linalg.norm(c.position) / c.fx for c in cameras]))
    cameras, images, rule = halved(cameras, images, rule)
    for camera, view in zip(cameras, images, strict=True):
        projection = project(g, camera, rule)
        image = render(g, camera, projection=projection)
        rest = image - view
        pairs = pair_sums(projection, g.colors, image, 2 * rest)
        own = step_slopes(g, camera, projection, pairs, g.colors).astype(np.float32)
        total += own
        squares += own * own
        size = np.sqrt((rest**2).mean(axis=2))  # (h, w) RMS over RGBA
        error += float((size**2).mean())
        gather(projection, np.broadcast_to(size, (4, *size.shape)), weights)
    n = len(cameras)
    rms = math.sqrt(error / n) + 1e-6
    weight = weights[:, 0] / n  # pixels a view
    per_pixel = np.sqrt(squares / n) / ((weight + 0.1) * rms)[:, None]
    sizes = [np.log(np.sqrt((per_pixel[:, a:b] ** 2).mean(axis=1)) + 1e-4) for a, b in FIELDS]
    below = np.log((weights[:, 1] + 1e-3 * rms) / ((weights[:, 0] + 1e-3) * rms))
    thick = math.log(pixel) - g.log_scales.mean(axis=1)
    columns = [
        total / np.sqrt(n * squares + 1e-30), *sizes, np.log(weight + 0.01), below,
        np.full(count, math.log(rms) + 3.5), thick,
    ]  # fmt: skip
    return np.column_stack(columns).astype(np.float32)


def halved(cameras: Sequence[Camera], images: np.ndarray, rule: Rule = INRIA) -> tuple[list[Camera], np.ndarray, Rule]:
    """Return views (n, h, w, c) averaged 2 x 2 where their sides are even, and the rule that stands for theirs."""
    h, w = images.shape[1:3]
    if h % 2 or w % 2:
        return list(cameras), images, rule
    upper, lower = images[:, ::2], images[:, 1::2]
    mean = np.float32(0.25) * (upper[:, :, ::2] + upper[:, :, 1::2] + lower[:, :, ::2] + lower[:, :, 1::2])
    return [camera.resized(0.5) for camera in cameras], mean, rule.at(0.5)
