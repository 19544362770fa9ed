"""The loss's term for texture: errors that change from pixel to pixel weigh more where the view is smooth.

Cells of the pyramid stand on a lattice, and on a smooth face the eye sees its weave long before squared errors do.
With e the error less its blur, and v the view's variance under the same window, the term is ``sum e^2 C / (C + v)``:
all of it where the view is smooth, next to nothing of it at edges. It is linear in the error, so that its gradient is
the same blur once more. SSIM does so too, and to the mean brightness, which costs edges (docs/log/closed-form.md).
"""

from __future__ import annotations

import numpy as np

from vvgt_cli.refine.ssim import KERNEL, blur

SMOOTH = 4e-3  # C, variance of a channel: edges of an eighth of the range and more hardly count


def add_texture_gradient(image: np.ndarray, target: np.ndarray, weight: float, grad: np.ndarray) -> float:
    """``grad`` += gradient of ``weight`` x the term over pixels and RGB; returns the term's sum, unweighted.

    Args:
        image, target: (h, w, 4) float32 premultiplied.
        grad: (h, w, 4) float32; alpha is left alone.
    """
    h, w = image.shape[:2]
    r = KERNEL.size // 2
    padded = np.zeros((7, h + 2 * r, w + 2 * r), np.float32)
    planes, blurred = np.empty((7, h, w), np.float32), np.empty((7, h, w), np.float32)
    seen = target[..., :3].transpose(2, 0, 1)
    planes[:3] = image[..., :3].transpose(2, 0, 1) - seen
    planes[3:6] = seen
    planes[6] = np.square(seen).sum(axis=0)
    blur(planes, KERNEL, padded, blurred)
    variance = np.maximum(blurred[6] - np.square(blurred[3:6]).sum(axis=0), 0) / 3  # (h, w), mean of the channels
    share = np.float32(SMOOTH) / (np.float32(SMOOTH) + variance)
    errors = planes[:3] - blurred[:3]  # (3, h, w)
    planes[:3] = share * errors
    total = float((planes[:3] * errors).sum(dtype=np.float64))
    blur(planes[:3], KERNEL, padded[:3], blurred[:3])
    grad[..., :3] += np.float32(2 * weight) * (planes[:3] - blurred[:3]).transpose(1, 2, 0)
    return total
