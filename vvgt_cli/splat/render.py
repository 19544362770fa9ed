"""`render`: a picture of Gaussians as the standard viewers show it; `Projection` is its reusable first half."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.splat.constants import TILE


@dataclass(frozen=True)
class Projection:
    """Gaussians projected into one camera and sorted into tiles.

    Attributes:
        flat: (K, 6) float32 centre x, y (px), conic a, b, c (px^-2), opacity.
        extent: (K, 4) int32 pixel boxes x0, y0, x1, y1; empty where not seen.
        start, members, slots, first: tile lists, see `kernel.tile_lists`.
        tiles_x: tiles along a row.
        tiles: (tiles,) order in which threads take the tiles.
    """

    flat: np.ndarray
    extent: np.ndarray
    start: np.ndarray
    members: np.ndarray
    slots: np.ndarray
    first: np.ndarray
    tiles_x: int
    tiles: np.ndarray


def project(gaussians: Gaussians, camera: Camera) -> Projection:
    """EWA projection and depth-sorted tile lists."""
    from vvgt_cli.splat import kernel

    count = len(gaussians)
    flat = np.zeros((count, 6), np.float32)
    depth = np.zeros(count, np.float32)
    extent = np.zeros((count, 4), np.int32)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height], np.float64)
    kernel.project(
        gaussians.means,
        gaussians.log_scales,
        gaussians.quaternions,
        gaussians.opacity_logits,
        np.ascontiguousarray(camera.rotation),
        np.ascontiguousarray(camera.translation),
        lens,
        flat,
        depth,
        extent,
    )
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    start, members, slots, first = kernel.tile_lists(depth_order(depth), extent, tiles_x, tiles_y)
    return Projection(flat, extent, start, members, slots, first, tiles_x, deal(np.diff(start)))


def depth_order(depth: np.ndarray) -> np.ndarray:
    """Stable order of depths (K,) float32 >= 0, whose bits sort as integers; unique keys make any sort stable."""
    keys = depth.view(np.uint32).astype(np.uint64) << np.uint64(32) | np.arange(len(depth), dtype=np.uint64)
    keys.sort()
    return (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)


def deal(work: np.ndarray) -> np.ndarray:
    """Order (n,) of tasks that gives contiguous chunks, one a thread, near equal shares of ``work`` (n,)."""
    import numba

    threads = numba.get_num_threads()
    order = np.argsort(-work, kind="stable")
    return np.concatenate([order[thread::threads] for thread in range(threads)])


def blend(projection: Projection, colors: np.ndarray, height: int, width: int) -> np.ndarray:
    """(height, width, 4) float32 premultiplied RGBA, linear in ``colors`` (K, 3) float32, which may be negative."""
    from vvgt_cli.splat import tiles

    p = projection
    image = np.zeros((height, width, 4), np.float32)
    colors = np.ascontiguousarray(colors, np.float32)
    tiles.blend(p.tiles, p.start, p.members, p.extent, p.flat, colors, p.tiles_x, image)
    return image


def render(gaussians: Gaussians, camera: Camera, projection: Projection | None = None) -> np.ndarray:
    """(height, width, 4) float32 premultiplied RGBA over nothing (conventions: Gaussians); negative colours are 0."""
    p = projection or project(gaussians, camera)
    return blend(p, np.maximum(gaussians.colors, 0), camera.height, camera.width)


def gather(projection: Projection, fields: np.ndarray, out: np.ndarray) -> None:
    """Back-project images: ``out`` (K, 5) float64 += sums of w and of w x ``fields`` (4, h, w) float32, w = T alpha."""
    from vvgt_cli.splat import tiles

    p = projection
    pairs = np.zeros((len(p.members), 5), np.float32)
    fields = np.ascontiguousarray(fields, np.float32)
    tiles.gather(p.tiles, p.start, p.members, p.slots, p.extent, p.flat, p.tiles_x, fields, pairs)
    tiles.reduce_pairs(p.first, pairs, out)
