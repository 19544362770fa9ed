"""`fitting`: the named function that fits a volume, by its histogram, its place and a coarse copy of its values."""

from __future__ import annotations

import numpy as np

from vvgt_cli.look.histogram import contours
from vvgt_cli.look.recognise import AIR, air_and_tissue, background_bins, foreground, in_hounsfield
from vvgt_cli.look.resolve import StatisticsLike
from vvgt_cli.volume.bodies import largest
from vvgt_cli.volume.stored import planes
from vvgt_cli.volume.types import Volume

LUNG, BODY, BONE = (-950.0, -550.0), (-500.0, np.inf), (300.0, np.inf)  # HU
COARSE = 96  # voxels along the longest edge of the copy in which lungs are looked for
MUCH_LUNG, SOME_BONE = 0.1, 0.005  # of the voxels of body and lungs
OVER_BONE = 2.5  # times as many voxels as bone has are lungs in a chest; a skull has more bone than that
HEAD_MM = (100.0, 320.0)  # edges of the box of an image of a head
HEAD_SHARE = (0.1, 0.75)  # of the voxels of such an image that the head fills
PEAK_WIDTH, PEAK_SHARE = 0.04, 0.35  # MR has no such share of its foreground within that share of its range
LONG_CT = 1200.0  # span of values from which CT with another zero is possible, and how much it may lie higher
LOW = 0.25  # of the range of values, up to which the background of MR lies


def fitting(statistics: StatisticsLike, volume: Volume) -> str | None:
    """Return the name of a function that shows something of a volume, None if none is made for such data.

    Densities get contours. Hounsfield units get the lungs if there are some, else bone if there is any, else soft
    tissue. Images that their file calls MR, or that nothing speaks against, are treated as MR of a head.
    """
    counts, edges = (np.asarray(a, dtype=np.float64) for a in (statistics.histogram, statistics.edges))
    if not counts.any() or statistics.lo == statistics.hi:
        return None
    if volume.density:
        return contours(counts, edges)
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
