"""Empty-space map: value ranges of bricks and, under a transfer function, the distance to anything visible."""

from __future__ import annotations

import numpy as np

from vvgt_cli.dvr.layout import BRICK
from vvgt_cli.jit.decorators import parallel_kernel
from vvgt_cli.jit.parts import Part, turns_of
from vvgt_cli.look.tables import Optics

MAX_DISTANCE = 15  # bricks; a longer leap saves nothing measurable


@parallel_kernel("V f8 f8 f8:4")
def _ranges(part: Part, values: np.ndarray, least: float, most: float, out: np.ndarray) -> None:
    """Finite range over each brick of ``values`` (nz, ny, nx) and its upper neighbours; ``out`` (bz, by, bx, 2).

    The values' type goes from ``least`` to ``most``.
    """
    nz, ny, nx = values.shape
    bz, by, bx = out.shape[:3]
    for flat in turns_of(part, bz * by):
        z0, y0 = (flat // by) * BRICK, (flat % by) * BRICK
        low, high, ends = np.empty(nx, values.dtype), np.empty(nx, values.dtype), np.empty(2, values.dtype)
        ends[0], ends[1] = least, most
        low[:], high[:] = ends[1], ends[0]
        for z in range(z0, min(z0 + BRICK + 1, nz)):
            for y in range(y0, min(y0 + BRICK + 1, ny)):
                row = values[z, y]
                for x in range(nx):  # whole rows: so many at once as the processor can
                    v = row[x]
                    low[x] = v if (v < low[x]) & (v >= ends[0]) else low[x]
                    high[x] = v if (v > high[x]) & (v <= ends[1]) else high[x]
        for b in range(bx):
            lo, hi = np.inf, -np.inf
            for x in range(b * BRICK, min(b * BRICK + BRICK + 1, nx)):
                lo, hi = min(lo, np.float64(low[x])), max(hi, np.float64(high[x]))
            none = lo > hi  # a type's own ends, where no voxel is finite
            out[z0 // BRICK, y0 // BRICK, b, 0] = np.inf if none else lo
            out[z0 // BRICK, y0 // BRICK, b, 1] = -np.inf if none else hi


def brick_ranges(values: np.ndarray) -> np.ndarray:
    """Smallest and largest finite value over each brick and its upper neighbours.

    ``values`` (nz, ny, nx) -> (bz, by, bx, 2) float64; (inf, -inf) where a brick has no finite voxel.
    """
    shape = tuple(-(-n // BRICK) for n in values.shape)
    out = np.empty((*shape, 2))
    about = np.finfo(values.dtype) if values.dtype.kind == "f" else np.iinfo(values.dtype)
    _ranges(values, float(about.min), float(about.max), out)
    return out


def empty_distance(ranges: np.ndarray, tables: Optics) -> np.ndarray:
    """Chebyshev distance in bricks to the nearest one whose value range has extinction, (bz, by, bx) uint8."""
    positive = np.concatenate([[0], np.cumsum(tables.nodes[:, 3] > 0)])
    none = ranges[..., 1] < ranges[..., 0]
    u = tables.coordinate(np.where(none[..., None], tables.lo, ranges))
    first = np.floor(u.min(axis=-1)).astype(np.int64)
    last = np.ceil(u.max(axis=-1)).astype(np.int64)
    active = (positive[last + 1] > positive[first]) & ~none
    distance = np.full(active.shape, MAX_DISTANCE, np.uint8)
    distance[active] = 0
    for d in range(1, MAX_DISTANCE):
        grown = dilate(active)
        if grown.sum() == active.sum():
            break
        distance[grown & ~active] = d
        active = grown
    return distance


def dilate(mask: np.ndarray) -> np.ndarray:
    """Chebyshev dilation by one cell."""
    out = mask
    for axis in range(3):
        grown = out.copy()
        ahead = [slice(None)] * 3
        behind = [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        grown[tuple(ahead)] |= out[tuple(behind)]
        grown[tuple(behind)] |= out[tuple(ahead)]
        out = grown
    return out
