"""The function used when none is given: background transparent, the rest a ramp by rank."""

from __future__ import annotations

import math

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.transfer.colormap import ColorMap
from vvgt_cli.transfer.function import TransferFunction
from vvgt_cli.transfer.opacity import PiecewiseOpacity
from vvgt_cli.transfer.resolve import StatisticsLike

NAME = "automatic (histogram)"
DOMINANT = 0.25  # share of the voxels from which a peak counts as a background
SIDE = 0.02  # share of the foreground that a side of the background must hold to be shown
SIDE_WIDTH = 0.125  # share of the value range that it must span: less is padding or clipping
PADDING_BINS = 2  # a first peak this narrow, at the low end, may be padding with the air peak behind it
BEHIND_AIR = 0.2  # share of the voxels other than padding that must lie behind a peak for it to be air
OPACITY = ((0.0, 0.0), (0.5, 0.06), (0.9, 0.25), (1.0, 0.7))  # by rank among the foreground's values
# Lightness rises from 35 to 97 (CIE L*), hue from blue over red to pale yellow: visible on black from the start
COLORS = np.array(
    [
        [0.22, 0.27, 0.62],
        [0.52, 0.30, 0.60],
        [0.82, 0.38, 0.42],
        [0.95, 0.60, 0.32],
        [0.98, 0.82, 0.50],
        [1, 0.98, 0.86],
    ]
)


def from_histogram(statistics: StatisticsLike) -> TransferFunction:
    """A transfer function chosen from the histogram alone; deterministic.

    The peak that holds most voxels is background: its foot is found by the triangle method (Zack, Rogers,
    Latt 1977), on each side that leads to more data. A second dominant peak right behind it (air behind
    narrow padding) is skipped too. Opacity and colour then follow half the value, half its rank among what is
    left. Data without a dominant peak are shown whole.

    Args:
        statistics: range and histogram of the data.

    Returns:
        The function on data values, named ``automatic (histogram)``.

    Raises:
        DataError: no finite voxel.
    """
    counts = np.asarray(statistics.histogram, dtype=np.float64)
    edges = np.asarray(statistics.edges, dtype=np.float64)
    lo, hi = float(statistics.lo), float(statistics.hi)
    if not (math.isfinite(lo) and math.isfinite(hi)) or counts.sum() <= 0:
        raise DataError("the data have no finite voxel; expected some to choose a transfer function from")
    if lo == hi:  # a box of one value: seen through
        return TransferFunction(NAME, PiecewiseOpacity(np.array([lo]), np.array([0.1])), _color_map(np.array([lo])))
    first, last = background_bins(counts)
    left, right = (_worth_showing(side, counts) for side in (slice(0, first), slice(last, None)))
    if not (left or right):
        first = last = 0
    nodes: list[tuple[float, float]] = []
    if left:
        nodes += _ramp(counts[:first][::-1], edges[: first + 1][::-1])[::-1]
    if right or not left:
        nodes += _ramp(counts[last:], edges[last:])
    x, y = np.array(nodes).T
    order = np.argsort(x, kind="stable")
    shown = _shown_range(x[order], y[order], lo, hi)
    return TransferFunction(NAME, PiecewiseOpacity(x[order], y[order]), _color_map(_color_nodes(counts, edges, *shown)))


def _worth_showing(side: slice, counts: np.ndarray) -> bool:
    """Whether a side of the background is wide and full enough to be more than padding or stray voxels."""
    inside = counts[side]
    # of the foreground as a whole: all but the voxels of the highest bin, which is always background
    return inside.size >= SIDE_WIDTH * counts.size and inside.sum() >= SIDE * (counts.sum() - counts.max()) > 0


def background_bins(counts: np.ndarray) -> tuple[int, int]:
    """Bins [first, last) of the background; an empty range at 0 when no peak dominates."""
    total = counts.sum()
    first, last = _peak(counts)
    if counts[first:last].sum() < DOMINANT * total:
        return 0, 0
    rest = counts[last:]
    if first == 0 and last <= PADDING_BINS and rest.sum() > 0:
        a, b = _peak(rest)
        behind = rest[b:].sum()
        apart = 0 < a <= counts.size // 2  # at 0 it is the padding's own falling tail
        if apart and rest[a:b].sum() >= DOMINANT * total and behind >= BEHIND_AIR * rest.sum():
            last += b
    return first, last


def _peak(counts: np.ndarray) -> tuple[int, int]:
    """Bins [first, last) of the highest peak, out to its feet."""
    top = int(np.argmax(counts))
    return top - _foot(counts[top::-1]) + 1, top + _foot(counts[top:])


def _foot(falling: np.ndarray) -> int:
    """Bins from the peak (bin 0) to its foot: farthest below the line from the peak to the last filled bin."""
    filled = np.flatnonzero(falling)
    end = int(filled[-1])
    if end < 2:
        return end + 1
    line = falling[0] + (falling[end] - falling[0]) * np.arange(end + 1) / end
    return max(1, int(np.argmax(line - falling[: end + 1])))


def _ramp(counts: np.ndarray, edges: np.ndarray) -> list[tuple[float, float]]:
    """Opacity nodes from the background's edge (edges[0]) outwards."""
    cumulative = np.concatenate([[0.0], np.cumsum(counts)]) / counts.sum()
    nodes = []
    for rank, opacity in OPACITY:
        by_rank = float(np.interp(rank, cumulative, edges)) if rank < 1 else float(edges[-1])
        by_value = float(edges[0] + rank * (edges[-1] - edges[0]))
        nodes.append((0.5 * (by_rank + by_value), opacity))
    return nodes


def _shown_range(x: np.ndarray, y: np.ndarray, lo: float, hi: float) -> tuple[float, float]:
    """Data values between which the function is not transparent."""
    intervals = PiecewiseOpacity(x, y).support(lo, hi)
    return (intervals[0][0], intervals[-1][1]) if intervals else (lo, hi)


def _color_nodes(counts: np.ndarray, edges: np.ndarray, lo: float, hi: float) -> np.ndarray:
    """Positions of the colours in [lo, hi], half by value, half by rank of the voxels in it, (6,)."""
    fraction = np.linspace(0, 1, len(COLORS))
    inside = np.where((edges[:-1] >= lo) & (edges[1:] <= hi), counts, 0.0)
    if inside.sum() <= 0:
        return lo + (hi - lo) * fraction
    cumulative = np.concatenate([[0.0], np.cumsum(inside)]) / inside.sum()
    by_rank = np.clip(np.interp(fraction, cumulative, edges), lo, hi)
    by_rank[[0, -1]] = lo, hi
    return 0.5 * (by_rank + lo + (hi - lo) * fraction)


def _color_map(x: np.ndarray) -> ColorMap:
    return ColorMap(x, COLORS if x.size > 1 else COLORS[3:4], space="Lab")
