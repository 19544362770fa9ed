"""Functions of all kinds over the same data: what splats that can be shown under any function are fitted to."""

from __future__ import annotations

import colorsys
import math
from dataclasses import dataclass

import numpy as np

from vvgt_cli.look.colormap import ColorMap
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.histogram import background_bins, worth_showing
from vvgt_cli.look.opacity import PiecewiseOpacity
from vvgt_cli.look.resolve import StatisticsLike

WIDTH = 0.02, 0.5  # half widths of windows, shares of the range of values
OPACITY = 0.05, 0.8  # at the top of a window
EDGE = 0.125  # half width of a step, of a window's
FOOT = 0.3  # of the range above the background: where ramps begin at most
COLORS = 6  # nodes, two at the ends of the range


@dataclass(frozen=True)
class Foreground:
    """Values that are not the background's.

    Attributes:
        lo, hi: range of the data.
        foot: where the foreground begins.
        cumulative, edges: (257,) share of its voxels below each edge of the histogram.
    """

    lo: float
    hi: float
    foot: float
    cumulative: np.ndarray
    edges: np.ndarray

    @classmethod
    def of(cls, statistics: StatisticsLike) -> Foreground:
        """Above the background, or on both sides where both are worth showing."""
        counts, edges = np.array(statistics.histogram, np.float64), np.asarray(statistics.edges, np.float64)
        first, last = background_bins(counts)
        foot = float(edges[last]) if last > first else float(edges[0])
        counts[first:last] = 0
        if worth_showing(slice(0, first), counts):
            foot = float(edges[0])
        else:
            counts[:first] = 0
        if not counts.sum():
            counts[:] = 1
        cumulative = np.concatenate([[0.0], np.cumsum(counts)]) / counts.sum()
        return cls(float(statistics.lo), float(statistics.hi), foot, cumulative, edges)


def varied(statistics: StatisticsLike, count: int, distance: float, seed: int = 0) -> list[TransferFunction]:
    """``count`` functions of random windows, steps and ramps in random colours, none of which is like a given one.

    Half lie where voxels are many, half anywhere in the range of the foreground.

    Args:
        statistics: range and histogram of the data.
        count: how many.
        distance: world length that their opacities are per.
        seed: of what is random.
    """
    part = Foreground.of(statistics)
    rng = np.random.default_rng([seed, count])
    return [_one(part, rng, bool(k % 2), distance) for k in range(count)]


def _one(part: Foreground, rng: np.random.Generator, common: bool, distance: float) -> TransferFunction:
    """A window, a step or a ramp."""
    share, span = rng.random(), part.hi - part.lo
    if common:
        middle = float(np.interp(share, part.cumulative, part.edges))
    else:
        middle = part.foot + (part.hi - part.foot) * share
    width, top = span * _between(rng, WIDTH), _between(rng, OPACITY)
    kind = rng.integers(3)
    start = part.foot + (part.hi - part.foot) * FOOT * rng.random()
    if kind == 0:
        x, y = [middle - width, middle, middle + width], [0.0, top, 0.0]
    elif kind == 1:
        x, y = [middle - EDGE * width, middle + EDGE * width], [0.0, top]
    else:
        x, y = [start, part.hi], [0.0, top]
    at = np.concatenate([[part.lo, part.hi], middle + width * rng.uniform(-2, 2, COLORS - 2)])
    tints = [colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.2, 1), rng.uniform(0.4, 1)) for _ in at]
    opacity, colors = PiecewiseOpacity(np.array(x), np.array(y)), ColorMap(at, np.array(tints))
    return TransferFunction("varied", opacity, colors, opacity_unit_distance=distance, opacity_unit_label="varied")


def _between(rng: np.random.Generator, ends: tuple[float, float]) -> float:
    """Any order of magnitude between two is as likely as any other."""
    return math.exp(rng.uniform(math.log(ends[0]), math.log(ends[1])))
