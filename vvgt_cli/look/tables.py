"""`Optics`: a transfer function tabulated with the cumulative integrals that pre-integration needs."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.volume.stats import Statistics

EXPOSED = 16  # values within a bin of the histogram
MAX_OPACITY = 1 - 1e-5  # conventions: every integral has a limit
MIN_BINS, MAX_BINS = 2048, 65536
BESIDE = 4.0  # times the nodes' range that is tabulated on each side: a segment that enters it there begins outside
FLAT = 2.0  # optical depth of a voxel's edge by which extinction may differ where a segment is no finer sampled
EVEN = 0.1  # the same where the scalar is far from linear along the segment
BINS_PER_GAP = 8  # bins inside the narrowest gap between two nodes, where MAX_BINS allows


def extinction(opacity: np.ndarray, unit_distance: float) -> np.ndarray:
    """Return ``tau = -ln(1 - a) / d``, a capped at 1 - 1e-5; ``opacity`` any shape, result per unit of d."""
    return -np.log1p(-np.clip(opacity, 0.0, MAX_OPACITY)) / unit_distance


def exposed_distance(tf: TransferFunction, statistics: Statistics, edge: float) -> float:
    """Return the unit distance of an X-ray: a ray as long as ``edge`` through the volume's mean keeps 1/e.

    So an X-ray depends neither on the function's unit distance nor on how opaque the whole of it is.

    ``edge`` is the longest one of the volume's box; the result is in the same unit.

    Raises:
        DataError: the function shows nothing.
    """
    low, wide = statistics.edges[:-1, None], np.diff(statistics.edges)[:, None]
    parts = (np.arange(EXPOSED) + 0.5) / EXPOSED
    mean = extinction(tf.opacity(low + wide * parts), 1.0).mean(axis=1) @ statistics.histogram
    if not mean > 0:
        raise DataError("X-ray: the function is transparent at every value of the volume; try another function")
    return float(edge * mean / statistics.histogram.sum())


class Optics(NamedTuple):
    """Extinction and colour over ``u = (stored - lo) * inv_width`` in [0, n], constant beyond; passed to kernels.

    Attributes:
        lo: stored value at u = 0.
        inv_width: bins per stored unit (negative if the stored scaling's slope is).
        nodes: (n + 1, 4) float64, tau * (r, g, b) and tau at the bin edges, per unit-frame length.
        cumulative: (n + 1, 4) float64, integral over u of the same (trapezoid: exact for linear tau within a bin).
        dark: (n + 1,) float64, the u up to which extinction is zero from bin i on: [u0, u1] is transparent if and only
            if u1 <= dark[floor(u0)].
        flat: (n + 1,) float64, the u up to which nodes differ by at most `FLAT` per voxel from bin i on.
        even: the same for `EVEN`.
    """

    lo: float
    inv_width: float
    nodes: np.ndarray
    cumulative: np.ndarray
    dark: np.ndarray
    flat: np.ndarray
    even: np.ndarray

    @classmethod
    def of(cls, lo: float, inv_width: float, nodes: np.ndarray, cumulative: np.ndarray, voxel: float = 1.0) -> Optics:
        """Return tables with what follows from the nodes; ``voxel``: mean edge, unit-frame lengths."""
        count = len(nodes)
        positive = np.where(nodes[:, 3] > 0, np.arange(count), count + 1)
        dark = np.minimum.accumulate(positive[::-1])[::-1] - 1.0
        flat, even = (_flat_until(nodes, most / voxel) for most in (FLAT, EVEN))
        for until in (flat, even):
            until[until == count - 1] = np.inf
        return cls(lo, inv_width, nodes, cumulative, np.ascontiguousarray(dark), flat, even)

    @classmethod
    def linear(cls, top: float) -> Optics:
        """Return black tables for values from 0 to ``top`` that are extinction themselves."""
        nodes = np.array([[0.0, 0, 0, 0], [0, 0, 0, top or 1.0]])
        return cls.of(0.0, 1 / (top or 1.0), nodes, np.cumsum(nodes / 2, axis=0))

    @property
    def bins(self) -> int:
        """Return the number n of bins."""
        return len(self.nodes) - 1

    def coordinate(self, stored: np.ndarray) -> np.ndarray:
        """Return the table coordinate u of stored values, clamped to [0, n]; NaN stays NaN."""
        with np.errstate(invalid="ignore", over="ignore"):
            return np.clip((np.asarray(stored, np.float64) - self.lo) * self.inv_width, 0.0, float(self.bins))

    def largest_extinction(self) -> float:
        """Return the largest extinction per unit-frame length."""
        return float(self.nodes[:, 3].max())


def _flat_until(nodes: np.ndarray, most: float) -> np.ndarray:
    """Return for each node the last one, (n + 1,) float64, up to which no column varies by more than ``most``."""
    count = len(nodes)
    if (np.ptp(nodes, axis=0) <= most).all():
        return np.full(count, count - 1.0)
    columns = np.ascontiguousarray(nodes.T)
    levels = [(columns, columns)]  # smallest and largest of windows of 1, 2, 4, ... nodes
    while 2 << (len(levels) - 1) <= count:
        (low, high), half = levels[-1], 1 << (len(levels) - 1)
        levels.append((np.minimum(low[:, :-half], low[:, half:]), np.maximum(high[:, :-half], high[:, half:])))
    at, least, largest = np.arange(count), columns, columns
    for k, (low, high) in reversed(list(enumerate(levels))):
        first = np.minimum(at + 1, low.shape[1] - 1)
        below, above = np.minimum(least, low[:, first]), np.maximum(largest, high[:, first])
        further = (at + 1 < low.shape[1]) & ((above - below).max(axis=0) <= most)
        least, largest = np.where(further, below, least), np.where(further, above, largest)
        at = np.where(further, at + (1 << k), at)
    return at.astype(np.float64)


def _bin_count(tf: TransferFunction, lo: float, hi: float, beside: float) -> int:
    nodes = np.asarray(getattr(tf, "breakpoints", tf.node_range)(), np.float64)
    gaps = np.diff(np.unique(np.clip(nodes, lo, hi)))
    gaps = gaps[gaps > (hi - lo) / MAX_BINS]
    wanted = BINS_PER_GAP * (hi - lo) / gaps.min() if len(gaps) else MAX_BINS
    return int(2 ** math.ceil(math.log2(min(max(wanted, MIN_BINS * beside), MAX_BINS))))


def build_tables(
    tf: TransferFunction,
    value_range: tuple[float, float],
    *,
    slope: float = 1.0,
    intercept: float = 0.0,
    unit_distance: float,
    world_per_unit: float,
    voxel: float = 1.0,
    bins: int | None = None,
) -> Optics:
    """Tabulate ``tf`` over the part of ``value_range`` (data values) in which it varies, and `BESIDE`.

    ``unit_distance`` is in world units, ``world_per_unit`` the world length of one unit-frame length, ``voxel`` a
    voxel's mean edge in the latter.
    """
    first, last = tf.node_range()
    lo, hi, beside = max(value_range[0], first), min(value_range[1], last), 1.0
    if not hi > lo:  # data wholly beyond one end node, or a constant: one value of the function is used
        lo = hi = min(max(value_range[0], first), last)
        hi = lo + max(abs(lo) * 1e-6, 1e-20)  # such that the bins of a stored unit fit into float32
    else:
        margin = BESIDE * (hi - lo)
        wide = max(value_range[0], lo - margin), min(value_range[1], hi + margin)
        beside = (wide[1] - wide[0]) / (hi - lo)
        lo, hi = wide
    count = bins or _bin_count(tf, lo, hi, beside)
    x = lo + (hi - lo) * (np.arange(count + 1) / count)
    x[-1] = hi
    tau = extinction(tf.opacity(x), unit_distance) * world_per_unit
    nodes = np.concatenate([tf.color(x) * tau[:, None], tau[:, None]], axis=1)
    cumulative = np.zeros_like(nodes)
    np.cumsum(0.5 * (nodes[1:] + nodes[:-1]), axis=0, out=cumulative[1:])
    return Optics.of((lo - intercept) / slope, slope * count / (hi - lo), nodes, cumulative, voxel)
