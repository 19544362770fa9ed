"""Quaternions (w, x, y, z) of rotations, by eigenvectors (Bar-Itzhack 2000): well conditioned for every angle."""

from __future__ import annotations

import numpy as np


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """Return unit quaternions (K, 4), of either sign, of matrices (K, 3, 3)."""
    r = np.moveaxis(rotations, 0, -1)
    table = np.zeros((4, 4, len(rotations)))
    table[0, 0] = r[0, 0] + r[1, 1] + r[2, 2]
    for a, (b, c) in enumerate(((1, 2), (2, 0), (0, 1))):
        table[a + 1, a + 1] = r[a, a] - r[b, b] - r[c, c]
        table[0, a + 1] = table[a + 1, 0] = r[c, b] - r[b, c]
        table[b + 1, c + 1] = table[c + 1, b + 1] = r[b, c] + r[c, b]
    return np.linalg.eigh(np.moveaxis(table, -1, 0))[1][:, :, -1]


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (4,) with w >= 0 of a matrix (3, 3)."""
    unsigned = quaternions(np.asarray(rotation, np.float64)[None])[0]
    result: np.ndarray = unsigned * np.copysign(1.0, unsigned[0])
    return result
