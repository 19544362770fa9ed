"""Numba kernels of the splatter's second half: blending tiles and back-projecting images. Twin: `splat.reference`.

A tile works in one flat float32 buffer of planes of TILE x TILE pixels, transmittance first. Loops over a row have a
fixed length, unsigned indices at constant distances and no branches: LLVM turns each into one or two vector
instructions a line (a signed index, a second array or an early exit would undo that).
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from vvgt_cli.jit.decorators import inlined, kernel
from vvgt_cli.splat.constants import TILE

f32, U = np.float32, nb.uint64
_HALF, _ZERO = f32(0.5), f32(0)
_AREA = TILE * TILE
_P1, _P2, _P3, _P4 = U(_AREA), U(2 * _AREA), U(3 * _AREA), U(4 * _AREA)
_P5 = U(5 * _AREA)
# exp(e) on [-0.75, 0] with exp(0) = 1: minimax of the relative error, 1.1e-6 after the eighth power
_EXP = tuple(
    f32(c)
    for c in (0.9999926580422791, 0.49986938813311016, 0.16589198457717946, 0.03960749971954136, 0.005739152125547126)
)

_jit = inlined(fastmath=True, error_model="numpy")


@_jit
def _eighth(flat, k, ox, oy):
    """Gaussian k relative to its tile: -1/8 of the exponent is ``a dx^2 + b dx dy + c dy^2``; centre u, v; opacity."""
    s = f32(-0.125)
    return s * _HALF * flat[k, 2], s * flat[k, 3], s * _HALF * flat[k, 4], flat[k, 0] - ox, flat[k, 1] - oy, flat[k, 5]


@_jit
def _misses(y, a, b, c, u, v, floor):
    """Whether the largest exponent along pixel row y of the tile is below ``floor``."""
    dy = f32(y) + _HALF - v
    h = b * dy
    dx = min(max(_HALF * h / (f32(1e-30) - a), _HALF - u), f32(TILE - 0.5) - u)  # a <= 0, and may underflow to 0
    return (a * dx + h) * dx + c * dy * dy < floor


@_jit
def _rows(y0, y1, a, b, c, u, v, opacity, rule):
    """Rows [y0, y1) of the tile without those at either end that the ellipse of what is drawn, being convex, misses."""
    floor = max(f32(0.125) * math.log(rule[0] / opacity), rule[2]) - f32(1e-4)
    y0, y1 = max(y0, 0), min(y1, TILE)
    while y0 < y1 and _misses(y0, a, b, c, u, v, floor):
        y0 += 1
    while y1 > y0 and _misses(y1 - 1, a, b, c, u, v, floor):
        y1 -= 1
    return U(y0), U(y1)


@_jit
def _alpha(dx, a, h, q, opacity, floor, factor, offset):
    """Opacity of a pixel, neither clamped nor cut; 0 beyond the rule's reach."""
    power = (a * dx + h) * dx + q
    e = max(power, floor)
    p = f32(1) + e * (_EXP[0] + e * (_EXP[1] + e * (_EXP[2] + e * (_EXP[3] + e * _EXP[4]))))
    p *= p
    p *= p
    drawn = opacity * (factor * (p * p) - offset)
    return drawn if power >= floor else _ZERO


@_jit
def _pixel(t, dx, a, h, q, opacity, rule):
    """Weight T alpha of a pixel and its transmittance afterwards; a pixel that has ended keeps T with a minus."""
    min_alpha, max_alpha, floor, factor, offset, end = rule
    alpha = min(_alpha(dx, a, h, q, opacity, floor, factor, offset), max_alpha)
    weight = alpha * t if alpha >= min_alpha else _ZERO
    after = t - weight
    ended = after < end
    return _ZERO if ended else weight, -abs(t) if ended else after


@_jit
def _open(buf, width, height):
    """Transmittance 1 where the tile lies inside the image; pixels outside have ended from the start."""
    for j in range(_P1):
        buf[j] = f32(1) if j % U(TILE) < width and j // U(TILE) < height else f32(-1)


@_jit
def _all_ended(buf):
    top = f32(-1)
    for j in range(_P1):
        top = max(top, buf[j])
    return top <= _ZERO


@_jit
def _blend_tile(entries, extent, flat, colors, ox, oy, rule, buf):
    """Blend the Gaussians ``entries`` in their order into planes 1, 2, 3."""
    for index in range(entries.shape[0]):
        if (index & 31) == 31 and _all_ended(buf):
            break
        k = entries[index]
        a, b, c, u, v, opacity = _eighth(flat, k, f32(ox), f32(oy))
        red, green, blue = colors[k, 0], colors[k, 1], colors[k, 2]
        y0, y1 = _rows(extent[k, 1] - oy, extent[k, 3] - oy, a, b, c, u, v, opacity, rule)
        for y in range(y0, y1):
            dy = f32(np.int32(y)) + _HALF - v
            h, q = b * dy, c * dy * dy
            for i in range(U(TILE)):
                j = y * U(TILE) + i
                weight, buf[j] = _pixel(buf[j], f32(np.int32(i)) + _HALF - u, a, h, q, opacity, rule)
                buf[j + _P1] += weight * red
                buf[j + _P2] += weight * green
                buf[j + _P3] += weight * blue


@kernel(
    "i8:1 i8:1 i4:1 i4:2 f4:2 f4:2 i8 f4:1 f4:3",
    parallel=True,
    fastmath=True,
    error_model="numpy",
)
def blend(tiles, start, members, extent, flat, colors, tiles_x, rule, image):
    """Front-to-back blending into ``image`` (height, width, 4) float32, linear in ``colors`` (K, 3) float32.

    ``tiles`` are the tiles to draw, in the order in which threads take them; ``rule`` from `Rule.blending`.
    """
    height, width = image.shape[:2]
    way = rule[0], rule[1], rule[2], rule[3], rule[4], rule[5]
    for index in nb.prange(tiles.shape[0]):
        tile = tiles[index]
        ox, oy = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        w, h = min(TILE, width - ox), min(TILE, height - oy)
        buf = np.zeros(4 * _AREA, np.float32)  # transmittance, r, g, b
        _open(buf, w, h)
        _blend_tile(members[start[tile] : start[tile + 1]], extent, flat, colors, ox, oy, way, buf)
        for y in range(h):
            for x in range(w):
                j = U(y * TILE + x)
                image[oy + y, ox + x, 0] = buf[j + _P1]
                image[oy + y, ox + x, 1] = buf[j + _P2]
                image[oy + y, ox + x, 2] = buf[j + _P3]
                image[oy + y, ox + x, 3] = f32(1) - abs(buf[j])


@_jit
def _gather_tile(entries, slots, extent, flat, ox, oy, rule, buf, pairs):
    """Weights of each Gaussian into plane 1, then their sum and their products with planes 2 to 5."""
    for index in range(entries.shape[0]):
        if (index & 31) == 31 and _all_ended(buf):
            break
        k = entries[index]
        a, b, c, u, v, opacity = _eighth(flat, k, f32(ox), f32(oy))
        y0, y1 = _rows(extent[k, 1] - oy, extent[k, 3] - oy, a, b, c, u, v, opacity, rule)
        for y in range(y0, y1):
            dy = f32(np.int32(y)) + _HALF - v
            h, q = b * dy, c * dy * dy
            for i in range(U(TILE)):
                j = y * U(TILE) + i
                buf[j + _P1], buf[j] = _pixel(buf[j], f32(np.int32(i)) + _HALF - u, a, h, q, opacity, rule)
        s0 = s1 = s2 = s3 = s4 = _ZERO
        for j in range(y0 * U(TILE), y1 * U(TILE)):  # type: ignore[assignment]
            weight = buf[j + _P1]
            s0 += weight
            s1 += weight * buf[j + _P2]
            s2 += weight * buf[j + _P3]
            s3 += weight * buf[j + _P4]
            s4 += weight * buf[j + _P5]
        slot = slots[index]
        pairs[slot, 0], pairs[slot, 1], pairs[slot, 2], pairs[slot, 3], pairs[slot, 4] = s0, s1, s2, s3, s4


@kernel(
    "i8:1 i8:1 i4:1 i8:1 i4:2 f4:2 i8 f4:1 f4:3 f4:2",
    parallel=True,
    fastmath=True,
    error_model="numpy",
)
def gather(tiles, start, members, slots, extent, flat, tiles_x, rule, fields, pairs):
    """For each (tile, Gaussian) pair: sums over its pixels of w and of w x 4 ``fields`` (4, h, w), w = T alpha.

    ``pairs`` (n, 5) float32 must be zero on entry: entries that no open pixel reaches stay zero.
    """
    height, width = fields.shape[1:]
    way = rule[0], rule[1], rule[2], rule[3], rule[4], rule[5]
    for index in nb.prange(tiles.shape[0]):
        tile = tiles[index]
        ox, oy = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        w, h = min(TILE, width - ox), min(TILE, height - oy)
        buf = np.zeros(6 * _AREA, np.float32)  # transmittance, weight, 4 fields
        _open(buf, w, h)
        for f in range(4):
            for y in range(h):
                for x in range(w):
                    buf[U((f + 2) * _AREA + y * TILE + x)] = fields[f, oy + y, ox + x]
        span = slice(start[tile], start[tile + 1])
        _gather_tile(members[span], slots[span], extent, flat, ox, oy, way, buf, pairs)


@kernel("i8:1 f4:2 f8:2", parallel=True)
def reduce_pairs(first, pairs, out):
    """Add each Gaussian's pairs, in a fixed order: out (K, 5) float64 += sums."""
    for k in nb.prange(first.shape[0] - 1):
        for p in range(first[k], first[k + 1]):
            for c in range(5):
                out[k, c] += pairs[p, c]
