"""The look that places live splats: all values but the background's, or all labels alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.histogram import UNIT_SHARE, worth_showing
from vvgt_cli.look.labels import LabelTable
from vvgt_cli.look.recognise import background_bins
from vvgt_cli.look.resolve import StatisticsLike

NAME = "fog"
THIN, THICK = 0.02, 0.3  # opacity per `UNIT_SHARE` of the box's edge, right beside the background and farthest from it
BETWEEN = 9  # places around a node where the function that is given may show something
NODES = 129  # of a function over 256 bins
HIDDEN_WEIGHT = 0.25  # how much a label of opacity 0 counts, which another table may show
SMALL = 2 / 3  # power of a label's voxels that its cells count less by: small ones are to keep their shape
GOLDEN = 0.6180339887498949  # labels of neighbouring numbers get codes far from each other


def fog(statistics: StatisticsLike, shown: TransferFunction | None = None) -> TransferFunction:
    """Return a function that is transparent only in the background, and denser the farther a value is from it.

    Args:
        statistics: range and histogram of the data.
        shown: a function on data values whose visible values must not be transparent.

    Returns:
        Opacity per `UNIT_SHARE`; red is the value as a share of the range, green its square: their means over a cell
        give the variance of its values.
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


def label_fog(table: LabelTable, voxels: Mapping[int, int]) -> LabelTable:
    """Return a table that gives each label in ``voxels`` the opacity `THIN` and a code of its own.

    Red is the code in [0, 1] and green its square: their means over a cell show whether it holds several labels. Blue
    is the weight of the label, from its number of ``voxels``.
    """
    least, labels = max(min(voxels.values(), default=1), 1), []
    for number, label in enumerate(table.labels):
        code, weight = (number * GOLDEN) % 1, (least / max(voxels.get(label.number, least), least)) ** SMALL
        weight *= 1 if label.opacity > 0 else HIDDEN_WEIGHT
        labels.append(replace(label, color=(code, code**2, weight), opacity=THIN if label.number in voxels else 0.0))
    return LabelTable(NAME, tuple(labels))
