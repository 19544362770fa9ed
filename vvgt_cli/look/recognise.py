"""Properties of data from their histogram: background, mean and deviation, and whether they are Hounsfield units."""

from __future__ import annotations

import math

import numpy as np

DOMINANT = 0.25  # share of the voxels from which a peak counts as a background
AMID = 0.125  # share of the value range that a background spans at most, where it is not the lowest (ambient)
SIDE = 0.02  # share of the foreground that a side of the background must hold to be shown
PADDING_BINS = 2  # a first peak this narrow, at the low end, may be padding with the air peak behind it
BEHIND_AIR = 0.2  # share of the voxels other than padding that must lie behind a peak for it to be air
AIR, BETWEEN, TISSUE = (-1100.0, -850.0), (-700.0, -250.0), (-200.0, 300.0)  # HU
SHARE = 0.03  # of the voxels that must be air's, and tissue's, for values to be Hounsfield units
PEAK = 2.0  # times as many voxels per HU as between the two


def background_bins(counts: np.ndarray) -> tuple[int, int]:
    """Return the background's bins [first, last); (0, 0) if no peak dominates, or a wide one lies above others."""
    total = counts.sum()
    first, last = _peak(counts)
    if counts[first:last].sum() < DOMINANT * total:
        return 0, 0
    if counts[:first].sum() >= SIDE * (total - counts.max()) > 0 and last - first > AMID * counts.size:
        return 0, 0
    rest = counts[last:]
    if first == 0 and last <= PADDING_BINS and rest.sum() > 0:
        a, b = _peak(rest)
        behind = rest[b:].sum()
        separate = 0 < a <= counts.size // 2  # at 0 it is the padding's own falling tail
        if separate and rest[a:b].sum() >= DOMINANT * total and behind >= BEHIND_AIR * rest.sum():
            last += b
    return first, last


def _peak(counts: np.ndarray) -> tuple[int, int]:
    """Return the bins [first, last) of the highest peak, out to its feet."""
    top = int(np.argmax(counts))
    return top - _foot(counts[top::-1]) + 1, top + _foot(counts[top:])


def _foot(falling: np.ndarray) -> int:
    """Return the bins from the peak (bin 0) to its foot, farthest below the line from peak to last filled bin."""
    filled = np.flatnonzero(falling)
    end = int(filled[-1])
    if end < 2:
        return end + 1
    line = falling[0] + (falling[end] - falling[0]) * np.arange(end + 1) / end
    return max(1, int(np.argmax(line - falling[: end + 1])))


def in_hounsfield(counts: np.ndarray, edges: np.ndarray) -> bool:
    """Return whether data values are Hounsfield units.

    One of their peaks is air's and another one tissue's; or the background is air, and values reach beyond tissue (a
    skull, or what a mask keeps of a scan).
    """
    if air_and_tissue(counts, edges):
        return True
    first, last = background_bins(counts)
    return bool(first < last and AIR[0] <= edges[first] and edges[last] <= AIR[1] and edges[-1] > TISSUE[1])


def air_and_tissue(counts: np.ndarray, edges: np.ndarray) -> bool:
    """Return whether one peak of data values is air's, and another one tissue's."""
    cumulative = np.concatenate([[0.0], np.cumsum(counts)]) / counts.sum()
    spans = (AIR, BETWEEN, TISSUE)
    air, between, tissue = (float(np.diff(np.interp(span, edges, cumulative))[0]) for span in spans)
    highest = PEAK * between / (BETWEEN[1] - BETWEEN[0])
    peaks = air / (AIR[1] - AIR[0]) > highest and tissue / (TISSUE[1] - TISSUE[0]) > highest
    return peaks and min(air, tissue) >= SHARE


def foreground(counts: np.ndarray) -> np.ndarray:
    """Return the counts with the background and all below it set to 0; unchanged if nothing would remain."""
    last = background_bins(counts)[1]
    front = np.where(np.arange(counts.size) < last, 0.0, counts)
    return front if last and front.any() else counts


def moments(counts: np.ndarray, edges: np.ndarray) -> tuple[float, float]:
    """Return mean and standard deviation of data values, from the middles of bins, with Sheppard's correction.

    Both are off by at most half a bin (1/512 of the range), by far less for values spread over several bins.
    """
    weight, middle = counts / counts.sum(), edges[:-1] / 2 + edges[1:] / 2
    scale = float(np.abs(edges).max()) or 1.0  # squares of values near the limit of float64
    middle = middle / scale
    mean = float(weight @ middle)
    variance = float(weight @ (middle - mean) ** 2)
    width = float(edges[-1] / scale - edges[0] / scale) / counts.size
    if np.count_nonzero(counts) > 2:
        variance = max(variance - width**2 / 12, variance / 2)
    return mean * scale, math.sqrt(variance) * scale
