"""Linear transforms of Gaussians between frames, similarities and others: means, scales, rotations and harmonics.

Order, constants and signs of the harmonics are those of Kerbl et al. (2023), `computeColorFromSH`: real, degree 1, 2
and 3, m from -l to l, with the Condon-Shortley phase. Directions point from the eye to the Gaussian's centre.
Everything is float64; the kernels are in `vvgt_cli.splat.harmonics`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from vvgt_cli.cameras.types import quaternions as quaternions_of
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.live_facts import AXIS, GRADIENT
from vvgt_cli.gaussians.types import HARMONICS, Gaussians

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
    return right @ table.T


def turn(gaussians: Gaussians, up: str, *, inverse: bool = False) -> Gaussians:
    """Apply the rotation of `up_matrix`, or undo it with ``inverse``; "none" returns the same object."""
    matrix = up_matrix(up)
    w, x, y, z = _UP[up][1]
    if np.array_equal(matrix, _IDENTITY):
        return gaussians
    if inverse:
        matrix, (x, y, z) = matrix.T, (-x, -y, -z)
    quaternions = _quaternion_product((w, x, y, z), gaussians.quaternions.astype(np.float64))
    return _mapped(gaussians, matrix, quaternions, gaussians.log_scales)


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
    return _mapped(gaussians, matrix, quaternions, log_scales)


def _mapped(gaussians: Gaussians, matrix: np.ndarray, quaternions: np.ndarray, log_scales: np.ndarray) -> Gaussians:
    """Return Gaussians after a linear map, which gives them these quaternions and log scales."""
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


def axes_of(gaussians: Gaussians) -> np.ndarray:
    """Return the M of covariances ``M M^T``: axes as columns, each a standard deviation long, (K, 3, 3) float64."""
    return rotations(gaussians.quaternions) * np.exp(gaussians.log_scales.astype(np.float64))[:, None, :]


C1 = 0.4886025119029199
C2 = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
C3 = 0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277
_LARGEST = float(np.finfo(np.float32).max)
_DIRECTIONS = 64  # number of evenly spread directions to solve rotations on, more than coefficients


def terms(x: Any, y: Any, z: Any) -> tuple[Any, ...]:
    """Return the 15 harmonics of degree 1 to 3 at a unit direction, given as scalars or arrays."""
    xx, yy, zz = x * x, y * y, z * z
    return (
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2[0] * x * y,
        -C2[0] * y * z,
        C2[1] * (2 * zz - xx - yy),
        -C2[0] * x * z,
        C2[2] * (xx - yy),
        -C3[0] * y * (3 * xx - yy),
        C3[1] * x * y * z,
        -C3[2] * y * (4 * zz - xx - yy),
        C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
        -C3[2] * x * (4 * zz - xx - yy),
        C3[4] * z * (xx - yy),
        -C3[0] * x * (xx - 3 * yy),
    )


def term_slopes(x: Any, y: Any, z: Any) -> tuple[tuple[Any, Any, Any], ...]:
    """Return the derivatives of the polynomials of `terms` by x, y and z; those that vanish are the number 0."""
    xx, yy, zz = x * x, y * y, z * z
    a, b, c = C2
    p, q, r, s, t = C3
    return (
        (0.0, -C1, 0.0),
        (0.0, 0.0, C1),
        (-C1, 0.0, 0.0),
        (a * y, a * x, 0.0),
        (0.0, -a * z, -a * y),
        (-2 * b * x, -2 * b * y, 4 * b * z),
        (-a * z, 0.0, -a * x),
        (2 * c * x, -2 * c * y, 0.0),
        (-6 * p * x * y, -3 * p * (xx - yy), 0.0),
        (q * y * z, q * x * z, q * x * y),
        (2 * r * x * y, -r * (4 * zz - xx - 3 * yy), -8 * r * y * z),
        (-6 * s * x * z, -6 * s * y * z, s * (6 * zz - 3 * xx - 3 * yy)),
        (-r * (4 * zz - 3 * xx - yy), 2 * r * x * y, -8 * r * x * z),
        (2 * t * x * z, -2 * t * y * z, t * (xx - yy)),
        (-3 * p * (xx - yy), 6 * p * x * y, 0.0),
    )


def directions(means: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions (K, 3) from ``eye`` (3,) to ``means`` (K, 3), 0 at the eye itself, and distances (K,)."""
    offset = np.asarray(means, np.float64) - eye
    distance = np.linalg.norm(offset, axis=1)
    return offset / np.where(distance > 0, distance, 1)[:, None], distance


def basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Return the harmonics (K, M) of degree 1 to ``degree`` at unit directions (K, 3)."""
    d = np.asarray(directions, np.float64)
    return np.stack(terms(*d.T), axis=-1)[:, : HARMONICS[degree]]


def view_colors(gaussians: Gaussians, eye: np.ndarray) -> np.ndarray:
    """Return the colours (K, 3) float64 as seen from ``eye`` (3,), before negative values are clamped to 0."""
    colors: np.ndarray = gaussians.colors.astype(np.float64)
    if gaussians.harmonics is not None:
        toward, _ = directions(gaussians.means, eye)
        colors += np.einsum("km,kmc->kc", basis(toward, gaussians.degree), gaussians.harmonics.astype(np.float64))
    return colors


def turned(gaussians: Gaussians, matrix: np.ndarray) -> np.ndarray | None:
    """Return the harmonics rotated by ``matrix``: along ``matrix @ d`` they have the values they had along d.

    Args:
        gaussians: the Gaussians.
        matrix: (3, 3) rotation or reflection; of other matrices, the nearest of these is used.
    """
    if gaussians.harmonics is None:
        return None
    left, _, right = np.linalg.svd(np.asarray(matrix, np.float64))
    mixed = np.einsum("nm,kmc->knc", mixing(left @ right, gaussians.degree), gaussians.harmonics.astype(np.float64))
    return np.clip(mixed, -_LARGEST, _LARGEST).astype(np.float32)


def mixing(matrix: np.ndarray, degree: int) -> np.ndarray:
    """Return the matrix (M, M) that applies an orthogonal ``matrix`` (3, 3) to coefficients; degrees do not mix.

    It is solved on directions all over the sphere, which is exact up to rounding: a rotated harmonic is a sum of
    harmonics of the same degree.
    """
    points, inverses = _solver()
    moved = points @ matrix  # rows R^T d
    whole, there = np.zeros((HARMONICS[degree],) * 2), basis(moved, degree)
    for n in range(1, degree + 1):
        band = slice(HARMONICS[n - 1], HARMONICS[n])
        whole[band, band] = inverses[n - 1] @ there[:, band]
    return whole


@cache
def _solver() -> tuple[np.ndarray, list[np.ndarray]]:
    """Return directions (n, 3) on a Fibonacci sphere, and the pseudo-inverse of each degree's harmonics there."""
    z = 1 - (2 * np.arange(_DIRECTIONS) + 1) / _DIRECTIONS
    azimuth = 2 * np.pi * np.arange(_DIRECTIONS) * (math.sqrt(5) - 1) / 2
    across = np.sqrt(1 - z * z)
    points = np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), z])
    whole = basis(points, 3)
    return points, [np.linalg.pinv(whole[:, HARMONICS[n - 1] : HARMONICS[n]]) for n in (1, 2, 3)]
