"""Choice of transfer functions by a volume's data: one for each band of values, or a named one that fits.

`suggest` (`vvgt tf suggest`) uses the histogram alone; the VVGT paper (Experiment Setup, Datasets) has about ten
functions per volume, "to highlight different scalar value ranges and internal structures". `fitting` also looks at the
voxels.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.look.histogram import contours
from vvgt_cli.look.recognise import AIR, air_and_tissue, background_bins, foreground, in_hounsfield
from vvgt_cli.volume import DENSITY, Statistics, Volume
from vvgt_cli.volume.bodies import largest
from vvgt_cli.volume.stored import planes

BY_VALUE = 0.5  # bands are equal half by the voxels in them, half by their width
WIDE = 0.25  # share of the value range; air and padding are narrow, a turbulent field's peak is the field
PLATEAU = 0.5  # share of a band at its peak opacity; the rest are ramps on either side
OPTICAL_DEPTH = 1.5  # wanted along a ray through the whole volume, on average
PEAK = (1e-3, 0.5)  # opacity per voxel at a band's plateau: rare values cannot be more than opaque
LIGHTNESS, CHROMA = (45.0, 70.0, 92.0), (45.0, 60.0, 25.0)  # CIE LCh at a band's low end, middle and high end
FIRST_HUE, HUES = 275.0, 235.0  # degrees in CIE Lab: from blue for low values over green to red for high ones
LUNG, BODY, BONE = (-950.0, -550.0), (-500.0, np.inf), (300.0, np.inf)  # HU
COARSE = 96  # voxels along the longest edge of the copy in which lungs are looked for
MUCH_LUNG, SOME_BONE = 0.1, 0.005  # of the voxels of body and lungs
OVER_BONE = 2.5  # times as many voxels as bone has are lungs in a chest; a skull has more bone than that
HEAD_MM = (100.0, 320.0)  # edges of the box of an image of a head
HEAD_SHARE = (0.1, 0.75)  # of the voxels of such an image that the head fills
PEAK_WIDTH, PEAK_SHARE = 0.04, 0.35  # MR has no such share of its foreground within that share of its range
LONG_CT = 1200.0  # span of values from which CT with another zero is possible, and how much it may lie higher
LOW = 0.25  # of the range of values, up to which the background of MR lies

Bins = tuple[int, int]  # [first, last)


@dataclass(frozen=True)
class Suggestion:
    """A function that shows one band of values.

    Attributes:
        name: number and range of the band.
        x: (k,) ascending data values.
        opacity: (k,) per ``unit_distance``.
        rgb: (k, 3) in [0, 1].
        unit_distance: world length that the opacities are per.
        share: share of the finite voxels inside the band.
    """

    name: str
    x: np.ndarray
    opacity: np.ndarray
    rgb: np.ndarray
    unit_distance: float
    share: float

    def to_json(self) -> str:
        """Return the minimal JSON form (`vvgt_cli.look.readers.minimal`); numbers keep every bit."""
        points: list[dict[str, Any]] = [
            {"x": float(x), "rgb": [round(float(c), 4) for c in rgb], "opacity": float(opacity)}
            for x, rgb, opacity in zip(self.x, self.rgb, self.opacity, strict=True)
        ]
        document = {"name": self.name, "opacity_unit_distance": self.unit_distance, "points": points}
        return json.dumps(document, indent=1) + "\n"


def suggest(statistics: Statistics, count: int, voxels: float, spacing: float) -> list[Suggestion]:
    """Return functions for ``count`` bands of the foreground's values, low values first; deterministic.

    A band is a trapezoid: transparent outside, constant in its middle half and up to the ends of the data. Its height
    gives a ray through the volume an optical depth of 1.5 on average, so that common values are fog and rare ones
    solid. A peak that spans more than a quarter of the values is no background.

    ``voxels`` lie along a ray through the volume (the mean of its dimensions, say), ``spacing`` is a voxel's edge in
    world units: what opacities are per.

    Raises:
        DataError: no finite voxel, or a single value.
    """
    counts = np.asarray(statistics.histogram, dtype=np.float64)
    edges = np.asarray(statistics.edges, dtype=np.float64)
    lo, hi = float(statistics.lo), float(statistics.hi)
    if not (math.isfinite(lo) and math.isfinite(hi)) or counts.sum() <= 0:
        raise DataError("the data have no finite voxel; expected some to choose transfer functions from")
    if lo == hi:
        raise DataError(f"every value of the data is {lo:g}; expected some that differ to choose ranges from")
    first, last = background_bins(counts)  # which no function shows, unless it is all or wide
    alone = counts[first:last].sum() == counts.sum()
    background = (0, 0) if alone or last - first > WIDE * counts.size else (first, last)
    data, grid = (counts, edges, background), (voxels, spacing)
    return [_suggestion(band, data, (k, count), grid) for k, band in enumerate(_bands(counts, background, count))]


def _bands(counts: np.ndarray, background: Bins, count: int) -> list[Bins]:
    """Return the bins [first, last) of each band, all on one side of the background, with some voxels."""
    sides = [(0, background[0]), (background[1], counts.size)]
    sides = [(a, b) for a, b in sides if counts[a:b].sum() > 0]
    bins = np.concatenate([np.arange(a, b) for a, b in sides])
    weight = (1 - BY_VALUE) * counts[bins] / counts[bins].sum() + BY_VALUE / bins.size
    ends = np.interp(np.arange(count + 1) / count, np.concatenate([[0.0], np.cumsum(weight)]), np.arange(bins.size + 1))
    bands = []
    for low, high in pairwise(ends):
        i = min(round(float(low)), bins.size - 1)
        chosen = slice(i, max(round(float(high)), i + 1))
        parts = [(bins[chosen], weight[chosen], side) for side in sides]
        inside = [(w[(b >= s[0]) & (b < s[1])].sum(), b[(b >= s[0]) & (b < s[1])], s) for b, w, s in parts]
        _, mine, (start, stop) = max(inside, key=lambda part: part[0])  # where it straddles: the heavier part
        first, last = int(mine[0]), int(mine[-1]) + 1
        while not counts[first:last].any():
            first, last = max(first - 1, start), min(last + 1, stop)
        bands.append((first, last))
    return bands


def _suggestion(
    band: tuple[int, int], data: tuple[np.ndarray, np.ndarray, Bins], which: tuple[int, int], grid: tuple[float, float]
) -> Suggestion:
    """Return the function of a band of bins, number ``which[0]`` of ``which[1]``.

    ``data`` is (counts, edges, background), ``grid`` (voxels, spacing).
    """
    (first, last), (counts, edges, background), (k, count), (voxels, spacing) = band, data, which, grid
    low, high, rim = float(edges[first]), float(edges[last]), float(edges[1] - edges[0])
    ramp = (1 - PLATEAU) / 2 * (high - low)
    # a bin more on either side, as whole numbers lie on the edges of bins; not towards the background
    left, right = (rim * (edge not in background) for edge in band)
    x = np.array([low - left, low + ramp, high - ramp, high + right])
    shape = np.array([float(first == 0), 1, 1, float(last == counts.size)])  # solid up to the ends of the data
    weight = np.interp(0.5 * (edges[:-1] + edges[1:]), x, shape)
    share = float((counts * weight).sum() / counts.sum())
    # -ln(1 - peak) per voxel, times the voxels of the band that a ray meets, is the optical depth wanted
    peak = min(max(-math.expm1(-OPTICAL_DEPTH / (share * voxels)), PEAK[0]), PEAK[1])
    hue = math.radians(FIRST_HUE - HUES * (k / (count - 1) if count > 1 else 0.5))
    lab = np.array([[v, c * math.cos(hue), c * math.sin(hue)] for v, c in zip(LIGHTNESS, CHROMA, strict=True)])
    colors = _rgb(np.array([lab[0], 0.5 * (lab[0] + lab[1]), 0.5 * (lab[1] + lab[2]), lab[2]]))
    name = f"band {k + 1} of {count}: {low:g} to {high:g}"
    inside = float(counts[first:last].sum() / counts.sum())
    return Suggestion(name, x, peak * shape, colors, spacing, inside)


def _rgb(lab: np.ndarray) -> np.ndarray:
    """Return sRGB (n, 3) in [0, 1] of CIE L*a*b* colours (n, 3)."""
    from vtkmodules.vtkCommonCore import vtkMath

    rgb = np.empty_like(lab)
    for row, out in zip(lab, rgb, strict=True):
        vtkMath.LabToRGB(row, out)
    return rgb.clip(0, 1)


def fitting(statistics: Statistics, volume: Volume) -> str | None:
    """Return the name of a function that shows something of a volume, None if none is made for such data.

    Densities get contours. Hounsfield units get the lungs if there are some, else bone if there is any, else soft
    tissue. Images that their file calls MR, or that nothing speaks against, are treated as MR of a head.
    """
    counts, edges = (np.asarray(a, dtype=np.float64) for a in (statistics.histogram, statistics.edges))
    if not counts.any() or statistics.lo == statistics.hi:
        return None
    if volume.preset:
        return contours(counts, edges) if volume.preset == DENSITY else volume.preset
    if volume.hounsfield or (volume.modality in ("", "CT") and in_hounsfield(counts, edges)):
        body, bone = (_share(counts, edges, *span) / counts.sum() for span in (BODY, BONE))
        lung = _lungs(volume)
        if lung > max(MUCH_LUNG * (lung + body), OVER_BONE * bone):
            return "ct-lung"
        return "ct-bone" if bone > SOME_BONE * body else "ct-soft-tissue"
    return "mr-head" if volume.modality == "MR" or _may_be_mr_head(volume, counts, edges) else None


def _lungs(volume: Volume) -> float:
    """Return the share of voxels inside lungs: gas with gas on all sides, and the body around it along two axes.

    The foam of head rests lies outside of the body, and the surfaces of sinuses and bowels are thin.
    """
    step = max(1, max(volume.dims) // COARSE)
    kept = [plane[::step, ::step] for k, plane in enumerate(planes(volume)) if k % step == 0]
    values = volume.slope * np.stack(kept).astype(np.float32) + volume.intercept
    body = largest(values > BODY[0])
    gas = (values > LUNG[0]) & (values < LUNG[1])
    around, inside = np.zeros(gas.shape, np.int8), gas.copy()
    for axis in range(3):
        before = np.maximum.accumulate(body, axis)
        after = np.flip(np.maximum.accumulate(np.flip(body, axis), axis), axis)
        around += before & after
        inside &= np.roll(gas, 1, axis) & np.roll(gas, -1, axis)
    return float(np.count_nonzero(inside & (around >= 2))) / gas.size


def _may_be_mr_head(volume: Volume, counts: np.ndarray, edges: np.ndarray) -> bool:
    """Return whether nothing speaks against MR of a head: size, type, and shape of the histogram."""
    if volume.modality or volume.space is None or not all(HEAD_MM[0] <= e <= HEAD_MM[1] for e in volume.extent):
        return False
    if (volume.data.dtype.itemsize == 1 and volume.slope == 1) or edges[0] < 0:  # 8-bit copies of anything
        return False
    last, front = background_bins(counts)[1], foreground(counts)
    share = front.sum() / counts.sum()
    if front is counts or last > LOW * counts.size or not HEAD_SHARE[0] <= share <= HEAD_SHARE[1]:
        return False
    shifts = edges[edges < edges[0] + LONG_CT] - sum(AIR) / 2 if edges[-1] - edges[0] > LONG_CT else ()
    if any(air_and_tissue(counts, edges - shift) for shift in shifts):
        return False
    high = np.interp(0.99, np.cumsum(front) / front.sum(), edges[1:]) - edges[0]
    width = max(1, round(PEAK_WIDTH * high / (edges[1] - edges[0])))
    return bool(np.convolve(front, np.ones(width)).max() < PEAK_SHARE * front.sum())


def _share(counts: np.ndarray, edges: np.ndarray, lo: float, hi: float) -> float:
    """Return the number of voxels with values from ``lo`` to ``hi``, interpolated linearly within bins."""
    below = np.interp((lo, hi), edges, np.concatenate([[0.0], np.cumsum(counts)]))
    return float(below[1] - below[0])
