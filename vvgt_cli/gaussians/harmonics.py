"""Real spherical harmonics in the convention of 3DGS: view-dependent colours.

Order, constants and signs are those of Kerbl et al. (2023), `computeColorFromSH`: the real harmonics of degree 1, 2 and
3, m from -l to l, with the Condon-Shortley phase. Directions point from the eye to the Gaussian's centre. Everything is
float64; the kernels are in `vvgt_cli.splat.harmonics`.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np

from vvgt_cli.gaussians.types import HARMONICS, Gaussians

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
    found: np.ndarray = np.stack(terms(*d.T), axis=-1)[:, : HARMONICS[degree]]
    return found


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
    found: np.ndarray = np.clip(mixed, -_LARGEST, _LARGEST).astype(np.float32)
    return found


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
