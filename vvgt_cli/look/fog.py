"""The look that splats which can be shown under any function are placed by: all values but the background's."""

from __future__ import annotations

import numpy as np

from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.histogram import UNIT_SHARE, worth_showing
from vvgt_cli.look.recognise import background_bins
from vvgt_cli.look.resolve import StatisticsLike

NAME = "fog"
THIN, THICK = 0.02, 0.3  # opacity per `UNIT_SHARE` of the box's edge, right beside the background and farthest from it
BETWEEN = 9  # places around a node where the function that is given may show something
NODES = 129  # of a function over 256 bins


def fog(statistics: StatisticsLike, shown: TransferFunction | None = None) -> TransferFunction:
    """A function that is transparent where the background is, and only there; thicker the farther from it.

    Args:
        statistics: range and histogram of the data.
        shown: a function, on data values, whose visible values are not transparent.

    Returns:
        Opacity per `UNIT_SHARE`; red is the value as a share of the range, green its square: their means over a cell
        say how far its values are spread.
    """
    counts = np.asarray(statistics.histogram, np.float64)
    lo, hi = float(statistics.lo), float(statistics.hi)
    first, last = background_bins(counts)
    if not worth_showing(slice(0, first), counts):  # padding below it
        first = 0
    t = np.linspace(0, 1, NODES)
    at = t * len(counts)
    below, above = (first - at) / max(first, 1), (at - last) / max(len(counts) - last, 1)
    far = np.maximum(below, above) if last > first else t
    opacity = np.where(far > 0, THIN + (THICK - THIN) * far, 0.0)
    x = lo + (hi - lo) * t
    if lo == hi:
        x, opacity = np.array([lo]), np.array([THIN])
    elif shown is not None:
        about = x[:, None] + (x[1] - x[0]) * np.linspace(-0.5, 0.5, BETWEEN)
        opacity = np.maximum(opacity, np.minimum(shown.opacity(about).max(axis=1), THIN))
    if not opacity.any():
        opacity[:] = THIN
    share = t[: len(x)]
    colors = np.stack([share, share**2, np.zeros(len(x))], axis=1)
    return TransferFunction(
        NAME, PiecewiseOpacity(x, opacity), ColorMap(x, colors), opacity_unit_share=UNIT_SHARE, opacity_unit_label=NAME
    )
