"""Moving Gaussians between frames: a similarity applied to means, scales and rotations."""

from __future__ import annotations

import math

import numpy as np

from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.types import Gaussians

_HALF = math.sqrt(0.5)
_IDENTITY = np.eye(3)

# SuperSplat and its relatives show PLY (x, y, z) as (-x, -y, z) with +y up on the screen, so "up" is PLY -y.
# Each matrix takes the named volume axis to (0, -1, 0); the quaternion (w, x, y, z) is the same rotation.
_UP: dict[str, tuple[list[list[float]], tuple[float, float, float, float]]] = {
    "none": ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], (1, 0, 0, 0)),
    "x": ([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], (_HALF, 0, 0, -_HALF)),
    "-x": ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (_HALF, 0, 0, _HALF)),
    "y": ([[1, 0, 0], [0, -1, 0], [0, 0, -1]], (0, 1, 0, 0)),
    "-y": ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], (1, 0, 0, 0)),
    "z": ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], (_HALF, _HALF, 0, 0)),
    "-z": ([[1, 0, 0], [0, 0, 1], [0, -1, 0]], (_HALF, -_HALF, 0, 0)),
}
UP_NAMES = tuple(_UP)


def up_matrix(up: str) -> np.ndarray:
    """(3, 3) float64 rotation that takes the volume axis ``up`` to the viewers' up, PLY -y.

    Raises:
        UsageError: ``up`` is not one of `UP_NAMES`.
    """
    if up not in _UP:
        raise UsageError(f"up axis {up!r}: expected one of {', '.join(UP_NAMES)}")
    return np.array(_UP[up][0], dtype=np.float64)


def _quaternion_product(left: tuple[float, ...], right: np.ndarray) -> np.ndarray:
    """Hamilton product of one quaternion (w, x, y, z) with (K, 4), float64."""
    w, x, y, z = left
    table = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return right @ table.T


def turn(gaussians: Gaussians, up: str, *, inverse: bool = False) -> Gaussians:
    """Bake in (or, with ``inverse``, take out) the rotation of `up_matrix`; "none" returns the same object."""
    matrix = up_matrix(up)
    w, x, y, z = _UP[up][1]
    if np.array_equal(matrix, _IDENTITY):
        return gaussians
    if inverse:
        matrix, (x, y, z) = matrix.T, (-x, -y, -z)
    means = gaussians.means.astype(np.float64) @ matrix.T
    quaternions = _quaternion_product((w, x, y, z), gaussians.quaternions.astype(np.float64))
    return Gaussians(
        means.astype(np.float32),
        gaussians.log_scales,
        quaternions.astype(np.float32),
        gaussians.opacity_logits,
        gaussians.colors,
    )


def rescale(gaussians: Gaussians, factor: float, before: np.ndarray, after: np.ndarray) -> Gaussians:
    """``factor * (mean + before) + after`` for the means, in float64; log-scales grow by ln ``factor``.

    Args:
        factor: > 0, new lengths per old length.
        before, after: (3,) shifts in old and new lengths.
    """
    means = (gaussians.means.astype(np.float64) + before) * factor + after
    log_scales = gaussians.log_scales.astype(np.float64) + math.log(factor)
    return Gaussians(
        means.astype(np.float32),
        log_scales.astype(np.float32),
        gaussians.quaternions,
        gaussians.opacity_logits,
        gaussians.colors,
    )
