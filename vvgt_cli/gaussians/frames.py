"""Linear transforms of Gaussians between frames: similarities and others, of means, scales and rotations."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from vvgt_cli.cameras.quaternions import quaternions as quaternions_of
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.harmonics import turned
from vvgt_cli.gaussians.live_facts import AXIS, GRADIENT
from vvgt_cli.gaussians.types import Gaussians

_HALF = math.sqrt(0.5)
_IDENTITY = np.eye(3)
_RIGID = 1e-4  # deviation of A^T A from 1 up to which a map counts as a rotation or reflection

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
    """Return the rotation (3, 3) float64 that takes the volume axis ``up`` to the viewers' up, PLY -y.

    Raises:
        UsageError: ``up`` is not one of `UP_NAMES`.
    """
    if up not in _UP:
        raise UsageError(f"up axis {up!r}: expected one of {', '.join(UP_NAMES)}")
    return np.array(_UP[up][0], dtype=np.float64)


def upright_matrix(up: str) -> np.ndarray:
    """Return the rotation (3, 3) float64 that takes the volume axis ``up`` to +z, which is up in views."""
    return _IDENTITY if up == "none" else up_matrix("z").T @ up_matrix(up)


def _quaternion_product(left: tuple[float, ...], right: np.ndarray) -> np.ndarray:
    """Return the Hamilton product of one quaternion (w, x, y, z) with (K, 4), float64."""
    w, x, y, z = left
    table = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    result: np.ndarray = right @ table.T
    return result


def turn(gaussians: Gaussians, up: str, *, inverse: bool = False) -> Gaussians:
    """Apply the rotation of `up_matrix`, or undo it with ``inverse``; "none" returns the same object."""
    matrix = up_matrix(up)
    w, x, y, z = _UP[up][1]
    if np.array_equal(matrix, _IDENTITY):
        return gaussians
    if inverse:
        matrix, (x, y, z) = matrix.T, (-x, -y, -z)
    means = gaussians.means.astype(np.float64) @ matrix.T
    quaternions = _quaternion_product((w, x, y, z), gaussians.quaternions.astype(np.float64))
    return replace(
        gaussians,
        means=means.astype(np.float32),
        quaternions=quaternions.astype(np.float32),
        harmonics=turned(gaussians, matrix),
        live=_normals_turned(gaussians, matrix),
    )


def rescale(gaussians: Gaussians, factor: float, before: np.ndarray, after: np.ndarray) -> Gaussians:
    """Scale by ``factor`` > 0 and shift by (3,): means become ``factor * (mean + before) + after``, in float64."""
    means = (gaussians.means.astype(np.float64) + before) * factor + after
    log_scales = gaussians.log_scales.astype(np.float64) + math.log(factor)
    return replace(gaussians, means=means.astype(np.float32), log_scales=log_scales.astype(np.float32))


def transform(gaussians: Gaussians, matrix: np.ndarray) -> Gaussians:
    """Transform means to ``A m`` and covariances to ``A S A^T``; opacities and colours stay.

    The identity returns the same object. Harmonics are rotated, or reflected, by the orthogonal matrix nearest to A.

    Rotations and reflections change the quaternions and keep the scales (a covariance is invariant under -1, so a
    reflection acts like the rotation -A). For other maps, the principal axes are recomputed by singular values.

    Args:
        gaussians: the Gaussians.
        matrix: (3, 3) A, not singular.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    if np.array_equal(matrix, _IDENTITY):
        return gaussians
    quaternions = gaussians.quaternions.astype(np.float64)
    log_scales = gaussians.log_scales.astype(np.float64)
    if np.abs(matrix.T @ matrix - _IDENTITY).max() <= _RIGID:
        turn_by = quaternions_of(matrix[None] * np.sign(np.linalg.det(matrix)))[0]
        quaternions = _quaternion_product(tuple(turn_by.tolist()), quaternions)
    else:
        largest = log_scales.max(axis=1, keepdims=True)
        factors = matrix @ rotations(quaternions) * np.exp(log_scales - largest)[:, None, :]
        quaternions, log_scales = factored(factors)
        log_scales += largest
    return replace(
        gaussians,
        means=(gaussians.means.astype(np.float64) @ matrix.T).astype(np.float32),
        log_scales=log_scales.astype(np.float32),
        quaternions=quaternions.astype(np.float32),
        harmonics=turned(gaussians, matrix),
        live=_normals_turned(gaussians, matrix),
    )


def _normals_turned(gaussians: Gaussians, matrix: np.ndarray) -> np.ndarray | None:
    """Return `Gaussians.live` after a linear map: normals are mapped by its inverse transpose, their lengths stay."""
    if gaussians.live is None:
        return None
    live = gaussians.live.astype(np.float64)
    for columns in (AXIS, GRADIENT):
        before = np.linalg.norm(live[:, columns], axis=1, keepdims=True)
        after = live[:, columns] @ np.linalg.inv(matrix)
        live[:, columns] = after * before / np.maximum(np.linalg.norm(after, axis=1, keepdims=True), 1e-30)
    return live.astype(np.float32)


def factored(factors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions (K, 4) and log scales (K, 3) of covariances ``M M^T``, M (K, 3, 3)."""
    axes, sigma, _ = np.linalg.svd(factors)
    quaternions = quaternions_of(axes * np.sign(np.linalg.det(axes))[:, None, None])
    return quaternions, np.log(np.maximum(sigma, np.finfo(np.float64).tiny))


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (K, 3, 3) float64 of quaternions (K, 4) of any norm > 0, (w, x, y, z)."""
    quaternions = np.asarray(quaternions, np.float64)
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
