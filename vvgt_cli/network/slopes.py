"""Gradients of the image error by each Gaussian, as input of a network that predicts a step.

They are taken in a Gaussian's own axes, ``mu + R S d``, ``log s + e``, ``q (1, w / 2)``, so that they mean the same at
any size and in any direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import INRIA, Rule
from vvgt_cli.network.config import STEP
from vvgt_cli.splat.half import halved

FIELDS = ((0, 3), (3, 6), (6, 9), (9, 10), (10, 13))  # d, e, w, logit, colour: columns of a step


def own_axes_gradients(
    quaternions: np.ndarray, axes: np.ndarray, scales: np.ndarray, gradients: Sequence[np.ndarray]
) -> np.ndarray:
    """Return (K, 13) gradients by a step in the own axes, from those by the fields of `Gaussians`, in their order.

    Args:
        quaternions: (K, 4) of norm 1.
        axes: (K, 3, 3) their rotations.
        scales: (K, 3) standard deviations.
        gradients: by means, log-scales, quaternions, logits and colours.
    """
    means, log_scales, turns, logits, colors = gradients
    along = np.einsum("kij,ki->kj", axes, means) * scales
    w, x, y, z = quaternions.T
    a, b, c, d = turns.T
    # q times (0, e_i) / 2, dotted with the gradient by q
    spin = np.stack(
        [w * b - x * a + z * c - y * d, w * c - z * b - y * a + x * d, w * d + y * b - x * c - z * a], axis=1
    )
    return np.concatenate([along, log_scales, spin / 2, logits[:, None], colors], axis=1)


def slope_rows(gaussians: Gaussians, cameras: Sequence[Camera], images: np.ndarray, rule: Rule = INRIA) -> np.ndarray:
    """Return (K, `SLOPES`) float32 of Gaussians with unit quaternions; L is half a view's sum of squared RGBA errors.

    Columns, g_v the (13,) gradient of view v's L in the own axes, n views:
    - 13: ``sum g / sqrt(n sum g^2)`` in [-1, 1]: the direction, and how far the views agree on it;
    - 5, one per field: log of ``sqrt(sum g^2 / n)``, its mean over the field, per pixel of blending weight and error;
    - log of the blending weight per view (pixels), log of the error below it, over that of the scene;
    - log of the scene's RMS error; log of a pixel's width at the origin, less that of a standard deviation.
    """
    from vvgt_cli.gaussians.frames import rotations
    from vvgt_cli.splat import gather, project, render, render_backward

    g, count = gaussians, len(gaussians)
    axes, scales = rotations(g.quaternions).astype(np.float32), np.exp(g.log_scales)
    total, squares = np.zeros((count, STEP), np.float32), np.zeros((count, STEP), np.float32)
    weights, error = np.zeros((count, 5)), 0.0
    pixel = float(np.median([np.linalg.norm(c.position) / c.fx for c in cameras]))
    cameras, images, rule = halved(cameras, images, rule)
    for camera, view in zip(cameras, images, strict=True):
        projection = project(g, camera, rule)
        image = render(g, camera, projection=projection)
        rest = image - view
        slope = render_backward(g, camera, projection, image, 2 * rest)
        fields = slope.means, slope.log_scales, slope.quaternions, slope.opacity_logits, slope.colors
        own = own_axes_gradients(g.quaternions, axes, scales, fields)
        total += own
        squares += own * own
        size = np.sqrt((rest**2).mean(axis=2))  # (h, w) RMS over RGBA
        error += float((size**2).mean())
        gather(projection, np.broadcast_to(size, (4, *size.shape)), weights)
    n = len(cameras)
    rms = math.sqrt(error / n) + 1e-6
    weight = weights[:, 0] / n  # pixels a view
    per_pixel = np.sqrt(squares / n) / ((weight + 0.1) * rms)[:, None]
    sizes = [np.log(np.sqrt((per_pixel[:, a:b] ** 2).mean(axis=1)) + 1e-4) for a, b in FIELDS]
    below = np.log((weights[:, 1] + 1e-3 * rms) / ((weights[:, 0] + 1e-3) * rms))
    thick = math.log(pixel) - g.log_scales.mean(axis=1)
    columns = [
        total / np.sqrt(n * squares + 1e-30), *sizes, np.log(weight + 0.01), below,
        np.full(count, math.log(rms) + 3.5), thick,
    ]  # fmt: skip
    return np.column_stack(columns).astype(np.float32)
