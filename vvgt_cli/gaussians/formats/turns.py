"""The 24 equivalent quaternions of an ellipsoid: quarter turns about its axes, with permuted scales."""

from __future__ import annotations

import numpy as np


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the Hamilton product of quaternions (..., 4), (w, x, y, z)."""
    (aw, ax, ay, az), (bw, bx, by, bz) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def _quarters() -> tuple[np.ndarray, np.ndarray]:
    """Return the quaternions (24, 4) and the permutations of the scales that go with them (24, 3)."""
    half = np.sqrt(0.5)
    about, axes = [np.array([half, half, 0, 0]), np.array([half, 0, half, 0])], [[0, 2, 1], [2, 1, 0]]
    found, orders = [np.array([1.0, 0, 0, 0])], [[0, 1, 2]]
    for k in range(24):
        for quarter, swapped in zip(about, axes, strict=True):
            turned = _product(found[k], quarter)
            if all(abs(turned @ other) < 0.999 for other in found):
                found.append(turned)
                orders.append([orders[k][axis] for axis in swapped])
    return np.array(found), np.array(orders)


QUARTERS, ORDERS = _quarters()
_AT_ONCE = 1 << 16  # Gaussians


def nearest_turn(quaternions: np.ndarray, log_scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the same ellipsoids with the smallest rotations (largest w), whose numbers are more alike.

    Args:
        quaternions: (K, 4), (w, x, y, z), of norm 1.
        log_scales: (K, 3).

    Returns:
        quaternions, float64; log-scales in the type of ``log_scales``.
    """
    turned, scaled = np.empty((len(quaternions), 4)), np.empty_like(log_scales)
    for start in range(0, len(quaternions), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        candidates = _product(quaternions[part, None].astype(np.float64), QUARTERS)  # (k, 24, 4)
        best = np.abs(candidates[..., 0]).argmax(axis=1)
        turned[part] = candidates[np.arange(len(best)), best]
        scaled[part] = np.take_along_axis(log_scales[part], ORDERS[best], axis=1)
    return turned, scaled
