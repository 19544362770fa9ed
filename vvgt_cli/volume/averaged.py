"""A volume on a coarser grid of the same box, read slab by slab: means of values, or samples of labels."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from vvgt_cli.volume.stats import slabs
from vvgt_cli.volume.types import Volume, triple


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
    """Return the mean of the finite data values within each cell, weighted by volume.

    Args:
        volume: the volume.
        dims: cells along (x, y, z) of its box.

    Returns:
        (nz, ny, nx) float64, NaN where a cell has no finite value.
    """
    sums, shares = np.zeros((2, *dims[::-1]))
    area = volume.dims[0] * volume.dims[1] / (dims[0] * dims[1])
    for lo, slab in slabs(volume):
        values = volume.slope * slab.astype(np.float64) + volume.intercept
        known = np.isfinite(values)
        if known.all():
            column = np.full((len(slab), 1, 1), area)
            of_known = _integrated(column, lo, (1, 1, volume.dims[2]), (1, 1, dims[2]))[1]
        else:
            of_known = _integrated(known.astype(np.float64), lo, volume.dims, dims)[1]
            values[~known] = 0
        first, of_values = _integrated(values, lo, volume.dims, dims)
        here = slice(first, first + len(of_values))
        sums[here] += of_values
        shares[here] += of_known
    empty = shares < 1e-9
    return np.where(empty, np.nan, sums / np.where(empty, 1.0, shares))


def _integrated(
    slab: np.ndarray, lo: int, whole: tuple[int, ...], dims: tuple[int, ...]
) -> tuple[int, np.ndarray]:  # fmt: skip
    """Integrate slices from ``lo`` on over the cells that they overlap; return the first such cell, and the sums."""
    begin = 0
    for axis, (n, count) in enumerate(zip(whole[::-1], dims[::-1], strict=True)):
        edges = np.linspace(0, n, count + 1)
        if axis == 0:
            hi = lo + len(slab)
            begin, end = int(np.searchsorted(edges, lo, "right")) - 1, int(np.searchsorted(edges, hi, "left"))
            edges = edges[begin : end + 1].clip(lo, hi) - lo
        before = np.minimum(edges.astype(np.int64), slab.shape[axis] - 1)
        share = (edges - before).reshape([-1 if k == axis else 1 for k in range(3)])
        until = np.insert(np.cumsum(slab, axis), 0, 0.0, axis)
        below = until.take(before, axis)
        slab = np.diff(below + share * (until.take(before + 1, axis) - below), axis=axis)
    return begin, slab


def sampled(volume: Volume, dims: tuple[int, int, int]) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the data value at the middle of each cell, for a label map: (first slice of cells, (k, ny, nx))."""
    x, y, z = (((np.arange(n) + 0.5) * whole / n).astype(np.int64) for n, whole in zip(dims, volume.dims, strict=True))
    for lo, slab in slabs(volume):
        here = np.flatnonzero((z >= lo) & (z < lo + len(slab)))
        if len(here):
            found = slab[(z[here] - lo)[:, None, None], y[:, None], x].astype(np.float64)
            yield int(here[0]), volume.slope * found + volume.intercept
