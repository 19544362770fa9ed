"""Structural similarity (Wang, Bovik, Sheikh, Simoncelli 2004)."""

from __future__ import annotations

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.images.metrics.filters import separable

RADIUS, SIGMA = 5, 1.5  # an 11 x 11 window
C1, C2 = 0.01**2, 0.03**2


def ssim(reference: np.ndarray, ours: np.ndarray) -> float:
    """Mean SSIM of RGB images in [0, 1]: 11 x 11 Gaussian window, sigma 1.5, data range 1.

    The mean is over channels and over the pixels whose window lies inside the image: what scikit-image's
    ``structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1)`` gives.

    Args:
        reference, ours: (h, w, c), h and w at least 11.

    Raises:
        DataError: shapes that differ, or an image smaller than the window.
    """
    reference, ours = np.asarray(reference), np.asarray(ours)
    if reference.shape != ours.shape or reference.ndim != 3:
        raise DataError(f"SSIM of images {reference.shape} and {ours.shape}; expected the same (h, w, c)")
    if min(reference.shape[:2]) < 2 * RADIUS + 1:
        raise DataError(f"SSIM of an image of {reference.shape[:2]} pixels; expected at least 11 x 11")
    channels = [_channel(reference[..., c], ours[..., c]) for c in range(reference.shape[2])]
    return float(np.mean(channels))


def _channel(a: np.ndarray, b: np.ndarray) -> float:
    x = np.arange(-RADIUS, RADIUS + 1)
    kernel = np.exp(-0.5 * (x / SIGMA) ** 2)
    kernel /= kernel.sum()
    # differences from mid-grey keep the cancellation in the variances small in float32
    a = np.ascontiguousarray(a, dtype=np.float32) - np.float32(0.5)
    b = np.ascontiguousarray(b, dtype=np.float32) - np.float32(0.5)
    blur = [separable(image, kernel, kernel) for image in (a, b, a * a, b * b, a * b)]
    mean_a, mean_b, aa, bb, ab = blur
    variances = (aa - mean_a * mean_a) + (bb - mean_b * mean_b)
    covariance = ab - mean_a * mean_b
    mean_a += np.float32(0.5)
    mean_b += np.float32(0.5)
    structure = (2 * covariance + np.float32(C2)) / (variances + np.float32(C2))
    luminance = (2 * mean_a * mean_b + np.float32(C1)) / (mean_a * mean_a + mean_b * mean_b + np.float32(C1))
    return float((structure * luminance).mean(dtype=np.float64))
