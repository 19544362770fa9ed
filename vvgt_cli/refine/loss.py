"""Numba kernel of the loss: its gradient with respect to the picture, and how far the picture is off."""

from __future__ import annotations

import numpy as np

from vvgt_cli.jit.decorators import parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations


@parallel_kernel("f4:3 f4:3 f4 f4 f4 f4:3 f8:1")
def loss_gradient(
    thread: ThreadSlice,
    image: np.ndarray,
    target: np.ndarray,
    l1: np.float32,
    l2: np.float32,
    alpha_weight: np.float32,
    grad: np.ndarray,
    squares: np.ndarray,
) -> None:
    """Fill ``grad`` (h, w, 4) with the gradient of ``sum l1 |r| + l2 r^2`` over RGB, alpha's share weighted.

    ``image``, ``target`` (h, w, 4) float32; ``squares`` (h,) gets each row's sum of r^2, alpha's weighted too.
    """
    height, width = image.shape[:2]
    for y in iterations(thread, height):
        total = 0.0
        for x in range(width):
            for f in range(4):
                r = image[y, x, f] - target[y, x, f]
                weight = alpha_weight if f == 3 else np.float32(1)
                slope = np.float32(2) * l2 * r + (l1 if r > 0 else -l1 if r < 0 else np.float32(0))
                grad[y, x, f] = weight * slope
                total += np.float64(weight * r * r)
        squares[y] = total
