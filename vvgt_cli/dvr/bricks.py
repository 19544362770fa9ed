"""Empty-space map: value ranges of bricks and, under a transfer function, the distance to anything visible."""

from __future__ import annotations

import numba as nb
import numpy as np

from vvgt_cli.dvr.layout import BRICK
from vvgt_cli.jit.decorators import kernel
from vvgt_cli.look.tables import Optics

MAX_DISTANCE = 15  # bricks; a longer leap saves nothing measurable


@kernel("V f8:4", parallel=True)
def _ranges(values: np.ndarray, out: np.ndarray) -> None:
    """Finite range over each brick of ``values`` (nz, ny, nx) and its upper neighbours; ``out`` (bz, by, bx, 2)."""
    nz, ny, nx = values.shape
    bz, by, bx = out.shape[:3]
    for flat in nb.prange(bz * by):
        z0, y0 = (flat // by) * BRICK, (flat % by) * BRICK
        for b in range(bx):
            lo, hi = np.inf, -np.inf
            for z in range(z0, min(z0 + BRICK + 1, nz)):
                for y in range(y0, min(y0 + BRICK + 1, ny)):
                    for x in range(b * BRICK, min(b * BRICK + BRICK + 1, nx)):
                        v = np.float64(values[z, y, x])
                        if v < lo and v > -np.inf:
                            lo = v
                        if v > hi and v < np.inf:
                            hi = v
            out[z0 // BRICK, y0 // BRICK, b, 0] = lo
            out[z0 // BRICK, y0 // BRICK, b, 1] = hi


def brick_ranges(values: np.ndarray) -> np.ndarray:
    """Smallest and largest finite value over each brick and its upper neighbours.

    ``values`` (nz, ny, nx) -> (bz, by, bx, 2) float64; (inf, -inf) where a brick has no finite voxel.
    """
    shape = tuple(-(-n // BRICK) for n in values.shape)
    out = np.empty((*shape, 2))
    _ranges(values, out)
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
