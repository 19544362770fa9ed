"""Separable image filters, as products with short banded matrices (fast without SciPy)."""

from __future__ import annotations

import numpy as np

BLOCK = 64  # outputs per product; the share of useful work is largest near the kernel's size


def correlate(image: np.ndarray, kernel: np.ndarray, axis: int) -> np.ndarray:
    """Correlate an image (h, w) with ``kernel`` (k,) along an axis, which shrinks by k - 1 to the valid part."""
    if axis == 1:
        return correlate(image.T, kernel, 0).T
    count = image.shape[0] - kernel.size + 1
    outputs = min(BLOCK, count)
    band = np.zeros((outputs, outputs + kernel.size - 1), image.dtype)  # row i holds the kernel from column i
    for i in range(outputs):
        band[i, i : i + kernel.size] = kernel
    out = np.empty((count, image.shape[1]), image.dtype)
    for start in range(0, count, BLOCK):
        size = min(BLOCK, count - start)
        reach = size + kernel.size - 1
        np.matmul(band[:size, :reach], image[start : start + reach], out=out[start : start + size])
    return out


def separable(image: np.ndarray, along_x: np.ndarray, along_y: np.ndarray) -> np.ndarray:
    """Correlate an image (h, w) with the outer product of two kernels, valid part only."""
    return correlate(correlate(image, along_x, 1), along_y, 0)
