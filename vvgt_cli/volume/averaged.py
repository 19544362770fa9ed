"""A volume on a coarser grid of the same box, read part by part: means of values, or samples of labels."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from vvgt_cli.volume.stored import chunks_of, read_block
from vvgt_cli.volume.types import Volume, triple

AT_ONCE = 1 << 21  # voxels of a part, unless one of the file's chunks has more


def coarser(volume: Volume, most: int) -> tuple[int, int, int]:
    """Return the dims (x, y, z) of a grid of at most ``most`` cells, nearly cubes, none smaller than a voxel."""
    edge = min(volume.spacing)
    while True:
        dims = triple(
            min(n, math.ceil(length / edge)) for n, length in zip(volume.dims, volume.extent, strict=True)
        )  # fmt: skip
        if math.prod(dims) <= most:
            return dims
        edge *= 1.01


def averaged(volume: Volume, dims: tuple[int, int, int]) -> np.ndarray:
    """Return means of the finite data values in ``dims`` cells (x, y, z), (nz, ny, nx) float64, NaN for none."""
    sums, shares = np.zeros((2, *dims[::-1]))
    for lo, part in _parts(volume):
        values = volume.slope * part.astype(np.float64) + volume.intercept
        known = np.isfinite(values)
        values[~known] = 0
        spans = [
            _span(*axis) for axis in zip(volume.dims[::-1], dims[::-1], lo[::-1], part.shape, strict=True)
        ]  # fmt: skip
        here = tuple(slice(first, first + len(edges) - 1) for first, edges in spans)
        edges = [edges for _, edges in spans]
        sums[here] += _integrated(values, edges)
        if known.all():
            z, y, x = (np.diff(one) for one in edges)
            shares[here] += z[:, None, None] * y[:, None] * x
        else:
            shares[here] += _integrated(known.astype(np.float64), edges)
    empty = shares < 1e-9
    return np.where(empty, np.nan, sums / np.where(empty, 1.0, shares))


def sampled(volume: Volume, dims: tuple[int, int, int]) -> np.ndarray:
    """Return the data value (nz, ny, nx) float64 at the middle of each cell, for a label map."""
    out = np.empty(dims[::-1])
    middles = [((np.arange(n) + 0.5) * whole / n).astype(np.int64) for n, whole in zip(dims, volume.dims, strict=True)]
    for lo, part in _parts(volume):
        cells, voxels = [], []
        for middle, first, length in zip(middles[::-1], lo[::-1], part.shape, strict=True):
            cells.append(np.flatnonzero((middle >= first) & (middle < first + length)))
            voxels.append(middle[cells[-1]] - first)
        out[np.ix_(*cells)] = part[np.ix_(*voxels)]
    return volume.slope * out + volume.intercept


def _parts(volume: Volume) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the first voxel (x, y, z) and the stored values (z, y, x) of parts of whole chunks of the file."""
    shape, edge = volume.data.shape, list(chunks_of(volume))
    for axis in (2, 1, 0):
        room = max(AT_ONCE // math.prod(edge), 1)
        edge[axis] = min(edge[axis] * room, shape[axis])
    for start in itertools.product(*(range(0, n, step) for n, step in zip(shape, edge, strict=True))):
        lo = np.array(start[::-1])
        yield lo, read_block(volume, lo, np.minimum(lo + edge[::-1], volume.dims))


def _span(whole: int, count: int, lo: int, length: int) -> tuple[int, np.ndarray]:
    """Return the first of ``count`` cells that voxels from ``lo`` on overlap, and the cells' edges within these."""
    edges = np.linspace(0, whole, count + 1)
    first = int(np.searchsorted(edges, lo, "right")) - 1
    last = int(np.searchsorted(edges, lo + length, "left"))
    return first, edges[first : last + 1].clip(lo, lo + length) - lo


def _integrated(values: np.ndarray, edges: Sequence[np.ndarray]) -> np.ndarray:
    """Integrate values (z, y, x), constant within voxels, between edges along each axis."""
    for axis, ends in enumerate(edges):
        lo, hi, last = ends[:-1], ends[1:], values.shape[axis] - 1
        first = lo.astype(np.int64)
        sums = np.zeros(tuple(len(lo) if k == axis else n for k, n in enumerate(values.shape)))
        for voxel in (first + k for k in range(int((np.ceil(hi) - first).max(initial=0)))):
            share = (np.minimum(hi, voxel + 1) - np.maximum(lo, voxel)).clip(0)
            part = values.take(np.minimum(voxel, last), axis)
            part *= share.reshape([-1 if k == axis else 1 for k in range(3)])
            sums += part
        values = sums
    return values
