"""Default transfer functions: tissue by Hounsfield units, contours of densities, or opacity from the histogram."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.readers.names import named_function
from vvgt_cli.look.recognise import SIDE, background_bins, in_hounsfield, moments
from vvgt_cli.look.resolve import resolve
from vvgt_cli.volume import DENSITY, Statistics

NAME = "automatic (histogram)"
HOUNSFIELD = "automatic (Hounsfield units)"
CONTOUR = "automatic ({})"  # of densities, smoke and fire: the named function
BOTH = 0.5  # depth of the negative side of a density, of that of the positive one, from which it is shown too
UNIT_SHARE = 1 / 256  # of the box's longest edge: what opacities are per, so that they do not depend on voxels or units
SIDE_WIDTH = 0.125  # share of the value range that it must span: less is padding or clipping
DEPTH = 4.0  # optical depth of the foreground along the longest edge, on average over the box
RISE = 2.0  # power of the distance from the background by which ranges of values share that depth
NODES = 33  # of opacity, a side
SMOOTH = 3.0  # filled bins: standard deviation of what counts are averaged by
LABELS = 0.25  # share of the bins up to which those that are filled are values of their own, not averaged
OPAQUE = 0.5  # most opacity per unit distance
FAINT = 0.01  # opacity of data of a single value
# Lightness rises from 25 to 97 (CIE L*), from brown over flesh to ivory; below an ambient value from blue to white
COLORS = np.array([
    [0.36, 0.17, 0.12], [0.60, 0.30, 0.20], [0.80, 0.49, 0.33], [0.91, 0.70, 0.50], [0.97, 0.87, 0.72], [1, 0.98, 0.93],
])  # fmt: skip
COLD = COLORS[:, ::-1]
# HU, opacity per unit distance, colour: air; skin, lungs' and bowels' walls; fat; organs; vessels with contrast; bone
TISSUES = (
    (-700, 0.0, (0.75, 0.45, 0.35)),
    (-450, 0.014, (0.80, 0.52, 0.40)),
    (-250, 0.008, (0.85, 0.60, 0.45)),
    (-120, 0.001, (0.90, 0.72, 0.48)),
    (-20, 0.0015, (0.80, 0.45, 0.35)),
    (60, 0.005, (0.72, 0.30, 0.24)),
    (130, 0.015, (0.80, 0.25, 0.18)),
    (220, 0.07, (0.88, 0.35, 0.22)),
    (400, 0.14, (0.95, 0.70, 0.48)),
    (700, 0.30, (0.98, 0.92, 0.80)),
    (1500, 0.5, (1.0, 0.99, 0.95)),
)


def from_histogram(statistics: Statistics, hounsfield: bool = False, preset: str = "") -> TransferFunction:
    """Return a transfer function chosen from the histogram; deterministic.

    Densities get `contours`, smoke and fire the functions of these names. Hounsfield units (stated, or air near -1000
    and tissue around 0) get `TISSUES`. For other values the peak with most voxels is background: its foot is found by
    the triangle method (Zack, Rogers, Latt 1977) on each side that leads to more data; a second dominant peak right
    behind it (air behind narrow padding) is skipped too. Other values share an optical depth of `DEPTH` by the square
    of their distance from it, however many voxels hold them. Data without a dominant peak are shown whole.

    Args:
        statistics: range and histogram of the data.
        hounsfield: whether the file states that data values are Hounsfield units.
        preset: see `Volume.preset`.

    Returns:
        The function on data values, opacity per `UNIT_SHARE`, named `NAME`, `HOUNSFIELD` or `CONTOUR`.

    Raises:
        DataError: no finite voxel.
    """
    counts = np.asarray(statistics.histogram, dtype=np.float64)
    edges = np.asarray(statistics.edges, dtype=np.float64)
    lo, hi = float(statistics.lo), float(statistics.hi)
    if not (math.isfinite(lo) and math.isfinite(hi)) or counts.sum() <= 0:
        raise DataError("the data have no finite voxel; expected some to choose a transfer function from")
    if lo == hi:  # a box, seen through
        return _function(NAME, np.array([lo]), np.array([FAINT]), ColorMap(np.array([lo]), COLORS[3:4], space="Lab"))
    if preset:
        name = contours(counts, edges) if preset == DENSITY else preset
        shown = resolve(named_function(name), statistics)
        shown = replace(shown, name=CONTOUR.format(name), opacity_unit_label="automatic")
        if shown.support(lo, hi):
            return shown
    if hounsfield or in_hounsfield(counts, edges):
        x, y, rgb = (np.array(column, dtype=np.float64) for column in zip(*TISSUES, strict=True))
        tissues = _function(HOUNSFIELD, x, y, ColorMap(x, rgb, space="Lab"))
        if tissues.support(lo, hi):
            return tissues
    first, last = background_bins(counts)
    left, right = (worth_showing(side, counts) for side in (slice(0, first), slice(last, None)))
    if not (left or right):
        first = last = 0
    positions: list[float] = []
    opacities: list[float] = []
    colors: list[np.ndarray] = []
    if left:
        x, y, rgb = _side(counts[:first][::-1], counts.sum(), COLD)
        positions += (first - x)[::-1].tolist()
        opacities += y[::-1].tolist()
        colors += [*rgb[::-1]]
    if right or not left:
        x, y, rgb = _side(counts[last:], counts.sum(), COLORS)
        positions += (last + x).tolist()
        opacities += y.tolist()
        colors += [*rgb]
    at = np.interp(positions, np.arange(counts.size + 1), edges)
    return _function(NAME, at, np.array(opacities), ColorMap(at, np.array(colors), space="Lab"))


def contours(counts: np.ndarray, edges: np.ndarray) -> str:
    """Return the name of a density's function: with both signs if its least value is far below the mean too."""
    mean, _ = moments(counts, edges)
    filled = np.flatnonzero(counts)
    below, above = mean - float(edges[filled[0]]), float(edges[filled[-1] + 1]) - mean
    return "density-difference" if below >= BOTH * above else "density-contour"


def _function(name: str, x: np.ndarray, y: np.ndarray, colors: ColorMap) -> TransferFunction:
    return TransferFunction(
        name, PiecewiseOpacity(x, y), colors, opacity_unit_share=UNIT_SHARE, opacity_unit_label="automatic"
    )


def _side(counts: np.ndarray, total: float, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nodes for one side of the background, outwards: distance from it in bins, opacity, RGB."""
    bins, filled = counts.size, np.flatnonzero(counts)
    common = counts[filled] if filled.size <= LABELS * bins else _averaged(counts[filled])
    weight = ((filled + 0.5) / bins) ** RISE
    # the optical depth of a bin along the longest edge is its extinction, times its share of the voxels, times 256
    extinction = DEPTH * weight / weight.sum() / (common / total) * UNIT_SHARE
    extinction = np.minimum(extinction, -math.log1p(-OPAQUE))
    x = np.linspace(0, bins, NODES)
    if filled.size <= NODES:  # labels: nothing of its own between them
        x = np.unique(np.concatenate([[0.0], filled + 0.5, [float(bins)]]))
    y = -np.expm1(-np.interp(x, filled + 0.5, extinction))
    y[0] = 0.0
    rank = np.interp(x, np.arange(bins + 1), np.concatenate([[0.0], np.cumsum(counts)]) / counts.sum())
    along = 0.5 * (rank + x / bins) * (len(colors) - 1)
    rgb = np.stack([np.interp(along, np.arange(len(colors)), channel) for channel in colors.T], axis=1)
    return x, y, rgb


def _averaged(counts: np.ndarray) -> np.ndarray:
    """Return counts of neighbouring filled bins, averaged by a Gaussian, (n,); all above 0."""
    reach = np.arange(-int(4 * SMOOTH), int(4 * SMOOTH) + 1)
    kernel = np.exp(-0.5 * (reach / SMOOTH) ** 2)
    return np.convolve(np.pad(counts, reach[-1], mode="edge"), kernel / kernel.sum(), mode="valid")


def worth_showing(side: slice, counts: np.ndarray) -> bool:
    """Return whether a side of the background is wide and full enough to be more than padding or stray voxels."""
    inside = counts[side]
    # of the foreground as a whole: all but the voxels of the highest bin, which is always background
    return inside.size >= SIDE_WIDTH * counts.size and inside.sum() >= SIDE * (counts.sum() - counts.max()) > 0
