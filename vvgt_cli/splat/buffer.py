"""The buffer of a tile, for kernels that blend or differentiate: its planes, and a Gaussian's opacity within it.

A tile works in one flat float32 buffer of planes of TILE x TILE pixels, transmittance first. Loops over a row have a
fixed length, unsigned indices at constant distances and no branches: LLVM turns each into one or two vector
instructions a line (a signed index, a second array or an early exit would undo that).

``buf`` (planes x TILE x TILE,) float32; ``rule`` is `Rule.blending` as a tuple of 6 float32. Pixels are counted from
the tile's corner; in them -1/8 of a Gaussian's exponent is ``a dx^2 + b dx dy + c dy^2`` at (dx, dy) from its centre
(u, v).
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from vvgt_cli.jit.decorators import inlined
from vvgt_cli.splat.constants import TILE

f32: Any = np.float32  # its sums are float here: numba keeps them float32
U: Any = nb.uint64
HALF: float = f32(0.5)
ZERO: float = f32(0)
AREA = TILE * TILE
PLANE_1, PLANE_2, PLANE_3, PLANE_4 = U(AREA), U(2 * AREA), U(3 * AREA), U(4 * AREA)
PLANE_5 = U(5 * AREA)
# exp(e) on [-0.75, 0] with exp(0) = 1: minimax of the relative error, 1.1e-6 after the eighth power
_EXP: tuple[float, ...] = tuple(
    f32(c)
    for c in (0.9999926580422791, 0.49986938813311016, 0.16589198457717946, 0.03960749971954136, 0.005739152125547126)
)

tile_jit = inlined(fastmath=True, error_model="numpy")


@tile_jit
def scaled_conic(flat: np.ndarray, k: int, ox: float, oy: float) -> tuple[float, ...]:
    """a, b, c, u, v and opacity of row k of ``flat`` (K, 7), relative to a tile with its corner at pixel (ox, oy)."""
    s = f32(-0.125)
    return s * HALF * flat[k, 2], s * flat[k, 3], s * HALF * flat[k, 4], flat[k, 0] - ox, flat[k, 1] - oy, flat[k, 5]


@tile_jit
def _misses(y: int, a: float, b: float, c: float, u: float, v: float, floor: float) -> bool:
    """Whether the largest exponent along pixel row y of the tile is below ``floor``."""
    dy: float = f32(y) + HALF - v
    h = b * dy
    dx: float = min(max(HALF * h / (f32(1e-30) - a), HALF - u), f32(TILE - 0.5) - u)  # a <= 0, and may underflow to 0
    return (a * dx + h) * dx + c * dy * dy < floor


@tile_jit
def rows(
    y0: int, y1: int, a: float, b: float, c: float, u: float, v: float, opacity: float, rule: tuple[float, ...]
) -> tuple[int, int]:
    """Rows [y0, y1) of the tile without those at either end that the ellipse of what is drawn, being convex, misses."""
    floor = max(f32(0.125) * math.log(rule[0] / opacity), rule[2]) - f32(1e-4)
    y0, y1 = max(y0, 0), min(y1, TILE)
    while y0 < y1 and _misses(y0, a, b, c, u, v, floor):
        y0 += 1
    while y1 > y0 and _misses(y1 - 1, a, b, c, u, v, floor):
        y1 -= 1
    return U(y0), U(y1)


@tile_jit
def alpha_at(
    dx: float, a: float, h: float, q: float, opacity: float, floor: float, factor: float, offset: float
) -> float:
    """Opacity of a pixel at dx, neither clamped nor cut; 0 beyond the rule's reach.

    ``h`` = b dy and ``q`` = c dy^2 of its row; ``floor``, ``factor``, ``offset`` of the rule.
    """
    power = (a * dx + h) * dx + q
    e = max(power, floor)
    p: float = f32(1) + e * (_EXP[0] + e * (_EXP[1] + e * (_EXP[2] + e * (_EXP[3] + e * _EXP[4]))))
    p *= p
    p *= p
    drawn = opacity * (factor * (p * p) - offset)
    return drawn if power >= floor else ZERO


@tile_jit
def open_tile(buf: np.ndarray, width: int, height: int) -> None:
    """Transmittance 1 where the tile lies inside the image; pixels outside have ended from the start."""
    for j in range(PLANE_1):
        buf[j] = f32(1) if j % U(TILE) < width and j // U(TILE) < height else f32(-1)


@tile_jit
def all_ended(buf: np.ndarray) -> bool:
    """Whether no pixel of the tile is open."""
    top: float = f32(-1)
    for j in range(PLANE_1):
        top = max(top, buf[j])
    return top <= ZERO
