"""Separable filters for images, as products with short banded matrices (fast without scipy)."""

from __future__ import annotations

import numpy as np

BLOCK = 64  # outputs a product; the band's share of the work is largest near the kernel's own size


def correlate(image: np.ndarray, kernel: np.ndarray, axis: int) -> np.ndarray:
    """Correlate (h, w) with ``kernel`` (k,) along ``axis`` 0 or 1, valid part only: that axis shrinks by k - 1."""
    if axis == 0:
        return _rows(image, kernel)
    return _columns(image, kernel)


def _band(kernel: np.ndarray, outputs: int, dtype: np.dtype) -> np.ndarray:
    """(outputs, outputs + k - 1): row i holds the kernel from column i."""
    band = np.zeros((outputs, outputs + kernel.size - 1), dtype=dtype)
    for i in range(outputs):
        band[i, i : i + kernel.size] = kernel
    return band


def _rows(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    count = image.shape[0] - kernel.size + 1
    out = np.empty((count, image.shape[1]), dtype=image.dtype)
    band = _band(kernel, min(BLOCK, count), image.dtype)
    for start in range(0, count, BLOCK):
        size = min(BLOCK, count - start)
        part = band[:size, : size + kernel.size - 1]
        np.matmul(part, image[start : start + size + kernel.size - 1], out=out[start : start + size])
    return out


def _columns(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    count = image.shape[1] - kernel.size + 1
    out = np.empty((image.shape[0], count), dtype=image.dtype)
    band = _band(kernel, min(BLOCK, count), image.dtype).T
    for start in range(0, count, BLOCK):
        size = min(BLOCK, count - start)
        part = band[: size + kernel.size - 1, :size]
        out[:, start : start + size] = image[:, start : start + size + kernel.size - 1] @ part
    return out


def separable(image: np.ndarray, along_x: np.ndarray, along_y: np.ndarray) -> np.ndarray:
    """Correlate (h, w) with the outer product of two kernels, valid part only."""
    return correlate(correlate(image, along_x, 1), along_y, 0)
