"""Peak signal-to-noise ratio."""

from __future__ import annotations

import math

import numpy as np

from vvgt_cli.errors import DataError

CAP = 150.0  # dB: a root-mean-square error of 3e-8, half a float32 step at 1; identical images have this value


def psnr(reference: np.ndarray, ours: np.ndarray, mask: np.ndarray | None = None) -> float:
    """``-10 log10(mean squared error)`` in dB of images in [0, 1] (clipped), at most 150.

    Args:
        reference, ours: of one shape, (h, w) or (h, w, c).
        mask: (h, w) bool, the pixels to count; default all.

    Raises:
        DataError: shapes that differ, no pixel to count, values that are not finite.
    """
    reference, ours = np.asarray(reference), np.asarray(ours)
    if reference.shape != ours.shape:
        raise DataError(f"PSNR of images {reference.shape} and {ours.shape}; expected the same shape")
    if mask is not None:
        reference, ours = reference[mask], ours[mask]
    if reference.size == 0:
        raise DataError("PSNR over no pixels; expected some")
    difference = np.clip(reference, 0, 1) - np.clip(ours, 0, 1)
    error = float(np.mean(np.square(difference, dtype=np.float64)))
    if not math.isfinite(error):
        raise DataError("PSNR of images that are not finite")
    return min(CAP, -10 * math.log10(error)) if error > 0 else CAP
