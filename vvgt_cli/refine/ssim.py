"""Numba kernels of the SSIM term: its mean and its gradient with respect to the picture. Twin: tests.

The window is that of `metrics.ssim` (11 x 11 Gaussian, sigma 1.5) with zeros beyond the image's border, so that every
pixel has a window. With the blurs m, n of x, y and s = blur(x^2) - m^2, t, c alike, SSIM = L S,
L = (2 m n + C1) / (m^2 + n^2 + C1), S = (2 c + C2) / (s + t + C2), and the sum's gradient is
blur(A) + 2 x blur(B) + y blur(D), where A, B, D are the derivatives by blur(x), blur(x^2), blur(x y).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vvgt_cli.images.metrics import C1, C2, RADIUS, SIGMA
from vvgt_cli.jit.decorators import parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, U, iterations

KERNEL = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
KERNEL = (KERNEL / KERNEL.sum()).astype(np.float32)
f32: Any = np.float32


@parallel_kernel("f4:3 f4:1 f4:3", fastmath=True, error_model="numpy")
def blur(thread: ThreadSlice, planes: np.ndarray, kernel: np.ndarray, out: np.ndarray) -> None:
    """Correlate ``planes`` (n, h, w) with the outer square of ``kernel`` (2 r + 1,), zeros beyond the border."""
    n, h, w = planes.shape
    r = kernel.shape[0] // 2
    for job in iterations(thread, n * h):
        p, y = job // h, job % h
        line = np.zeros(w + 2 * r, np.float32)
        for i in range(max(r - y, 0), min(2 * r + 1, h + r - y)):
            weight = kernel[i]
            row = planes[p, y + i - r]
            for x in range(w):
                line[U(r + x)] += weight * row[x]
        for x in range(w):
            out[p, y, x] = f32(0)
        for i in range(2 * r + 1):
            weight = kernel[i]
            for x in range(w):
                out[p, y, x] += weight * line[U(x + i)]


@parallel_kernel(fastmath=True, error_model="numpy")
def products(thread: ThreadSlice, x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    """Write x, y, x^2, y^2 and x y of one channel (h, w) into ``out`` (5, h, w)."""
    for row in iterations(thread, x.shape[0]):
        for col in range(x.shape[1]):
            a, b = x[row, col], y[row, col]
            out[0, row, col], out[1, row, col] = a, b
            out[2, row, col], out[3, row, col], out[4, row, col] = a * a, b * b, a * b


@parallel_kernel(fastmath=True, error_model="numpy")
def slopes(thread: ThreadSlice, blurred: np.ndarray, out: np.ndarray, score: np.ndarray) -> None:
    """Write SSIM's derivatives by blur(x), blur(x^2), blur(x y) into ``out`` (3, h, w), its row sums into ``score``.

    ``blurred`` (5, h, w): the blurs of `products`.
    """
    c1, c2 = f32(C1), f32(C2)
    for row in iterations(thread, blurred.shape[1]):
        total = f32(0)
        for col in range(blurred.shape[2]):
            m, n = blurred[0, row, col], blurred[1, row, col]
            s, t = blurred[2, row, col] - m * m, blurred[3, row, col] - n * n
            c = blurred[4, row, col] - m * n
            below_l, below_s = m * m + n * n + c1, s + t + c2
            light, shape = (f32(2) * m * n + c1) / below_l, (f32(2) * c + c2) / below_s
            by_s, by_c = -light * shape / below_s, f32(2) * light / below_s
            by_m = shape * f32(2) * (n - m * light) / below_l
            out[0, row, col] = by_m - f32(2) * m * by_s - n * by_c
            out[1, row, col] = by_s
            out[2, row, col] = by_c
            total += light * shape
        score[row] = total


@parallel_kernel(fastmath=True, error_model="numpy")
def add_gradient(
    thread: ThreadSlice,
    blurred: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    scale: np.float32,
    channel: int,
    grad: np.ndarray,
) -> None:
    """Add ``scale`` times the gradient of the sum of SSIM to one channel of ``grad`` (h, w, 4).

    ``blurred`` (3, h, w): the blurs of `slopes`; ``x``, ``y`` (h, w) the channel of picture and target.
    """
    for row in iterations(thread, x.shape[0]):
        for col in range(x.shape[1]):
            slope = blurred[0, row, col] + f32(2) * x[row, col] * blurred[1, row, col]
            grad[row, col, channel] += scale * (slope + y[row, col] * blurred[2, row, col])


def add_ssim_gradient(image: np.ndarray, target: np.ndarray, weight: float, grad: np.ndarray) -> float:
    """Add the gradient of ``weight`` x the sum over pixels and RGB of (1 - SSIM) to ``grad``; return the mean SSIM.

    Args:
        image: (h, w, 4) float32 premultiplied, as drawn.
        target: (h, w, 4) float32.
        weight: of the term in the loss.
        grad: (h, w, 4) float32.
    """
    h, w = image.shape[:2]
    fields, blurred = np.empty((5, h, w), np.float32), np.empty((5, h, w), np.float32)
    score = np.empty(h, np.float32)
    total = 0.0
    for channel in range(3):
        x, y = image[..., channel], target[..., channel]
        products(x, y, fields)
        blur(fields, KERNEL, blurred)
        slopes(blurred, fields[:3], score)
        blur(fields[:3], KERNEL, blurred[:3])
        add_gradient(blurred[:3], x, y, np.float32(-weight), channel, grad)
        total += float(score.sum(dtype=np.float64))
    return float(total / (3 * h * w))
