"""The loss's term for texture: errors that change from pixel to pixel weigh more where the view is smooth.

Cells of the pyramid stand on a lattice, and on a smooth face the eye sees its weave long before squared errors do.
With e the error less its blur, and v the view's variance under the same window, the term is ``sum e^2 C / (C + v)``:
all of it where the view is smooth, next to nothing of it at edges. It is linear in the error, so that its gradient is
the same blur again. SSIM does so too, and to the mean brightness, which costs edges (docs/log/closed-form.md).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations
from vvgt_cli.refine.ssim import KERNEL, blur

f32: Any = np.float32
SMOOTH = 4e-3  # C, variance of a channel: edges of an eighth of the range and more hardly count


def add_texture_gradient(image: np.ndarray, target: np.ndarray, weight: float, grad: np.ndarray) -> float:
    """Add the gradient of ``weight`` x the term over pixels and RGB to ``grad``; return the term's unweighted sum.

    Args:
        image: (h, w, 4) float32 premultiplied, as drawn.
        target: (h, w, 4) float32 premultiplied.
        weight: of the term in the loss.
        grad: (h, w, 4) float32; alpha is left alone.
    """
    h, w = image.shape[:2]
    planes, blurred = np.empty((7, h, w), np.float32), np.empty((7, h, w), np.float32)
    part_planes(image, target, planes)
    blur(planes, KERNEL, blurred)
    sums = np.empty(h)
    weigh(blurred, planes, sums)
    blur(planes[:3], KERNEL, blurred[:3])
    add_fine(planes, blurred, weight, grad)
    return float(sums.sum())


@parallel_kernel("f4:3 f4:3 f4:3")
def part_planes(thread: ThreadSlice, image: np.ndarray, target: np.ndarray, planes: np.ndarray) -> None:
    """Write each channel's error, the view's channels and the sum of their squares into ``planes`` (7, h, w)."""
    for y in iterations(thread, image.shape[0]):
        for x in range(image.shape[1]):
            square = f32(0)
            for c in range(3):
                seen = target[y, x, c]
                planes[c, y, x] = image[y, x, c] - seen
                planes[3 + c, y, x] = seen
                square += seen * seen
            planes[6, y, x] = square


@inlined(error_model="numpy")
def smooth_share(red: float, green: float, blue: float, squares: float) -> float:
    """Return C / (C + v), from the means of a view's channels under the window, and of the sum of their squares."""
    variance = max(squares - (red * red + green * green + blue * blue), f32(0)) * f32(1 / 3)  # mean of the channels
    share: float = f32(SMOOTH) / (f32(SMOOTH) + variance)
    return share


@parallel_kernel("f4:3 f4:3 f8:1", error_model="numpy")
def weigh(thread: ThreadSlice, blurred: np.ndarray, planes: np.ndarray, sums: np.ndarray) -> None:
    """Replace the first three ``planes`` (7, h, w) by the errors less their blur, times C / (C + v).

    ``blurred`` (7, h, w) is the blur of what `part_planes` gave; ``sums`` (h,) gets the term's sum of each row.
    """
    for y in iterations(thread, planes.shape[1]):
        total = 0.0
        for x in range(planes.shape[2]):
            share = smooth_share(blurred[3, y, x], blurred[4, y, x], blurred[5, y, x], blurred[6, y, x])
            for c in range(3):
                error = planes[c, y, x] - blurred[c, y, x]
                planes[c, y, x] = share * error
                total += np.float64(share * error * error)
        sums[y] = total


@parallel_kernel("f4:3 f4:3 f8 f4:3")
def add_fine(thread: ThreadSlice, planes: np.ndarray, blurred: np.ndarray, weight: float, grad: np.ndarray) -> None:
    """Add 2 ``weight`` x the first three ``planes`` less their blur ``blurred`` to ``grad`` (h, w, 4)."""
    factor = f32(2 * weight)
    for y in iterations(thread, grad.shape[0]):
        for x in range(grad.shape[1]):
            for c in range(3):
                grad[y, x, c] += factor * (planes[c, y, x] - blurred[c, y, x])
