"""Line search by halving: the share of a predicted step that lowers the error of views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import INRIA, Rule
from vvgt_cli.splat.half import halved

VIEWS = 3  # of those that the network has read
SMALLEST = 1 / 16  # share of a step; below it none is taken


def interpolate(start: Gaussians, end: Gaussians, share: float) -> Gaussians:
    """Return the Gaussians ``share`` of the way; quaternions of norm 1, on the short arc's chord."""
    mix = lambda a, b: a + np.float32(share) * (b - a)  # noqa: E731
    fields = {field: mix(array, getattr(end, field)) for field, array in start.arrays().items()}
    fields["quaternions"] /= np.linalg.norm(fields["quaternions"], axis=1, keepdims=True)
    return Gaussians(**fields)


def damped(
    start: Gaussians, end: Gaussians, cameras: Sequence[Camera], images: np.ndarray, rule: Rule = INRIA
) -> tuple[Gaussians, float]:
    """Return the step from ``start`` to ``end`` shortened by halving while that lowers the error, and its share.

    On scenes unlike those it was trained on, a network errs first by the size of its steps. The error is the squared
    one of RGBA over `VIEWS` of the given views, averaged 2 x 2; the share is 0 if none lowers it.
    """
    from vvgt_cli.splat import render

    some = np.linspace(0, len(cameras) - 1, min(VIEWS, len(cameras))).round().astype(int)
    few, views, rule = halved([cameras[i] for i in some], images[some], rule)

    def error(gaussians: Gaussians) -> float:
        total = 0.0
        for camera, view in zip(few, views, strict=True):
            picture = render(gaussians, camera, rule)
            total += float(np.square(picture - view, dtype=np.float64).sum())
        return total

    share, best, lowest = 1.0, end, error(end)
    while share > SMALLEST:
        closer = interpolate(start, end, share / 2)
        now = error(closer)
        if now >= lowest:
            break
        share, best, lowest = share / 2, closer, now
    return (best, share) if lowest < error(start) else (start, 0.0)
