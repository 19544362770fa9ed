"""Conversion of optical mass to a splat's peak alpha.

A splat blends ``alpha = o g``, where g is a Gaussian of projected covariance S. Its optical depth ``-ln(1 - o g)``
integrates to ``Li2(o) 2 pi sqrt(det S)`` over the image, which must equal the optical mass M of the Gaussian. Viewers
discard alpha below 1/255, which loses ``2 pi sqrt(det S) / 255``; that is added back.
"""

from __future__ import annotations

import functools

import numpy as np

from vvgt_cli.gaussians.constants import DILATION, MAX_ALPHA, MIN_ALPHA


@functools.cache
def _table() -> tuple[np.ndarray, np.ndarray]:
    """Return o on [0, 0.99] and Li2(o) = sum o^k / k^2 (700 terms; the remainder is below 1e-7)."""
    o = np.linspace(0, MAX_ALPHA, 2001)
    k = np.arange(1, 701, dtype=np.float64)
    powers = np.multiply.accumulate(np.broadcast_to(o[:, None], (len(o), len(k))), axis=1)
    return o, powers @ (1 / k**2)


def dilogarithm(o: np.ndarray) -> np.ndarray:
    """Return Li2(o) for o in [0, 0.99], any shape."""
    return np.interp(o, *_table())


def inverse_dilogarithm(y: np.ndarray) -> np.ndarray:
    """Return o in [0, 0.99] with Li2(o) = y; 0.99 where y exceeds Li2(0.99) = 1.59."""
    o, li2 = _table()
    return np.interp(y, li2, o)


def peak_opacity(mass: np.ndarray, variances: np.ndarray, pixel: float) -> np.ndarray:
    """Return the peak alpha (n,) in [0, 0.99] for optical masses (n,) and principal variances (n, 3).

    3DGS has one opacity for all views: this is the mean over the views along the three principal axes, weighted by
    projected area. ``pixel`` is the width of a pixel at the Gaussian, unit-frame lengths, for the renderer's dilation.
    """
    areas = projected_areas(variances, pixel)
    return mean_opacity(mass[:, None] / areas + MIN_ALPHA, areas)


def opacity_when_reshaped(opacity: np.ndarray, before: np.ndarray, after: np.ndarray, pixel: float) -> np.ndarray:
    """Return the peak alpha (n,) that preserves the optical mass of Gaussians of ``opacity`` (n,) in another shape.

    Principal variances ``before`` and ``after`` (n, 3) are in the same order of axes; see `peak_opacity` for ``pixel``.
    """
    areas = projected_areas(after, pixel)
    depths = np.maximum(dilogarithm(opacity) - MIN_ALPHA, 0)[:, None] * (projected_areas(before, pixel) / areas)
    return mean_opacity(depths + MIN_ALPHA, areas)


def projected_areas(variances: np.ndarray, pixel: float) -> np.ndarray:
    """Return ``2 pi sqrt(det S)`` (n, 3) as seen along each principal axis."""
    wide = variances + DILATION * pixel**2  # (n, 3)
    return 2 * np.pi * np.sqrt(np.stack([wide[:, 1] * wide[:, 2], wide[:, 0] * wide[:, 2], wide[:, 0] * wide[:, 1]], 1))


def mean_opacity(li2: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Return the alpha (n,) with dilogarithm ``li2`` (n, 3), averaged over the axes with weights ``areas`` (n, 3)."""
    opacity = inverse_dilogarithm(li2)
    return np.minimum((opacity * areas).sum(axis=1) / areas.sum(axis=1), MAX_ALPHA)


def logits_of(opacities: np.ndarray, least: float = 1e-7) -> np.ndarray:
    """Return the finite logits (K,) float32 of opacities, clipped to ``least`` and 1 - ``least``."""
    some = np.clip(opacities.astype(np.float64), least, 1 - least)
    return (np.log(some) - np.log1p(-some)).astype(np.float32)
