"""Numba kernels of the splatter's second half: blending tiles and back-projecting images. Twin: `splat.reference`.

A projection is ``flat`` (K, 7) float32, ``extent`` (K, 4) int32, ``start`` (tiles + 1,), ``members`` (pairs,),
``slots`` (pairs,), ``first`` (K + 1,) as `splat.kernel` fills them; ``tiles`` (n,) int64 the tiles to draw, in the
order in which threads take them, ``tiles_x`` in a row of the image; ``rule`` (6,) float32 from `Rule.blending`.
``colors`` (K, 3) float32. In a tile: ``entries`` (m,) its Gaussians, (``ox``, ``oy``) its corner in pixels, ``buf`` its
buffer, ``fetched`` what `buffer.fetch` fills.
"""

from __future__ import annotations

import numpy as np

from vvgt_cli.gaussians.constants import TILE
from vvgt_cli.jit.decorators import parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations, next_iteration
from vvgt_cli.splat.buffer import (
    AREA,
    BLUE,
    CHUNK,
    END_ROW,
    FIELDS,
    FIRST_ROW,
    GREEN,
    HALF,
    PLANE_1,
    PLANE_2,
    PLANE_3,
    PLANE_4,
    PLANE_5,
    RED,
    ZERO,
    U,
    all_ended,
    alpha_at,
    f32,
    fetch,
    fetch_colors,
    open_tile,
    tile_jit,
)


@tile_jit
def blend_pixel(
    t: float, dx: float, a: float, h: float, q: float, opacity: float, rule: tuple[float, ...]
) -> tuple[float, float]:
    """Return a pixel's weight T alpha and its transmittance afterwards; one that has ended keeps T with a minus.

    ``t`` is T before; other arguments as of `alpha_at`.
    """
    min_alpha, max_alpha, floor, factor, offset, end = rule
    alpha = min(alpha_at(dx, a, h, q, opacity, floor, factor, offset), max_alpha)
    weight = alpha * t if alpha >= min_alpha else ZERO
    after = t - weight
    ended = after < end
    return ZERO if ended else weight, -abs(t) if ended else after


@tile_jit
def _blend_tile(
    entries: np.ndarray, extent: np.ndarray, flat: np.ndarray, colors: np.ndarray, ox: int, oy: int,
    rule: tuple[float, ...], buf: np.ndarray,
) -> None:  # fmt: skip
    """Blend the Gaussians ``entries`` in their order into planes 1, 2, 3."""
    fetched = np.empty(CHUNK * FIELDS, np.float32)
    for begin in range(0, entries.shape[0], CHUNK):
        if begin > 0 and all_ended(buf):
            break
        count = fetch(entries, begin, extent, flat, ox, oy, fetched)
        fetch_colors(entries, begin, count, colors, fetched)
        for index in range(count):
            at = U(index) * FIELDS
            a, b, c, u, v = fetched[at], fetched[at + U(1)], fetched[at + U(2)], fetched[at + U(3)], fetched[at + U(4)]
            opacity = fetched[at + U(5)]
            red, green, blue = fetched[at + RED], fetched[at + GREEN], fetched[at + BLUE]
            y0, y1 = U(fetched[at + FIRST_ROW]), U(fetched[at + END_ROW])
            for y in range(y0, y1):
                dy = f32(np.int32(y)) + HALF - v
                h, q = b * dy, c * dy * dy
                for i in range(U(TILE)):
                    j = y * U(TILE) + i
                    weight, buf[j] = blend_pixel(buf[j], f32(np.int32(i)) + HALF - u, a, h, q, opacity, rule)
                    buf[j + PLANE_1] += weight * red
                    buf[j + PLANE_2] += weight * green
                    buf[j + PLANE_3] += weight * blue


@parallel_kernel("i8:1 i8:1 i4:1 i4:2 f4:2 f4:2 i8 f4:1 f4:3", fastmath=True, error_model="numpy")
def blend(
    thread: ThreadSlice,
    tiles: np.ndarray, start: np.ndarray, members: np.ndarray, extent: np.ndarray, flat: np.ndarray, colors: np.ndarray,
    tiles_x: int, rule: np.ndarray, image: np.ndarray,
) -> None:  # fmt: skip
    """Blend front to back into ``image`` (height, width, 4) float32, linear in ``colors``."""
    height, width = image.shape[:2]
    way = rule[0], rule[1], rule[2], rule[3], rule[4], rule[5]
    index = next_iteration(thread)
    while index < tiles.shape[0]:
        tile = tiles[index]
        ox, oy = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        w, h = min(TILE, width - ox), min(TILE, height - oy)
        buf = np.zeros(4 * AREA, np.float32)  # transmittance, r, g, b
        open_tile(buf, w, h)
        _blend_tile(members[start[tile] : start[tile + 1]], extent, flat, colors, ox, oy, way, buf)
        for y in range(h):
            for x in range(w):
                j = U(y * TILE + x)
                image[oy + y, ox + x, 0] = buf[j + PLANE_1]
                image[oy + y, ox + x, 1] = buf[j + PLANE_2]
                image[oy + y, ox + x, 2] = buf[j + PLANE_3]
                image[oy + y, ox + x, 3] = f32(1) - abs(buf[j])
        index = next_iteration(thread)


@tile_jit
def _gather_tile(
    entries: np.ndarray, slots: np.ndarray, extent: np.ndarray, flat: np.ndarray, ox: int, oy: int,
    rule: tuple[float, ...], buf: np.ndarray, pairs: np.ndarray,
) -> None:  # fmt: skip
    """Write each Gaussian's weights into plane 1, then their sum and products with planes 2 to 5 into ``pairs``."""
    fetched = np.empty(CHUNK * FIELDS, np.float32)
    for begin in range(0, entries.shape[0], CHUNK):
        if begin > 0 and all_ended(buf):
            break
        for index in range(fetch(entries, begin, extent, flat, ox, oy, fetched)):
            at = U(index) * FIELDS
            a, b, c, u, v = fetched[at], fetched[at + U(1)], fetched[at + U(2)], fetched[at + U(3)], fetched[at + U(4)]
            opacity = fetched[at + U(5)]
            y0, y1 = U(fetched[at + FIRST_ROW]), U(fetched[at + END_ROW])
            for y in range(y0, y1):
                dy = f32(np.int32(y)) + HALF - v
                h, q = b * dy, c * dy * dy
                for i in range(U(TILE)):
                    j = y * U(TILE) + i
                    buf[j + PLANE_1], buf[j] = blend_pixel(buf[j], f32(np.int32(i)) + HALF - u, a, h, q, opacity, rule)
            s0 = s1 = s2 = s3 = s4 = ZERO
            for j in range(y0 * U(TILE), y1 * U(TILE)):
                weight = buf[j + PLANE_1]
                s0 += weight
                s1 += weight * buf[j + PLANE_2]
                s2 += weight * buf[j + PLANE_3]
                s3 += weight * buf[j + PLANE_4]
                s4 += weight * buf[j + PLANE_5]
            slot = slots[begin + index]
            pairs[slot, 0], pairs[slot, 1], pairs[slot, 2], pairs[slot, 3], pairs[slot, 4] = s0, s1, s2, s3, s4


@parallel_kernel("i8:1 i8:1 i4:1 i8:1 i4:2 f4:2 i8 f4:1 f4:3 f4:2", fastmath=True, error_model="numpy")
def gather(
    thread: ThreadSlice,
    tiles: np.ndarray, start: np.ndarray, members: np.ndarray, slots: np.ndarray, extent: np.ndarray, flat: np.ndarray,
    tiles_x: int, rule: np.ndarray, fields: np.ndarray, pairs: np.ndarray,
) -> None:  # fmt: skip
    """Sum w and w x 4 ``fields`` (4, h, w) over the pixels of each (tile, Gaussian) pair, w = T alpha.

    ``fields`` and ``pairs`` (pairs, 5) float32; these must be zero on entry: entries that no open pixel reaches stay
    zero.
    """
    height, width = fields.shape[1:]
    way = rule[0], rule[1], rule[2], rule[3], rule[4], rule[5]
    index = next_iteration(thread)
    while index < tiles.shape[0]:
        tile = tiles[index]
        ox, oy = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        w, h = min(TILE, width - ox), min(TILE, height - oy)
        buf = np.zeros(6 * AREA, np.float32)  # transmittance, weight, 4 fields
        open_tile(buf, w, h)
        for f in range(4):
            for y in range(h):
                for x in range(w):
                    buf[U((f + 2) * AREA + y * TILE + x)] = fields[f, oy + y, ox + x]
        span = slice(start[tile], start[tile + 1])
        _gather_tile(members[span], slots[span], extent, flat, ox, oy, way, buf, pairs)
        index = next_iteration(thread)


@parallel_kernel("i8:1 f4:2 f8:2")
def reduce_pairs(thread: ThreadSlice, first: np.ndarray, pairs: np.ndarray, out: np.ndarray) -> None:
    """Add each Gaussian's pairs, in a fixed order: ``out`` (K, 5) float64 += sums of rows of ``pairs`` (pairs, 5)."""
    for k in iterations(thread, first.shape[0] - 1):
        for p in range(first[k], first[k + 1]):
            for c in range(5):
                out[k, c] += pairs[p, c]
