"""The loss: its gradient by the picture, of squares, of SSIM and of texture, and how far the picture is off.

SSIM. Its window is that of `metrics.ssim` (11 x 11 Gaussian, sigma 1.5) with zeros beyond the image's border, so that
every pixel has a window. With the blurs m, n of x, y and s = blur(x^2) - m^2, t, c alike, SSIM = L S,
L = (2 m n + C1) / (m^2 + n^2 + C1), S = (2 c + C2) / (s + t + C2), and the sum's gradient is
blur(A) + 2 x blur(B) + y blur(D), where A, B, D are the derivatives by blur(x), blur(x^2), blur(x y). Twin: tests.

Texture: errors that change from pixel to pixel weigh more where the view is smooth. Cells of the pyramid stand on a
lattice, and on a smooth face the eye sees its weave long before squared errors do. With e the error less its blur, and
v the view's variance under the same window, the term is ``sum e^2 C / (C + v)``: all of it where the view is smooth,
next to nothing of it at edges. It is linear in the error, so that its gradient is the same blur again. SSIM does so
too, and to the mean brightness, which costs edges (docs/log/closed-form.md).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.images.metrics import C1, C2, RADIUS, SIGMA
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, U, iterations

if TYPE_CHECKING:
    from vvgt_cli.refine.options import OptimizeOptions

f32: Any = np.float32
KERNEL = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
KERNEL = (KERNEL / KERNEL.sum()).astype(np.float32)
SMOOTH = 4e-3  # C, variance of a channel: edges of an eighth of the range and more hardly count


def picture_slope(
    image: np.ndarray, target: np.ndarray, options: OptimizeOptions, weight: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """Return the gradient of the loss by a picture (h, w, 4) float32, and the picture's RMS error.

    ``weight`` (h, w): factors of the picture's differences from ``target``; None: 1.
    """
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
    return f32(2) * l2 * r + (l1 if r > 0 else -l1 if r < 0 else f32(0))


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
    return f32(SMOOTH) / (f32(SMOOTH) + variance)


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
