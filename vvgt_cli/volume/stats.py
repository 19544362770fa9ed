"""Range, counts and histogram of a volume, slab by slab."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vvgt_cli.errors import DataError, Unsuitable
from vvgt_cli.volume.types import Volume

BINS = 256
SLAB_VOXELS = 1 << 21


@dataclass(frozen=True)
class Statistics:
    """Figures of a volume's data values (slope and intercept applied).

    Attributes:
        lo, hi: least and greatest finite data value.
        nan_count, inf_count: voxels that are NaN, or infinite; both are transparent.
        histogram: (256,) int64 counts of the finite values.
        edges: (257,) float64 bin edges over [lo, hi]; a constant volume's reach half a unit to either side.
    """

    lo: float
    hi: float
    nan_count: int
    inf_count: int
    histogram: np.ndarray
    edges: np.ndarray


def slabs(volume: Volume, max_voxels: int = SLAB_VOXELS) -> Iterator[tuple[int, np.ndarray]]:
    """Walk a volume in z-slabs of at most ``max_voxels`` voxels (at least one slice).

    Yields:
        (z, slab): first slice, and (k, ny, nx) *stored* values in native byte order, C-contiguous and aligned; a view
        where the volume's array is all that already.
    """
    nz, ny, nx = volume.data.shape
    step = max(1, max_voxels // (ny * nx))
    native = volume.data.dtype.newbyteorder("=")
    for z in range(0, nz, step):
        yield z, np.require(volume.data[z : z + step], native, ["C", "A"])


def statistics(volume: Volume) -> Statistics:
    """Compute statistics slab by slab; raise DataError without finite values, or if scaling makes them infinite."""
    if volume.data.dtype.kind in "iub" and volume.data.dtype.itemsize <= 2:
        return integer_statistics(_byte_counts(volume), volume)
    lo, hi, nan_count, inf_count = _range(volume)
    edges = edges_of(lo, hi)
    histogram = np.zeros(BINS, np.int64)
    for _, slab in slabs(volume):
        values = finite_values(slab, volume)
        histogram += np.bincount(bins_of(values, float(edges[0]), float(edges[-1])), minlength=BINS)
    return Statistics(lo, hi, nan_count, inf_count, histogram, edges)


def check_range(lo: float, hi: float, volume: Volume, nan: int = 0) -> None:
    """Check the least and greatest data value, infinity and its negative where none is finite; ``nan`` voxels are NaN.

    Raises:
        Unsuitable: none is finite.
        DataError: the scaling makes values infinite.
    """
    if lo > hi:
        size = volume.data.size
        raise Unsuitable(
            f"{volume.name}: none of its {size} voxels is finite ({nan} NaN, {size - nan} infinite); check the type "
            "and byte order (--dtype, --byte-order)"
        )
    if not (np.isfinite(lo) and np.isfinite(hi)):
        raise DataError(
            f"{volume.name}: data values {volume.slope:g} * stored + {volume.intercept:g} reach from {lo:g} to {hi:g}; "
            "expected finite numbers; check the scaling in the file's header"
        )


def edges_of(lo: float, hi: float) -> np.ndarray:
    """Return (257,) bin edges over [lo, hi]."""
    if lo == hi:
        half = max(0.5, abs(lo) * 2.0**-40)
        lo, hi = lo - half, hi + half
    # Halves keep the difference finite for values near the limit of float64.
    steps = np.arange(BINS + 1) / BINS
    edges = lo * (1 - steps) + hi * steps
    edges[0], edges[-1] = lo, hi
    return edges


def bins_of(values: np.ndarray, lo: float, hi: float) -> np.ndarray:
    """Return the bin of each value; the last bin is closed."""
    width = hi - lo
    t = (values - lo) / width if np.isfinite(width) else (values / 2 - lo / 2) / (hi / 2 - lo / 2)
    return np.minimum((t * BINS).astype(np.int64), BINS - 1)


def integer_statistics(counts: np.ndarray, volume: Volume) -> Statistics:
    """Compute statistics from ``counts`` (256 or 65536,) of every stored 8- or 16-bit value, as unsigned bytes.

    Raises:
        DataError: the scaling makes values infinite.
    """
    counts, first = _in_order(counts, volume)
    used = np.nonzero(counts)[0]
    with np.errstate(over="ignore"):
        values = (used + first).astype(np.float64) * volume.slope + volume.intercept
    lo, hi = float(values.min()), float(values.max())
    check_range(lo, hi, volume)
    edges = edges_of(lo, hi)
    bins = bins_of(values, float(edges[0]), float(edges[-1]))
    histogram = np.bincount(bins, weights=counts[used], minlength=BINS).astype(np.int64)
    return Statistics(lo, hi, 0, 0, histogram, edges)


def count_integers(volume: Volume) -> tuple[np.ndarray, int]:
    """Count every stored value of an 8- or 16-bit type; return the counts and the value of the first one."""
    return _in_order(_byte_counts(volume), volume)


def _in_order(counts: np.ndarray, volume: Volume) -> tuple[np.ndarray, int]:
    """Order counts by unsigned bytes by value; return them and the value of the first one."""
    if volume.data.dtype.kind == "i":  # two's complement: the upper half are the negative values
        return np.roll(counts, len(counts) // 2), -(len(counts) // 2)
    return counts, 0


def _byte_counts(volume: Volume) -> np.ndarray:
    """Count every stored value of an 8- or 16-bit type, as its bytes, unsigned."""
    dtype = volume.data.dtype.newbyteorder("=")
    unsigned = np.dtype(f"u{dtype.itemsize}")
    size = 256**dtype.itemsize
    counts = np.zeros(size, np.int64)
    for _, slab in slabs(volume):
        counts += np.bincount(slab.view(unsigned).ravel(), minlength=size)
    return counts


def finite_values(slab: np.ndarray, volume: Volume) -> np.ndarray:
    """Return the finite data values of a slab, (n,) float64."""
    with np.errstate(over="ignore", invalid="ignore"):
        values = slab.ravel().astype(np.float64)
        if (volume.slope, volume.intercept) != (1.0, 0.0):
            values *= volume.slope
            values += volume.intercept
    if slab.dtype.kind == "f":
        keep = np.isfinite(values)
        if not keep.all():
            values = values[keep]
    return values


def _range(volume: Volume) -> tuple[float, float, int, int]:
    lo, hi, nan_count, finite = np.inf, -np.inf, 0, 0
    for _, slab in slabs(volume):
        values = finite_values(slab, volume)
        finite += values.size
        if values.size < slab.size:
            nan_count += int(np.isnan(slab).sum())
        if values.size:
            lo, hi = min(lo, float(values.min())), max(hi, float(values.max()))
    check_range(lo, hi, volume, nan_count)
    return lo, hi, nan_count, volume.data.size - finite - nan_count
