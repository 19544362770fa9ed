"""Which blocks of a volume hold extinction: ranges of their values, the optics there, and the empty-space map."""

from __future__ import annotations

import numpy as np

from vvgt_cli.dvr.layout import BRICK, Mixture
from vvgt_cli.jit.decorators import parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations
from vvgt_cli.look.tables import Optics

MAX_DISTANCE = 15  # bricks; a longer leap saves nothing measurable


@parallel_kernel("V i8:1 i8:1 i8 f8 f8 f8:4")
def block_ranges(
    thread: ThreadSlice, values: np.ndarray, first: np.ndarray, edge: np.ndarray, before: int, least: float,
    most: float, out: np.ndarray,
) -> None:  # fmt: skip
    """Write the finite range over each block into ``out`` (bz, by, bx, 2), (inf, -inf) where it has no finite voxel.

    A block counts with the next voxel, and with ``before`` voxels before it. ``values`` (nz, ny, nx), of a type that
    goes from ``least`` to ``most``; ``first`` (3,) first voxel of the first block, ``edge`` (3,) voxels, (x, y, z).
    """
    nz, ny, nx = values.shape
    bz, by, bx = out.shape[:3]
    xa, xb = max(first[0] - before, 0), min(first[0] + bx * edge[0] + 1, nx)
    for block in iterations(thread, bz * by):
        k, j = block // by, block % by
        z0, y0 = first[2] + k * edge[2], first[1] + j * edge[1]
        low, high = np.empty(xb - xa, values.dtype), np.empty(xb - xa, values.dtype)
        ends = np.empty(2, values.dtype)
        ends[0], ends[1] = least, most
        low[:], high[:] = ends[1], ends[0]
        for z in range(max(z0 - before, 0), min(z0 + edge[2] + 1, nz)):
            for y in range(max(y0 - before, 0), min(y0 + edge[1] + 1, ny)):
                row = values[z, y, xa:xb]
                for x in range(xb - xa):  # whole rows: so many at once as the processor can
                    v = row[x]
                    low[x] = v if (v < low[x]) & (v >= ends[0]) else low[x]
                    high[x] = v if (v > high[x]) & (v <= ends[1]) else high[x]
        for i in range(bx):
            x0 = first[0] + i * edge[0]
            lo, hi = np.inf, -np.inf
            for x in range(max(x0 - before, 0) - xa, min(x0 + edge[0] + 1, nx) - xa):
                lo, hi = min(lo, np.float64(low[x])), max(hi, np.float64(high[x]))
            none = lo > hi  # a type's own ends, where no voxel is finite
            out[k, j, i, 0], out[k, j, i, 1] = np.inf if none else lo, -np.inf if none else hi


def ranges_of(values: np.ndarray, first: np.ndarray, edge: np.ndarray, shape: np.ndarray, before: int) -> np.ndarray:
    """Return `block_ranges` (bz, by, bx, 2) of ``shape`` (3,) blocks along (x, y, z); other arguments as there."""
    out = np.empty((*(int(n) for n in shape[::-1]), 2))
    about = np.finfo(values.dtype) if values.dtype.kind == "f" else np.iinfo(values.dtype)
    corner, edges = np.asarray(first, np.int64), np.asarray(edge, np.int64)
    block_ranges(values, corner, edges, before, float(about.min), float(about.max), out)
    return out


def brick_ranges(values: np.ndarray) -> np.ndarray:
    """Return the smallest and largest finite value of each brick of ``values`` (nz, ny, nx) and its next voxels.

    (bz, by, bx, 2) float64; (inf, -inf) where a brick has no finite voxel.
    """
    return ranges_of(values, np.zeros(3), np.full(3, BRICK), -(-np.array(values.shape[::-1]) // BRICK), 0)


def visible_blocks(
    values: np.ndarray, first: np.ndarray, edge: np.ndarray, shape: np.ndarray, tables: Optics
) -> np.ndarray:
    """Return the numbers (n, 3) int64 (x, y, z) of the blocks that may hold extinction.

    Args:
        values: (nz, ny, nx) as kernels read them.
        first: (3,) first voxel of the first block, (x, y, z).
        edge: (3,) voxels along the edges of a block.
        shape: (3,) blocks along (x, y, z).
        tables: optics over the stored values.
    """
    return np.argwhere(_may_absorb(ranges_of(values, first, edge, shape, 1), tables))[:, ::-1]


def _may_absorb(ranges: np.ndarray, tables: Optics) -> np.ndarray:
    """Return which ranges of values (..., 2) have extinction somewhere, (...) bool."""
    positive = np.concatenate([[0], np.cumsum(tables.nodes[:, 3] > 0)])
    none = ranges[..., 1] < ranges[..., 0]
    u = tables.coordinate(np.where(none[..., None], tables.lo, ranges))
    first, last = np.floor(u.min(axis=-1)).astype(np.int64), np.ceil(u.max(axis=-1)).astype(np.int64)
    return (positive[last + 1] > positive[first]) & ~none


def empty_distance(ranges: np.ndarray, tables: Optics) -> np.ndarray:
    """Return each brick's Chebyshev distance to the nearest one with extinction, (bz, by, bx) uint8, in bricks."""
    active = _may_absorb(ranges, tables)
    distance = np.full(active.shape, MAX_DISTANCE, np.uint8)
    distance[active] = 0
    for d in range(1, MAX_DISTANCE):
        grown = dilate(active)
        if grown.sum() == active.sum():
            break
        distance[grown & ~active] = d
        active = grown
    return distance


def empty_bricks(values: np.ndarray, tables: Optics, mixture: Mixture | None = None) -> np.ndarray:
    """Return `empty_distance` to bricks with extinction in ``values`` (nz, ny, nx) or in a layer of the mixture."""
    empty = empty_distance(brick_ranges(values), tables)
    for scalars, optics in mixture.fields() if mixture else ():
        np.minimum(empty, empty_distance(brick_ranges(scalars), optics), out=empty)
    return empty


def dilate(mask: np.ndarray) -> np.ndarray:
    """Return ``mask`` (z, y, x) bool grown by one cell in every direction, diagonals included."""
    out = mask
    for axis in range(3):
        grown = out.copy()
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        grown[tuple(ahead)] |= out[tuple(behind)]
        grown[tuple(behind)] |= out[tuple(ahead)]
        out = grown
    return out
