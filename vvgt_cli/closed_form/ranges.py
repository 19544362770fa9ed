"""Which blocks of a part of a volume hold extinction: ranges of their values, and the optics under them."""

from __future__ import annotations

import numpy as np

from vvgt_cli.jit.decorators import parallel_kernel
from vvgt_cli.jit.parts import Part, turns_of
from vvgt_cli.look.tables import Optics


@parallel_kernel("V i8:1 i8:1 f8 f8 f8:4")
def block_ranges(
    part: Part, values: np.ndarray, first: np.ndarray, edge: np.ndarray, least: float, most: float, out: np.ndarray
) -> None:
    """Finite range over each block and the voxel on either side of it; ``out`` (bz, by, bx, 2): low > high for none.

    ``values`` (nz, ny, nx), of a type that goes from ``least`` to ``most``; ``first`` (3,) first voxel of the first
    block, ``edge`` (3,) voxels, (x, y, z).
    """
    nz, ny, nx = values.shape
    bz, by, bx = out.shape[:3]
    xa, xb = max(first[0] - 1, 0), min(first[0] + bx * edge[0] + 1, nx)
    for block in turns_of(part, bz * by):
        k, j = block // by, block % by
        z0, y0 = first[2] + k * edge[2], first[1] + j * edge[1]
        low, high = np.empty(xb - xa, values.dtype), np.empty(xb - xa, values.dtype)
        ends = np.empty(2, values.dtype)
        ends[0], ends[1] = least, most
        low[:], high[:] = ends[1], ends[0]
        for z in range(max(z0 - 1, 0), min(z0 + edge[2] + 1, nz)):
            for y in range(max(y0 - 1, 0), min(y0 + edge[1] + 1, ny)):
                row = values[z, y, xa:xb]
                for x in range(xb - xa):  # whole rows: so many at once as the processor can
                    v = row[x]
                    low[x] = v if (v < low[x]) & (v >= ends[0]) else low[x]
                    high[x] = v if (v > high[x]) & (v <= ends[1]) else high[x]
        for i in range(bx):
            x0 = first[0] + i * edge[0]
            lo, hi = np.inf, -np.inf
            for x in range(max(x0 - 1, 0) - xa, min(x0 + edge[0] + 1, nx) - xa):
                lo, hi = min(lo, np.float64(low[x])), max(hi, np.float64(high[x]))
            out[k, j, i, 0], out[k, j, i, 1] = lo, hi


def ranges_of(values: np.ndarray, first: np.ndarray, edge: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """`block_ranges` (bz, by, bx, 2) of ``shape`` (3,) blocks along (x, y, z); other arguments as there."""
    ranges = np.empty((*(int(n) for n in shape[::-1]), 2))
    about = np.finfo(values.dtype) if values.dtype.kind == "f" else np.iinfo(values.dtype)
    block_ranges(values, first.astype(np.int64), edge.astype(np.int64), float(about.min), float(about.max), ranges)
    return ranges


def visible_blocks(
    values: np.ndarray, first: np.ndarray, edge: np.ndarray, shape: np.ndarray, tables: Optics
) -> np.ndarray:
    """Numbers (n, 3) int64 (x, y, z) of the blocks that may hold extinction.

    Args:
        values: (nz, ny, nx) as kernels read them.
        first, edge: as of `block_ranges`.
        shape: (3,) blocks along (x, y, z).
        tables: optics over the stored values.
    """
    ranges = ranges_of(values, first, edge, shape)
    positive = np.concatenate([[0], np.cumsum(tables.nodes[:, 3] > 0)])
    none = ranges[..., 1] < ranges[..., 0]
    u = tables.coordinate(np.where(none[..., None], tables.lo, ranges))
    first_bin, last_bin = np.floor(u.min(axis=-1)).astype(np.int64), np.ceil(u.max(axis=-1)).astype(np.int64)
    result: np.ndarray = np.argwhere((positive[last_bin + 1] > positive[first_bin]) & ~none)[:, ::-1]
    return result
