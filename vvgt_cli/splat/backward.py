"""Numba kernels of the gradient: sums over pixels of each Gaussian, then back through the projection.

The first half works as `tiles` does, front to back and with the same early end: what lies behind a splat is the whole
pixel less what has been blended, so nothing but the picture is kept from the forward pass. Equations: docs/optimize.md.
Twin: ``tests/splat_twin.py``.

Arguments are those of `splat.kernel` and `splat.tiles`; ``pairs`` (pairs, 9) float32 holds `SUMS` of each (tile,
Gaussian) pair, Gaussian by Gaussian; ``total`` is a Gaussian's sum of them, 9 float64.
"""

from __future__ import annotations

import numpy as np

from vvgt_cli.gaussians.constants import TILE
from vvgt_cli.jit.decorators import inlined, parallel_kernel
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
    prefetch,
    tile_jit,
)
from vvgt_cli.splat.lanes import CONIC, LANES, SLOPED, TOTALS, load_place, pose_of, slope_lanes

# alpha dL/dalpha; G = -dalpha/dp dL/dalpha, p the exponent, x dx, dy, dx^2, dx dy, dy^2; weight x dL/d(r, g, b)
SUMS = 9
_T = U(TILE)
_A0, _A1, _A2, _A3 = U(0), U(TILE), U(2 * TILE), U(3 * TILE)
_A4, _A5, _A6, _END = U(4 * TILE), U(5 * TILE), U(6 * TILE), U(7 * TILE)
_exact = inlined()


@tile_jit
def slope_at(
    raw: float, t: float, behind: float, own: float, rule: tuple[float, ...]
) -> tuple[float, float, float, float]:
    """Return a pixel's weight T alpha, dL/dalpha, and transmittance and what is ``behind`` after a Gaussian.

    ``raw`` is its alpha, not clamped, ``t`` T before it, ``own`` its colour times dL/d(image) plus dL/d(alpha).
    """
    min_alpha, max_alpha, end = rule[0], rule[1], rule[5]
    weight = min(raw, max_alpha) * t if raw >= min_alpha else ZERO
    after = t - weight
    ended = after < end
    weight = ZERO if ended else weight
    behind -= weight * own
    slope = t * (own - behind / after)
    slope = slope if weight > ZERO and raw < max_alpha else ZERO
    return weight, slope, -abs(t) if ended else after, behind


@tile_jit
def _sweep(fetched: np.ndarray, at: int, rule: tuple[float, ...], buf: np.ndarray, sums: np.ndarray) -> None:
    """Add up a column's terms of the Gaussian at ``at`` into the seven rows of ``sums`` (7 x TILE,)."""
    a, b, c, u, v = fetched[at], fetched[at + U(1)], fetched[at + U(2)], fetched[at + U(3)], fetched[at + U(4)]
    opacity = fetched[at + U(5)]
    red, green, blue = max(fetched[at + RED], ZERO), max(fetched[at + GREEN], ZERO), max(fetched[at + BLUE], ZERO)
    y0, y1 = U(fetched[at + FIRST_ROW]), U(fetched[at + END_ROW])
    floor, factor, offset = rule[2], rule[3], rule[4]
    shift = opacity * offset
    for i in range(_END):
        sums[i] = ZERO
    for y in range(y0, y1):
        dy = f32(np.int32(y)) + HALF - v
        h, q = b * dy, c * dy * dy
        for i in range(_T):
            j = y * _T + i
            raw = alpha_at(f32(np.int32(i)) + HALF - u, a, h, q, opacity, floor, factor, offset)
            own = red * buf[j + PLANE_2] + green * buf[j + PLANE_3] + blue * buf[j + PLANE_4] + buf[j + PLANE_5]
            weight, slope, buf[j], buf[j + PLANE_1] = slope_at(raw, buf[j], buf[j + PLANE_1], own, rule)
            g = (raw + shift) * slope
            sums[_A0 + i] += g
            g *= dy
            sums[_A1 + i] += g
            sums[_A2 + i] += g * dy
            sums[_A3 + i] += weight * buf[j + PLANE_2]
            sums[_A4 + i] += weight * buf[j + PLANE_3]
            sums[_A5 + i] += weight * buf[j + PLANE_4]
            sums[_A6 + i] += raw * slope


@tile_jit
def _moments_tile(
    entries: np.ndarray, slots: np.ndarray, extent: np.ndarray, flat: np.ndarray, colors: np.ndarray, ox: int, oy: int,
    rule: tuple[float, ...], buf: np.ndarray, pairs: np.ndarray,
) -> None:  # fmt: skip
    """Write the nine sums of each of the Gaussians ``entries``, in their order, into their rows of ``pairs``.

    Rows lie far apart in memory, and a store that waits for its line would hold up the next Gaussian's loads from the
    stack: those of a chunk are written together.
    """
    fetched, sums = np.empty(CHUNK * FIELDS, np.float32), np.empty(_END, np.float32)
    own = np.empty((CHUNK, SUMS), np.float32)
    for begin in range(0, entries.shape[0], CHUNK):
        if begin > 0 and all_ended(buf):
            for index in range(begin, entries.shape[0]):
                pairs[slots[index]] = ZERO
            break
        count = fetch(entries, begin, extent, flat, ox, oy, fetched)
        fetch_colors(entries, begin, count, colors, fetched)
        for index in range(begin, begin + count):
            prefetch(pairs, slots[index], 0)
            prefetch(pairs, slots[index], SUMS - 1)
        for index in range(count):
            at = U(index) * FIELDS
            u = fetched[at + U(3)]
            _sweep(fetched, at, rule, buf, sums)
            s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = ZERO
            for i in range(_T):
                dx = f32(np.int32(i)) + HALF - u
                s0 += sums[_A6 + i]
                s1 += sums[_A0 + i] * dx
                s2 += sums[_A1 + i]
                s3 += sums[_A0 + i] * dx * dx
                s4 += sums[_A1 + i] * dx
                s5 += sums[_A2 + i]
                s6 += sums[_A3 + i]
                s7 += sums[_A4 + i]
                s8 += sums[_A5 + i]
            own[index, 0], own[index, 1], own[index, 2], own[index, 3], own[index, 4] = s0, s1, s2, s3, s4
            own[index, 5], own[index, 6], own[index, 7], own[index, 8] = s5, s6, s7, s8
        for index in range(count):
            for f in range(SUMS):
                pairs[slots[begin + index], f] = own[index, f]


@parallel_kernel("i8:1 i8:1 i4:1 i8:1 i4:2 f4:2 f4:2 i8 f4:1 f4:3 f4:3 f4:2", fastmath=True, error_model="numpy")
def pair_sums(
    thread: ThreadSlice,
    tiles: np.ndarray, start: np.ndarray, members: np.ndarray, slots: np.ndarray, extent: np.ndarray, flat: np.ndarray,
    colors: np.ndarray, tiles_x: int, rule: np.ndarray, image: np.ndarray, grad: np.ndarray, pairs: np.ndarray,
) -> None:  # fmt: skip
    """Write each (tile, Gaussian) pair's nine `SUMS` into ``pairs`` (n, 9) float32.

    ``image`` (h, w, 4) float32 is what `tiles.blend` made of ``colors`` clamped at 0, ``grad`` (h, w, 4) dL/d(image),
    float32.
    """
    height, width = image.shape[:2]
    way = rule[0], rule[1], rule[2], rule[3], rule[4], rule[5]
    index = next_iteration(thread)
    while index < tiles.shape[0]:
        tile = tiles[index]
        ox, oy = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        w, h = min(TILE, width - ox), min(TILE, height - oy)
        buf = np.zeros(6 * AREA, np.float32)  # transmittance, what is behind, dL/d(r, g, b, a)
        open_tile(buf, w, h)
        for y in range(h):
            for x in range(w):
                behind = ZERO
                for f in range(4):
                    g = grad[oy + y, ox + x, f]
                    behind += image[oy + y, ox + x, f] * g
                    buf[U((f + 2) * AREA + y * TILE + x)] = g
                buf[U(AREA + y * TILE + x)] = behind
        span = slice(start[tile], start[tile + 1])
        _moments_tile(members[span], slots[span], extent, flat, colors, ox, oy, way, buf, pairs)
        index = next_iteration(thread)


@_exact
def total_of(pairs: np.ndarray, begin: int, end: int) -> tuple[float, ...]:
    """Sum of a Gaussian's pairs, 9 float64, in a fixed order; a tuple: an array would be allocated for each."""
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = 0.0
    for p in range(begin, end):
        s0, s1, s2 = s0 + pairs[p, 0], s1 + pairs[p, 1], s2 + pairs[p, 2]
        s3, s4, s5 = s3 + pairs[p, 3], s4 + pairs[p, 4], s5 + pairs[p, 5]
        s6, s7, s8 = s6 + pairs[p, 6], s7 + pairs[p, 7], s8 + pairs[p, 8]
    return s0, s1, s2, s3, s4, s5, s6, s7, s8


@_exact
def _load_slope(
    buf: np.ndarray, i: int, k: int, flat: np.ndarray, means: np.ndarray, factors: np.ndarray, total: tuple[float, ...]
) -> None:
    """Load Gaussian k into lane i, for `slope_lanes`."""
    load_place(buf, U(i), k, means, factors)
    for f in range(3):
        buf[U((CONIC + f) * LANES + i)] = flat[k, 2 + f]
    for f in range(SUMS):
        buf[U((TOTALS + f) * LANES + i)] = total[f]


def _own_axes(
    thread: ThreadSlice,
    first: np.ndarray, pairs: np.ndarray, extent: np.ndarray, flat: np.ndarray, means: np.ndarray, factors: np.ndarray,
    colors: np.ndarray, rot: np.ndarray, trans: np.ndarray, lens: np.ndarray, rule: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Write gradients for steps along each Gaussian's own axes: mu += M d, M <- M (I + E), E symmetric.

    ``out`` (13, K), a row a field: d (3), then E: xx, yy, zz, xy, xz, yz (an entry off the diagonal stands for both),
    opacity logit, colour (3). Every row is written.
    """
    count, pose, way = means.shape[0], pose_of(rot, trans), (lens[0], lens[1])
    for chunk in iterations(thread, (count + LANES - 1) // LANES):
        begin, end = chunk * LANES, min((chunk + 1) * LANES, count)
        buf, seen = np.ones(SLOPED * LANES), np.zeros(LANES, np.bool_)
        for k in range(begin, end):
            i = k - begin
            seen[i] = extent[k, 2] > extent[k, 0]
            if seen[i]:
                total = total_of(pairs, first[k], first[k + 1])
                _load_slope(buf, i, k, flat, means, factors, total)
                out[9, k] = total[0] * (1.0 - flat[k, 6])
                out[10, k] = total[6] if colors[k, 0] >= 0.0 else 0.0
                out[11, k] = total[7] if colors[k, 1] >= 0.0 else 0.0
                out[12, k] = total[8] if colors[k, 2] >= 0.0 else 0.0
            else:
                out[9, k] = out[10, k] = out[11, k] = out[12, k] = 0.0
        slope_lanes(buf, pose, way, rule[0], rule[1])
        for f in range(9):
            for k in range(begin, end):
                out[f, k] = buf[U(f * LANES + k - begin)] if seen[k - begin] else 0.0


AXES = "i8:1 f4:2 i4:2 f4:2 f4:2 {0}:3 f4:2 f8:2 f8:1 f8:1 f8:1 {0}:2"
own_axes = parallel_kernel(AXES.format("f4"), name="own_axes")(_own_axes)
exact_axes = parallel_kernel(AXES.format("f8"), name="exact_axes")(_own_axes)  # of which gradients of fields are made
