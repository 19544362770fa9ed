"""The error of the levels of a node, drawn alone, against the finest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from vvgt_cli.gaussians import Gaussians

SEEN_FROM = ((0.62, 0.54, 0.57), (-0.59, 0.71, -0.38), (0.46, -0.33, -0.82))  # directions along no axis
SIZE = 96  # pixels along an edge, more than the cells of a tile
AWAY, MARGIN = 30.0, 1.1  # distance of the camera, and half the field of view, in radii of the node


def level_errors(cuts: Sequence[Gaussians]) -> tuple[np.ndarray, float, int]:
    """Measure the RGBA error of each cut of a node, coarser ones later, against the first.

    Returns:
        (n,) squared differences summed over the pixels of all views, never less than those of a finer cut; the
        squared values of the finest; the number of pixels that it covers.
    """
    from vvgt_cli.cameras.sets import look_at
    from vvgt_cli.splat import render

    finest = cuts[0]
    low, high = finest.means.min(axis=0).astype(np.float64), finest.means.max(axis=0).astype(np.float64)
    middle, widest = (low + high) / 2, float(np.exp(finest.log_scales.max()))
    radius = float(np.linalg.norm(high - low)) / 2 + widest
    field = float(np.degrees(2 * np.arctan(MARGIN / AWAY)))
    squares, covered, differences = 0.0, 0, np.zeros(len(cuts))
    for direction in SEEN_FROM:
        eye = middle + AWAY * radius * np.array(direction) / np.linalg.norm(direction)
        camera = look_at(eye, target=tuple(middle), width=SIZE, height=SIZE, fov=field)
        drawn = [render(cut, camera).astype(np.float64) for cut in cuts]
        covered += int((drawn[0][..., 3] > 1 / 255).sum())
        squares += float((drawn[0] ** 2).sum())
        differences += [float(((picture - drawn[0]) ** 2).sum()) for picture in drawn]
    return np.maximum.accumulate(differences), squares, covered
