"""The buffer of a tile, for kernels that blend or differentiate: its planes, and a Gaussian's opacity within it.

A tile works in one flat float32 buffer of planes of TILE x TILE pixels, transmittance first. Loops over a row have a
fixed length, unsigned indices at constant distances and no branches: LLVM turns each into one or two vector
instructions a line (a signed index or an early exit would undo that, and a sum over rows in the same array costs 50
comparisons of addresses a Gaussian). Gaussians are fetched `CHUNK` at a time: in the order of depth they lie far apart
in memory, and a loop that does nothing else waits for many of them at once; those of the next chunk are asked for
before the present one is worked on.

``buf`` (planes x TILE x TILE,) float32; ``rule`` is `Rule.blending` as a tuple of 6 float32. Pixels are counted from
the tile's corner; in them -1/8 of a Gaussian's exponent is ``a dx^2 + b dx dy + c dy^2`` at (dx, dy) from its centre
(u, v).
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba import types

from vvgt_cli.gaussians.constants import TILE
from vvgt_cli.jit.decorators import inlined, intrinsic
from vvgt_cli.jit.numba_internals import BYTE, CODE, config, get_or_insert_function

f32: Any = np.float32  # its sums are float here: numba keeps them float32
U: Any = nb.uint64
HALF: float = f32(0.5)
ZERO: float = f32(0)
AREA = TILE * TILE
PLANE_1, PLANE_2, PLANE_3, PLANE_4 = U(AREA), U(2 * AREA), U(3 * AREA), U(4 * AREA)
PLANE_5 = U(5 * AREA)
CHUNK = 32  # Gaussians
FIELDS = U(11)  # of a Gaussian: a, b, c, u, v, opacity, first row and end of its rows in the tile, colour
FIRST_ROW, END_ROW, RED, GREEN, BLUE = U(6), U(7), U(8), U(9), U(10)
# exp(e) on [-0.75, 0] with exp(0) = 1: minimax of the relative error, 1.1e-6 after the eighth power
_EXP: tuple[float, ...] = tuple(
    f32(c)
    for c in (0.9999926580422791, 0.49986938813311016, 0.16589198457717946, 0.03960749971954136, 0.005739152125547126)
)

tile_jit = inlined(fastmath=True, error_model="numpy")


def _prefetch(typingctx: Any, rows: Any, index: Any, column: Any) -> Any:
    """Ask for the cache line of ``rows[index, column]``, a C-contiguous array (n, m); both in range, not negative."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, args[0])
        width = builder.extract_value(array.shape, 1)
        at = builder.gep(array.data, [builder.add(builder.mul(args[1], width), args[2])])
        kind = ir.FunctionType(ir.VoidType(), [BYTE, CODE, CODE, CODE])
        ask = get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(ask, [builder.bitcast(at, BYTE), CODE(0), CODE(3), CODE(1)])  # for reading, to be kept, data
        return context.get_dummy_value()

    return types.void(rows, types.int64, types.int64), codegen


prefetch: Any = (lambda rows, index, column: None) if config.DISABLE_JIT else intrinsic(_prefetch)


@tile_jit
def fetch_one(k: int, at: int, extent: np.ndarray, flat: np.ndarray, ox: int, oy: int, fetched: np.ndarray) -> None:
    """Copy Gaussian k, without its colour, into ``fetched`` from ``at`` on."""
    s, left, top = f32(-0.125), f32(ox), f32(oy)
    fetched[at] = s * HALF * flat[k, 2]
    fetched[at + U(1)] = s * flat[k, 3]
    fetched[at + U(2)] = s * HALF * flat[k, 4]
    fetched[at + U(3)] = flat[k, 0] - left
    fetched[at + U(4)] = flat[k, 1] - top
    fetched[at + U(5)] = flat[k, 5]
    fetched[at + FIRST_ROW] = f32(max(extent[k, 1] - oy, 0))
    fetched[at + END_ROW] = f32(min(extent[k, 3] - oy, TILE))


@tile_jit
def fetch(
    entries: np.ndarray, begin: int, extent: np.ndarray, flat: np.ndarray, ox: int, oy: int, fetched: np.ndarray
) -> int:
    """Copy up to `CHUNK` entries from ``begin`` into ``fetched`` (CHUNK x FIELDS,), no colours; return their number."""
    count: int = min(CHUNK, entries.shape[0] - begin)
    for i in range(count):
        fetch_one(entries[begin + i], U(i) * FIELDS, extent, flat, ox, oy, fetched)
    for index in range(begin + count, min(begin + 2 * CHUNK, entries.shape[0])):
        k = entries[index]
        prefetch(extent, k, 0)
        prefetch(flat, k, 0)
        prefetch(flat, k, 6)  # a row lies in one line or two
    return count


@tile_jit
def fetch_colors(entries: np.ndarray, begin: int, count: int, colors: np.ndarray, fetched: np.ndarray) -> None:
    """Copy the colours of ``count`` entries from ``begin`` on into their places of ``fetched``."""
    for i in range(count):
        k, at = entries[begin + i], U(i) * FIELDS
        fetched[at + RED] = colors[k, 0]
        fetched[at + GREEN] = colors[k, 1]
        fetched[at + BLUE] = colors[k, 2]
    for index in range(begin + count, min(begin + 2 * CHUNK, entries.shape[0])):
        prefetch(colors, entries[index], 0)


@tile_jit
def alpha_at(
    dx: float, a: float, h: float, q: float, opacity: float, floor: float, factor: float, offset: float
) -> float:
    """Return a pixel's opacity at dx, neither clamped nor cut; 0 beyond the rule's reach.

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
    """Set transmittance 1 where the tile lies inside the image; pixels outside have ended from the start."""
    for j in range(PLANE_1):
        buf[j] = f32(1) if j % U(TILE) < width and j // U(TILE) < height else f32(-1)


@tile_jit
def all_ended(buf: np.ndarray) -> bool:
    """Return whether no pixel of the tile is open."""
    top: float = f32(-1)
    for j in range(PLANE_1):
        top = max(top, buf[j])
    return top <= ZERO
