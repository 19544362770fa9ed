"""`render`: a picture of Gaussians as the standard viewers show it; `Projection` is its reusable first half."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vvgt_cli.cameras import Blocks, Camera
from vvgt_cli.gaussians import INRIA, TILE, Gaussians, Rule, rule_of
from vvgt_cli.gaussians.frames import axes_of, rotations

LARGEST_LOG_SCALE = 200.0  # of either sign, in gradients


@dataclass(frozen=True)
class Projection:
    """Gaussians projected into one camera and sorted into tiles.

    Attributes:
        flat: (K, 7) float32 centre x, y (px), conic a, b, c (px^-2), opacity as drawn and as given.
        extent: (K, 4) int32 pixel boxes x0, y0, x1, y1; empty where not seen.
        start, members, slots, first: tile lists, see `kernel.tile_lists`.
        tiles_x: tiles along a row.
        tiles: (tiles,) order in which threads take the tiles.
        rule: by which it was made, and is to be blended.
    """

    flat: np.ndarray
    extent: np.ndarray
    start: np.ndarray
    members: np.ndarray
    slots: np.ndarray
    first: np.ndarray
    tiles_x: int
    tiles: np.ndarray
    rule: Rule


def project(gaussians: Gaussians, camera: Camera, rule: str | Rule = INRIA, *, by_distance: bool = False) -> Projection:
    """Project by EWA and list tiles, sorted by depth or ``by_distance``, by a rule, or the rule of that name.

    ``rule.at(w / W)`` gives, at a camera's size w, what viewers show at size W, at fewer points.
    """
    g = gaussians
    distance = np.linalg.norm(g.means - camera.position, axis=1).astype(np.float32) if by_distance else None
    return _projected((g.means, None, g.log_scales, g.quaternions, g.opacity_logits), camera, rule, distance)


def project_factors(
    means: np.ndarray, factors: np.ndarray, logits: np.ndarray, camera: Camera, rule: str | Rule = INRIA
) -> Projection:
    """Apply `project` for covariances ``M M^T``: means (K, 3), factors (K, 3, 3) M, logits (K,), all float32."""
    return _projected((means, factors, None, None, logits), camera, rule)


def _projected(
    columns: tuple[Any, ...], camera: Camera, rule: str | Rule, distance: np.ndarray | None = None
) -> Projection:
    """Project means, factors or log-scales and quaternions, logits; sort by depth or by ``distance`` (K,) float32."""
    import numba

    from vvgt_cli.splat import kernel

    rule, count = rule_of(rule), len(columns[-1])
    flat = np.empty((count, 7), np.float32)
    depth = np.empty(count, np.float32)
    extent = np.empty((count, 4), np.int32)
    run: Any = kernel.project if columns[1] is None else kernel.project_factors
    run(*columns, *pose(camera), rule.projecting(), flat, depth, extent)
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    order = depth_order(depth if distance is None else distance)
    start, members, slots, first = kernel.tile_lists(order, extent, tiles_x, tiles_y, numba.get_num_threads())
    tiles = np.argsort(-np.diff(start), kind="stable")
    return Projection(flat, extent, start, members, slots, first, tiles_x, tiles, rule)


def pose(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rotation (3, 3), translation (3,) and lens (fx, fy, cx, cy, width, height) for kernels, float64."""
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height], np.float64)
    return np.ascontiguousarray(camera.rotation), np.ascontiguousarray(camera.translation), lens


def depth_order(depth: np.ndarray) -> np.ndarray:
    """Return the stable order of depths (K,) float32 >= 0, whose bits sort as integers."""
    from vvgt_cli.splat import kernel

    return kernel.stable_order(depth.view(np.uint32))


def blend(
    projection: Projection, colors: np.ndarray, height: int, width: int, blocks: Blocks | None = None
) -> np.ndarray:
    """Blend (height, width, 4) float32 premultiplied RGBA, linear in ``colors`` (K, 3) float32, perhaps negative.

    With ``blocks`` zero elsewhere.
    """
    from vvgt_cli.splat import tiles

    p = projection
    image = np.zeros((height, width, 4), np.float32)
    colors = np.ascontiguousarray(colors, np.float32)
    chosen = p.tiles if blocks is None else p.tiles[np.isin(p.tiles, blocks.numbers)]
    tiles.blend(chosen, p.start, p.members, p.extent, p.flat, colors, p.tiles_x, p.rule.blending(), image)
    return image


Shown = Gaussians | Callable[[Camera], Gaussians]  # all Gaussians, or those of the levels that a camera selects


def render(
    gaussians: Shown,
    camera: Camera,
    rule: str | Rule = INRIA,
    projection: Projection | None = None,
    blocks: Blocks | None = None,
) -> np.ndarray:
    """Render (height, width, 4) float32 premultiplied RGBA over nothing (conventions: Gaussians); negatives are 0.

    ``projection``, where there is one, was made by a rule of its own; with ``blocks`` zero elsewhere.
    """
    g = gaussians if isinstance(gaussians, Gaussians) else gaussians(camera)
    p = projection or project(g, camera, rule)
    colors = seen_colors(g.means, g.colors, g.harmonics, camera.position)
    return blend(p, np.maximum(colors, 0), camera.height, camera.width, blocks)


def seen_colors(means: np.ndarray, colors: np.ndarray, harmonics: np.ndarray | None, eye: np.ndarray) -> np.ndarray:
    """Return (K, 3) float32 colours as seen from ``eye`` (3,), perhaps negative; other arguments as of `Gaussians`."""
    if harmonics is None:
        return colors
    from vvgt_cli.splat import harmonics as kernels

    out = np.empty_like(colors)
    kernels.view_colors(means, colors, harmonics, np.asarray(eye, np.float64), out)
    return out


def seen_slopes(
    means: np.ndarray, harmonics: np.ndarray, eye: np.ndarray, slopes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return gradients by harmonics (K, M, 3) and means (K, 3), from those by `seen_colors`; all float32."""
    from vvgt_cli.splat import harmonics as kernels

    by_harmonics, by_means = np.empty_like(harmonics), np.empty_like(means)
    kernels.view_slopes(means, harmonics, np.asarray(eye, np.float64), slopes, by_harmonics, by_means)
    return by_harmonics, by_means


def gather(projection: Projection, fields: np.ndarray, out: np.ndarray) -> None:
    """Add sums of w and of w x ``fields`` (4, h, w) float32 to ``out`` (K, 5) float64, w = T alpha."""
    from vvgt_cli.splat import tiles

    p = projection
    pairs = np.zeros((len(p.members), 5), np.float32)
    fields = np.ascontiguousarray(fields, np.float32)
    tiles.gather(p.tiles, p.start, p.members, p.slots, p.extent, p.flat, p.tiles_x, p.rule.blending(), fields, pairs)
    tiles.reduce_pairs(p.first, pairs, out)


@dataclass(frozen=True)
class Gradients:
    """dL/d(field) of each field of `Gaussians`, float32 of the same shapes; None for harmonics that there are not."""

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    opacity_logits: np.ndarray
    colors: np.ndarray
    harmonics: np.ndarray | None = None


def render_backward(
    gaussians: Gaussians, camera: Camera, projection: Projection, image: np.ndarray, grad: np.ndarray
) -> Gradients:
    """Return gradients of a loss by Gaussians, given those by their picture.

    Zero where the forward pass does not move: a Gaussian that is not seen, an alpha at its clamp 0.99 or below the cut,
    a pixel that has ended, a colour below 0. Steps of the cut and of the order of depths are not differentiated.

    Args:
        gaussians: as given to `render`.
        camera: as given to `render`.
        projection: of the forward pass.
        image: what the forward pass drew, (height, width, 4).
        grad: (height, width, 4) dL/d(image), premultiplied RGBA.
    """
    g = gaussians
    seen = seen_colors(g.means, g.colors, g.harmonics, camera.position)
    return fields_backward(gaussians, camera, projection, pair_sums(projection, seen, image, grad), seen)


def step_slopes(
    gaussians: Gaussians, camera: Camera, projection: Projection, pairs: np.ndarray, seen: np.ndarray
) -> np.ndarray:
    """Return (K, 13) float64 gradients by a step in each Gaussian's own axes, which means the same at any size.

    The step is ``mu + R S d``, ``log s + e``, ``q (1, w / 2)`` for unit q, then opacity logit and colour; arguments as
    of `fields_backward`. Where a covariance ``M M^T`` turns by w, so it does by ``M (I + E)`` with E symmetric.
    """
    from vvgt_cli.splat import backward

    g, p, rows = gaussians, projection, np.empty((13, len(gaussians)))
    factors = np.ascontiguousarray(axes_of(g))
    backward.exact_axes(
        p.first, pairs, p.extent, p.flat, g.means, factors, seen, *pose(camera), p.rule.projecting(), rows
    )
    a, b, c = _scales(g).T
    turns = [rows[8] * (b / c - c / b), rows[7] * (c / a - a / c), rows[6] * (a / b - b / a)]
    rows[6:9] = 0.5 * np.array(turns)
    return rows.T


def fields_backward(
    gaussians: Gaussians, camera: Camera, projection: Projection, pairs: np.ndarray, seen: np.ndarray
) -> Gradients:
    """Return `render_backward` from ``pairs``, its `pair_sums`, and the `seen_colors` (K, 3) behind them."""
    g, slopes = gaussians, step_slopes(gaussians, camera, projection, pairs, seen)
    means = np.einsum("kij,kj->ki", rotations(g.quaternions), slopes[:, :3] / _scales(g))
    (w, x, y, z), (a, b, c) = g.quaternions.T.astype(np.float64), slopes[:, 6:9].T
    product = [-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a]
    turns = np.transpose(product) * (2 / np.maximum(w * w + x * x + y * y + z * z, 1e-30))[:, None]
    parts = means, slopes[:, 3:6], turns, slopes[:, 9], slopes[:, 10:]
    out = Gradients(*(np.ascontiguousarray(part, np.float32) for part in parts))
    if g.harmonics is None:
        return out
    by_harmonics, by_means = seen_slopes(g.means, g.harmonics, camera.position, out.colors)
    return replace(out, means=out.means + by_means, harmonics=by_harmonics)


def _scales(gaussians: Gaussians) -> np.ndarray:
    """Return standard deviations (K, 3) float64, none so small or large that dividing by it fails."""
    return np.exp(np.clip(gaussians.log_scales.astype(np.float64), -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE))


def screen_slopes(projection: Projection, pairs: np.ndarray) -> np.ndarray:
    """Return the length (K,) float64 of the gradient by the projected centre in pixels, from `pair_sums`."""
    from vvgt_cli.splat import tiles

    p, sums = projection, np.zeros((len(projection.flat), 5))
    tiles.reduce_pairs(p.first, np.ascontiguousarray(pairs[:, :5]), sums)
    a, b, c = p.flat[:, 2:5].T.astype(np.float64)
    return np.hypot(a * sums[:, 1] + b * sums[:, 2], b * sums[:, 1] + c * sums[:, 2])


def pair_sums(projection: Projection, colors: np.ndarray, image: np.ndarray, grad: np.ndarray) -> np.ndarray:
    """Return (pairs, 9) float32: what the gradient needs of each (tile, Gaussian) pair, see `backward.pair_sums`."""
    from vvgt_cli.splat import backward

    p = projection
    pairs = np.empty((len(p.members), backward.SUMS), np.float32)
    grad = np.ascontiguousarray(grad, np.float32)
    backward.pair_sums(
        p.tiles, p.start, p.members, p.slots, p.extent, p.flat, colors, p.tiles_x, p.rule.blending(), image, grad, pairs
    )
    return pairs


def own_axes_backward(
    means: np.ndarray, factors: np.ndarray, colors: np.ndarray, camera: Camera, projection: Projection,
    pairs: np.ndarray, harmonics: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray | None]:  # fmt: skip
    """Return gradients for steps along each Gaussian's own axes, ``mu += M d``, ``M <- M (I + E)``, E symmetric.

    Args:
        means: (K, 3) float32.
        factors: (K, 3, 3) float32 M of covariances ``M M^T``.
        colors: (K, 3) float32, those of `seen_colors` where there are harmonics.
        camera: of the picture.
        projection: of `project_factors`.
        pairs: of `pair_sums` with ``colors``.
        harmonics: (K, M, 3) float32; None: none.

    Returns:
        (13, K) float32, a row a field: d (3), then E: xx, yy, zz, xy, xz, yz, one off the diagonal for both entries,
        opacity logit, colour (3); and (K, M, 3) float32 by the harmonics, None without them.
    """
    from vvgt_cli.splat import backward

    p, rows = projection, np.empty((13, len(means)), np.float32)
    backward.own_axes(
        p.first, pairs, p.extent, p.flat, means, factors, colors, *pose(camera), p.rule.projecting(), rows
    )
    if harmonics is None:
        return rows, None
    by_harmonics, by_means = seen_slopes(means, harmonics, camera.position, np.ascontiguousarray(rows[10:].T))
    rows[:3] += np.einsum("kji,kj->ik", factors, by_means)
    return rows, by_harmonics
