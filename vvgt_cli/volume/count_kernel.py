"""Kernels of `vvgt_cli.field.counting`: how often each whole number occurs; range and histogram of others."""

from __future__ import annotations

import numba as nb
import numpy as np

from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations

LANES = 4  # tables that neighbours are counted in: equal ones need not wait for each other
LOW, HIGH, STORED_LOW, STORED_HIGH = range(4)  # of a part's ends
NAN, FINITE = range(2)  # of its numbers
U = nb.uint64  # an index that cannot be negative needs no test


@parallel_kernel("V i8:3")
def count_values(thread: ThreadSlice, values: np.ndarray, out: np.ndarray) -> None:
    """Count each number in ``values`` (nz, ny, nx) uint8 or uint16; ``out`` (parts, LANES, 256 or 65536), zeros."""
    parts = out.shape[0]
    for table in iterations(thread, parts):
        for z in range(table, values.shape[0], parts):
            for y in range(values.shape[1]):
                row = values[z, y]
                for x in range(values.shape[2]):
                    out[table, x % LANES, int(row[x])] += 1


@inlined()
def _row_range(
    row: np.ndarray,
    slope: float,
    intercept: float,
    whole: bool,
    lows: np.ndarray,
    highs: np.ndarray,
    numbers: np.ndarray,
) -> None:
    """Take a row in: smallest and largest data value and stored value at each x, into ``lows``, ``highs`` (2, nx)."""
    nan = finite = 0
    for x in range(len(row)):  # nothing but selections: so many at once as the processor can
        stored = np.float64(row[x])
        v = stored * slope + intercept
        fits = (abs(v) < np.inf) | whole
        real = abs(stored) < np.inf
        lows[0, x] = v if (v < lows[0, x]) & fits else lows[0, x]
        highs[0, x] = v if (v > highs[0, x]) & fits else highs[0, x]
        lows[1, x] = stored if (stored < lows[1, x]) & real else lows[1, x]
        highs[1, x] = stored if (stored > highs[1, x]) & real else highs[1, x]
        finite += 1 if fits else 0
        nan += 1 if stored != stored else 0
    numbers[NAN] += nan
    numbers[FINITE] += finite


@parallel_kernel("V f8 f8 b1 f8:2 i8:2")
def range_values(
    thread: ThreadSlice,
    values: np.ndarray,
    slope: float,
    intercept: float,
    whole: bool,
    ends: np.ndarray,
    numbers: np.ndarray,
) -> None:
    """Find the range of data values ``slope * stored + intercept`` and of stored ones; count the finite ones.

    ``values`` (nz, ny, nx) float32 or float64; ``whole``: they stand for whole numbers, which all count. ``ends``
    (parts, 4) by `LOW` to `STORED_HIGH`, infinite where there is none; ``numbers`` (parts, 2) by `NAN` and `FINITE`,
    zeros.
    """
    parts = ends.shape[0]
    for table in iterations(thread, parts):
        lows, highs = np.full((2, values.shape[2]), np.inf), np.full((2, values.shape[2]), -np.inf)
        for z in range(table, values.shape[0], parts):
            for y in range(values.shape[1]):
                _row_range(values[z, y], slope, intercept, whole, lows, highs, numbers[table])
        ends[table, LOW], ends[table, HIGH] = lows[0].min(), highs[0].max()
        ends[table, STORED_LOW], ends[table, STORED_HIGH] = lows[1].min(), highs[1].max()


@parallel_kernel("V f8 f8 f8 f8 f8 i8:3")
def bin_values(
    thread: ThreadSlice,
    values: np.ndarray,
    slope: float,
    intercept: float,
    lo: float,
    hi: float,
    half: float,
    out: np.ndarray,
) -> None:
    """Count the finite data values ``slope * stored + intercept`` in the bins of `stats.bins_of`, to the bit.

    ``values`` (nz, ny, nx) float32 or float64; ``lo``, ``hi`` ends of the bins; ``half`` 1, or 0.5 where the
    difference of the ends is infinite. ``out`` (parts, LANES, bins + 1), zeros; the last column counts the rest.
    """
    parts, bins = out.shape[0], out.shape[2] - 1
    first, width = lo * half, hi * half - lo * half
    for table in iterations(thread, parts):
        number = np.empty(values.shape[2], np.int32)
        for z in range(table, values.shape[0], parts):
            for y in range(values.shape[1]):
                row = values[z, y]
                for x in range(len(row)):  # apart from the counting: so many at once as the processor can
                    v = np.float64(row[x]) * slope + intercept
                    fits = abs(v) < np.inf
                    t = ((v if fits else lo) * half - first) / width * bins
                    number[x] = max(min(np.int32(t), bins - 1), 0) if fits else bins  # within, whatever has changed
                for x in range(len(row)):
                    out[table, x % LANES, U(number[x])] += 1
