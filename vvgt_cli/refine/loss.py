"""The loss: its gradient with respect to the picture, and how far the picture is off; the kernel of its squares."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations

if TYPE_CHECKING:
    from vvgt_cli.refine.options import OptimizeOptions

f32: Any = np.float32


def picture_slope(
    image: np.ndarray, target: np.ndarray, options: OptimizeOptions, weight: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """Return the gradient of the loss by a picture (h, w, 4) float32, and the picture's RMS error.

    ``weight`` (h, w): factors of the picture's differences from ``target``; None: 1.
    """
    from vvgt_cli.refine.ssim import add_ssim_gradient
    from vvgt_cli.refine.texture import add_texture_gradient

    height, width = image.shape[:2]
    seen = image if weight is None else target + weight[..., None] * (image - target)
    grad, squares = np.empty_like(image), np.empty(height)
    loss_gradient(
        seen, target, np.float32(options.l1), np.float32(options.l2), np.float32(options.alpha), grad, squares
    )
    if options.ssim > 0:
        add_ssim_gradient(seen, target, options.ssim, grad)
    if options.texture > 0:
        add_texture_gradient(seen, target, options.texture, grad)
    if weight is not None:
        grad *= weight[..., None]
    return grad, math.sqrt(squares.sum() / ((3 + options.alpha) * height * width))


@inlined()
def error_slope(r: float, l1: float, l2: float) -> float:
    """Return the derivative of ``l1 |r| + l2 r^2``."""
    slope: float = f32(2) * l2 * r + (l1 if r > 0 else -l1 if r < 0 else f32(0))
    return slope


@parallel_kernel("f4:3 f4:3 f4 f4 f4 f4:3 f8:1")
def loss_gradient(
    thread: ThreadSlice,
    image: np.ndarray,
    target: np.ndarray,
    l1: Any,
    l2: Any,
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
                grad[y, x, f] = weight * error_slope(r, l1, l2)
                total += np.float64(weight * r * r)
        squares[y] = total
