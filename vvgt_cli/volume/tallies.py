"""`Statistics` of a volume that is never there as a whole: counted block by block, in any order, and added up.

Everything that is added is whole numbers and extremes, so that the figures are those of `stats.statistics`, to the bit,
however the volume is cut.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from vvgt_cli.errors import Unsuitable
from vvgt_cli.volume.stats import BINS, Statistics, check_range, edges_of, integer_statistics
from vvgt_cli.volume.types import Volume

PARTS = 4  # of a block, counted at once


@dataclass(frozen=True)
class Tally:
    """Counts over some blocks.

    Attributes:
        counts: (256 or 65536,) of every stored value of an 8- or 16-bit type (as its bytes, unsigned), (0,) of others.
        lo, hi: least and greatest finite data value, of other types.
        stored: least and greatest finite stored value.
        nan, finite: voxels that are NaN, and those that are finite.
        histogram: (256,) finite values over the range, once that is known; (0,) before.
    """

    counts: np.ndarray
    lo: float = np.inf
    hi: float = -np.inf
    stored: tuple[float, float] = (np.inf, -np.inf)
    nan: int = 0
    finite: int = 0
    histogram: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))

    def plus(self, other: Tally) -> Tally:
        """Add another tally to this one."""
        return Tally(
            self.counts + other.counts,
            min(self.lo, other.lo),
            max(self.hi, other.hi),
            (min(self.stored[0], other.stored[0]), max(self.stored[1], other.stored[1])),
            self.nan + other.nan,
            self.finite + other.finite,
            self.histogram + other.histogram,
        )


def counted(volume: Volume) -> bool:
    """Tell whether every value of the volume's type is counted, so that a histogram needs no second pass."""
    return volume.data.dtype.kind in "iub" and volume.data.dtype.itemsize <= 2


def tally(values: np.ndarray, volume: Volume, limits: tuple[float, float] | None = None) -> Tally:
    """Tally a block of stored values (z, y, x), native, C-contiguous; with ``limits`` (data values) only a histogram.

    The block is made read-only.
    """
    if counted(volume):
        from vvgt_cli.volume.count_kernel import LANES, count_values

        found = np.zeros((PARTS, LANES, 256**values.dtype.itemsize), np.int64)
        values.flags.writeable = False  # kernels are compiled for such
        count_values(values.view(f"u{values.dtype.itemsize}"), found)
        return Tally(found.sum(axis=(0, 1)))
    values = values if values.dtype == np.float32 else values.astype(np.float64)
    values.flags.writeable = False
    return _range(values, volume) if limits is None else _binned(values, volume, limits)


def _range(values: np.ndarray, volume: Volume) -> Tally:
    """Find the range and count the finite voxels of ``values``, float32 or float64."""
    from vvgt_cli.volume.count_kernel import FINITE, HIGH, LOW, NAN, STORED_HIGH, STORED_LOW, range_values

    ends, numbers = np.empty((PARTS, 4)), np.zeros((PARTS, 2), np.int64)
    range_values(values, volume.slope, volume.intercept, volume.data.dtype.kind != "f", ends, numbers)
    low, high = ends.min(axis=0), ends.max(axis=0)
    nan, finite = int(numbers[:, NAN].sum()), int(numbers[:, FINITE].sum())
    none, stored = np.empty(0, np.int64), (float(low[STORED_LOW]), float(high[STORED_HIGH]))
    return Tally(none, float(low[LOW]), float(high[HIGH]), stored, nan, finite) if finite else Tally(none, nan=nan)


def _binned(values: np.ndarray, volume: Volume, limits: tuple[float, float]) -> Tally:
    """Make a histogram of ``values``, float32 or float64, over ``limits``."""
    from vvgt_cli.volume.count_kernel import LANES, bin_values

    edges = edges_of(*limits)
    lo, hi = float(edges[0]), float(edges[-1])
    found = np.zeros((PARTS, LANES, BINS + 1), np.int64)
    bin_values(values, volume.slope, volume.intercept, lo, hi, 1.0 if np.isfinite(hi - lo) else 0.5, found)
    return Tally(np.empty(0, np.int64), histogram=found.sum(axis=(0, 1))[:BINS])


def with_limits(whole: Tally, volume: Volume) -> Tally:
    """Check the sum over all blocks and complete it with its limits.

    Raises:
        Unsuitable: no voxel has a finite value, or the scaling makes values infinite.
    """
    if counted(volume):
        numbers = integer_statistics(whole.counts, volume)
        ends = (numbers.lo - volume.intercept) / volume.slope, (numbers.hi - volume.intercept) / volume.slope
        return replace(whole, lo=numbers.lo, hi=numbers.hi, stored=(min(ends), max(ends)), finite=volume.data.size)
    if not whole.finite:
        inf = volume.data.size - whole.nan
        raise Unsuitable(
            f"{volume.name}: none of its {volume.data.size} voxels is finite ({whole.nan} NaN, {inf} infinite); check "
            "the type and byte order (--dtype, --byte-order)"
        )
    check_range(whole.lo, whole.hi, volume)
    return whole


def statistics_of(whole: Tally, volume: Volume, histogram: np.ndarray | None = None) -> Statistics:
    """Return the statistics of `with_limits` of all blocks and of the histogram of a second pass over them.

    Without ``histogram`` (a function is given, in data values) all values count in the lowest bin.
    """
    if counted(volume):
        return integer_statistics(whole.counts, volume)
    if histogram is None:
        histogram = np.zeros(BINS, np.int64)
        histogram[0] = whole.finite
    infinite = volume.data.size - whole.finite - whole.nan
    return Statistics(whole.lo, whole.hi, whole.nan, infinite, histogram, edges_of(whole.lo, whole.hi))
