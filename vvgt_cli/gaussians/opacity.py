"""From optical mass to a splat's peak alpha.

A splat blends ``alpha = o g`` with g a Gaussian of projected covariance S, and so takes away the optical depth
``-ln(1 - o g)``, whose integral over the image is ``Li2(o) 2 pi sqrt(det S)``. It must equal the optical mass M that
the Gaussian stands for. Viewers cut alpha below 1/255, which loses ``2 pi sqrt(det S) / 255``: it is added back.
"""

from __future__ import annotations

import functools

import numpy as np

from vvgt_cli.gaussians.constants import DILATION, MAX_ALPHA, MIN_ALPHA


@functools.cache
def _table() -> tuple[np.ndarray, np.ndarray]:
    """o on [0, 0.99] and Li2(o) = sum o^k / k^2 there (700 terms: the rest is below 1e-7)."""
    o = np.linspace(0, MAX_ALPHA, 2001)
    k = np.arange(1, 701, dtype=np.float64)
    powers = np.multiply.accumulate(np.broadcast_to(o[:, None], (len(o), len(k))), axis=1)
    return o, powers @ (1 / k**2)


def dilogarithm(o: np.ndarray) -> np.ndarray:
    """Li2(o) for o in [0, 0.99], any shape."""
    result: np.ndarray = np.interp(o, *_table())
    return result


def inverse_dilogarithm(y: np.ndarray) -> np.ndarray:
    """o in [0, 0.99] with Li2(o) = y; 0.99 where y is larger than Li2(0.99) = 1.59."""
    o, li2 = _table()
    result: np.ndarray = np.interp(y, li2, o)
    return result


def peak_opacity(mass: np.ndarray, variances: np.ndarray, pixel: float) -> np.ndarray:
    """Peak alpha (n,) in [0, 0.99] of Gaussians with optical mass (n,) and principal variances (n, 3).

    3DGS has one opacity for all views: the mean over the views along the three principal axes, weighted by the
    projected areas. ``pixel`` is a pixel's width at the Gaussian (unit-frame lengths): the renderer's dilation counts.
    """
    areas = projected_areas(variances, pixel)
    return mean_opacity(mass[:, None] / areas + MIN_ALPHA, areas)


def opacity_when_reshaped(opacity: np.ndarray, before: np.ndarray, after: np.ndarray, pixel: float) -> np.ndarray:
    """Peak alpha (n,) that keeps the optical mass of Gaussians of ``opacity`` (n,) when their shape changes.

    Principal variances ``before`` and ``after`` (n, 3), axis by axis; ``pixel`` as in `peak_opacity`.
    """
    areas = projected_areas(after, pixel)
    depths = np.maximum(dilogarithm(opacity) - MIN_ALPHA, 0)[:, None] * (projected_areas(before, pixel) / areas)
    return mean_opacity(depths + MIN_ALPHA, areas)


def projected_areas(variances: np.ndarray, pixel: float) -> np.ndarray:
    """(n, 3) ``2 pi sqrt(det S)`` as seen along each principal axis."""
    wide = variances + DILATION * pixel**2  # (n, 3)
    result: np.ndarray = (
        2 * np.pi * np.sqrt(np.stack([wide[:, 1] * wide[:, 2], wide[:, 0] * wide[:, 2], wide[:, 0] * wide[:, 1]], 1))
    )
    return result


def mean_opacity(li2: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """(n,) mean over the axes, weighted by ``areas`` (n, 3), of the alpha whose dilogarithm is ``li2`` (n, 3)."""
    opacity = inverse_dilogarithm(li2)
    result: np.ndarray = np.minimum((opacity * areas).sum(axis=1) / areas.sum(axis=1), MAX_ALPHA)
    return result
