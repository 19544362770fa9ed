"""Which named function fits a volume, for `vvgt info`."""

from __future__ import annotations

import numpy as np

from vvgt_cli.look.histogram import contours
from vvgt_cli.look.recognise import foreground, in_hounsfield
from vvgt_cli.look.resolve import StatisticsLike
from vvgt_cli.volume.types import Volume

LUNG, EDGE, BODY, BONE = (-900.0, -600.0), (-500.0, -200.0), (-500.0, np.inf), (300.0, np.inf)  # HU
MUCH_LUNG, SOME_BONE = 0.12, 0.005  # of the voxels of the body, and of lungs
OVER_BONE = 2.5  # times as many voxels as bone has are lungs in a chest; a skull has more bone than that


def fitting(statistics: StatisticsLike, volume: Volume) -> str | None:
    """Name of a function that shows something of a volume, None where none is made for such data.

    Densities get contours. In Hounsfield units it is the lungs where they are large, else bone where there is any, else
    soft tissue. Voxels on a surface to air have any value in between, `EDGE`'s as often as `LUNG`'s; foam of head rests
    lies below. Other volumes in an anatomical space, with a background, are taken for MR of a head.
    """
    counts, edges = (np.asarray(a, dtype=np.float64) for a in (statistics.histogram, statistics.edges))
    if not counts.any() or statistics.lo == statistics.hi:
        return None
    if volume.density:
        return contours(counts, edges)
    if volume.hounsfield or in_hounsfield(counts, edges):
        lung, edge, body, bone = (_share(counts, edges, *span) for span in (LUNG, EDGE, BODY, BONE))
        lung -= edge
        if lung > max(MUCH_LUNG * (lung + body), OVER_BONE * bone):
            return "ct-lung"
        return "ct-bone" if bone > SOME_BONE * body else "ct-soft-tissue"
    return "mr-head" if volume.space is not None and foreground(counts) is not counts else None


def _share(counts: np.ndarray, edges: np.ndarray, lo: float, hi: float) -> float:
    """Voxels with values from ``lo`` to ``hi``, straight lines within bins."""
    below = np.interp((lo, hi), edges, np.concatenate([[0.0], np.cumsum(counts)]))
    return float(below[1] - below[0])
