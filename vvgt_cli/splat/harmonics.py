"""Numba kernels of colours that depend on the view. Twin: `vvgt_cli.gaussians.frames`.

Arrays of K Gaussians, float32: ``means`` (K, 3), ``colors`` (K, 3), ``harmonics`` (K, M, 3), M = 3, 8 or 15; ``eye``
(3,) float64. Sums are float64 and rounded once.
"""

from __future__ import annotations

import math

import numpy as np

from vvgt_cli.gaussians.frames import term_slopes, terms
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations

_LARGEST = float(np.finfo(np.float32).max)
_jit = inlined()
_terms, _term_slopes = _jit(terms), _jit(term_slopes)


@_jit
def _toward(means: np.ndarray, k: int, eye: np.ndarray) -> tuple[float, float, float, float]:
    """Return the unit direction from the eye to Gaussian k, and 1 / distance; zeros for one at the eye."""
    x, y, z = means[k, 0] - eye[0], means[k, 1] - eye[1], means[k, 2] - eye[2]
    square = x * x + y * y + z * z
    inverse = 1.0 / math.sqrt(square) if square > 0.0 else 0.0
    return x * inverse, y * inverse, z * inverse, inverse


@parallel_kernel("f4:2 f4:2 f4:3 f8:1 f4:2")
def view_colors(
    thread: ThreadSlice, means: np.ndarray, colors: np.ndarray, harmonics: np.ndarray, eye: np.ndarray, out: np.ndarray
) -> None:
    """Write colours (K, 3) float32 as seen from the eye into ``out``, limited to what float32 holds."""
    for k in iterations(thread, means.shape[0]):
        x, y, z, _ = _toward(means, k, eye)
        basis = _terms(x, y, z)
        for c in range(3):
            total = np.float64(colors[k, c])
            for m in range(harmonics.shape[1]):
                total += basis[m] * harmonics[k, m, c]
            out[k, c] = min(max(total, -_LARGEST), _LARGEST)


@parallel_kernel("f4:2 f4:3 f8:1 f4:2 f4:3 f4:2")
def view_slopes(
    thread: ThreadSlice,
    means: np.ndarray,
    harmonics: np.ndarray,
    eye: np.ndarray,
    slopes: np.ndarray,
    out_harmonics: np.ndarray,
    out_means: np.ndarray,
) -> None:
    """Write gradients by ``harmonics`` and, through the direction, by ``means``, float32 of their shapes.

    ``slopes`` (K, 3) float32 is the gradient with respect to the colours that are seen.
    """
    for k in iterations(thread, means.shape[0]):
        if slopes[k, 0] == 0.0 and slopes[k, 1] == 0.0 and slopes[k, 2] == 0.0:
            out_harmonics[k] = 0.0
            out_means[k] = 0.0
            continue
        x, y, z, inverse = _toward(means, k, eye)
        basis, bent = _terms(x, y, z), _term_slopes(x, y, z)
        g0 = g1 = g2 = 0.0
        for m in range(harmonics.shape[1]):
            by_term = 0.0
            for c in range(3):
                out_harmonics[k, m, c] = basis[m] * slopes[k, c]
                by_term += np.float64(harmonics[k, m, c]) * slopes[k, c]
            slope = bent[m]
            g0, g1, g2 = g0 + by_term * slope[0], g1 + by_term * slope[1], g2 + by_term * slope[2]
        along = g0 * x + g1 * y + g2 * z
        out_means[k, 0] = (g0 - along * x) * inverse
        out_means[k, 1] = (g1 - along * y) * inverse
        out_means[k, 2] = (g2 - along * z) * inverse


@parallel_kernel("f4:2 f8:1 f8:2 f8:3")
def deposit(thread: ThreadSlice, means: np.ndarray, eye: np.ndarray, values: np.ndarray, out: np.ndarray) -> None:
    """Apply `view_colors`' adjoint: ``out`` (K, 1 + M, 3) float64 += each term of a colour, 1 first, x ``values``.

    ``values`` (K, 3) float64.
    """
    for k in iterations(thread, means.shape[0]):
        if values[k, 0] == 0.0 and values[k, 1] == 0.0 and values[k, 2] == 0.0:
            continue
        x, y, z, _ = _toward(means, k, eye)
        basis = _terms(x, y, z)
        for c in range(3):
            out[k, 0, c] += values[k, c]
            for m in range(out.shape[1] - 1):
                out[k, 1 + m, c] += basis[m] * values[k, c]


@parallel_kernel("f4:2 f8:1 f8:1 f4:3")
def deposit_squares(
    thread: ThreadSlice, means: np.ndarray, eye: np.ndarray, weights: np.ndarray, out: np.ndarray
) -> None:
    """Add ``weights`` (K,) float64 times products of two colour terms to ``out`` (K, 1 + M, 1 + M) float32."""
    for k in iterations(thread, means.shape[0]):
        if weights[k] == 0.0:
            continue
        x, y, z, _ = _toward(means, k, eye)
        basis = _terms(x, y, z)
        for i in range(out.shape[1]):
            first = weights[k] if i == 0 else weights[k] * basis[i - 1]
            for j in range(out.shape[1]):
                out[k, i, j] += first if j == 0 else first * basis[j - 1]
