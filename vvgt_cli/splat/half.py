"""Views at half the size: what they say about Gaussians costs about half as much, and is worth nearly as much."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians.rules import INRIA, Rule


def halved(cameras: Sequence[Camera], images: np.ndarray, rule: Rule = INRIA) -> tuple[list[Camera], np.ndarray, Rule]:
    """Average views 2 x 2 where their sides are even; return them and the rule that stands for the standard one.

    Args:
        cameras: of the views.
        images: (n, h, w, c) float32.
        rule: by which these are drawn.
    """
    h, w = images.shape[1:3]
    if h % 2 or w % 2:
        return list(cameras), images, rule
    upper, lower = images[:, ::2], images[:, 1::2]
    mean = np.float32(0.25) * (upper[:, :, ::2] + upper[:, :, 1::2] + lower[:, :, ::2] + lower[:, :, 1::2])
    return [camera.resized(0.5) for camera in cameras], mean, rule.at(0.5)
