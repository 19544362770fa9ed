"""Numba kernels of the steps: Adam in each Gaussian's own frame, and Adam on the fields of `Gaussians`."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from vvgt_cli.jit.decorators import inlined, kernel

EPSILON = 1e-15
COUNT = 13  # own frame: d (3), E (6), opacity logit, colour (3)
_jit = inlined()


@_jit
def _adam(
    g: float, k: int, i: int, first: np.ndarray, second: np.ndarray, beta1: float, beta2: float, fix1: float,
    fix2: float,
) -> float:  # fmt: skip
    """One value's direction, about 1 in size; updates the running moments ``first`` and ``second`` (K, COUNT)."""
    m: float = beta1 * first[k, i] + (1 - beta1) * g
    v: float = beta2 * second[k, i] + (1 - beta2) * g * g
    first[k, i], second[k, i] = m, v
    return m * fix1 / (math.sqrt(v * fix2) + EPSILON)


@_jit
def _clip(value: float, bound: float) -> float:
    """``value`` within +-``bound``."""
    return min(max(value, -bound), bound)


@_jit
def _gain(factors: np.ndarray, k: int, i: int, spread: float) -> float:
    """How much further axis i, column i of ``factors`` (K, 3, 3), may go than a long one.

    The dilation, of variance ``spread``, hides part of its step.
    """
    size = factors[k, 0, i] ** 2 + factors[k, 1, i] ** 2 + factors[k, 2, i] ** 2
    return math.sqrt(min(1 + spread / max(size, 1e-30), 9.0))


@_jit
def _directions(
    frame: np.ndarray, k: int, first: np.ndarray, second: np.ndarray, beta1: float, beta2: float, fix1: float,
    fix2: float,
) -> tuple[float, ...]:  # fmt: skip
    """Adam's directions of d (3) and E (6), from row k of ``frame`` (K, 9)."""
    return (
        _adam(frame[k, 0], k, 0, first, second, beta1, beta2, fix1, fix2),
        _adam(frame[k, 1], k, 1, first, second, beta1, beta2, fix1, fix2),
        _adam(frame[k, 2], k, 2, first, second, beta1, beta2, fix1, fix2),
        _adam(frame[k, 3], k, 3, first, second, beta1, beta2, fix1, fix2),
        _adam(frame[k, 4], k, 4, first, second, beta1, beta2, fix1, fix2),
        _adam(frame[k, 5], k, 5, first, second, beta1, beta2, fix1, fix2),
        _adam(frame[k, 6], k, 6, first, second, beta1, beta2, fix1, fix2),
        _adam(frame[k, 7], k, 7, first, second, beta1, beta2, fix1, fix2),
        _adam(frame[k, 8], k, 8, first, second, beta1, beta2, fix1, fix2),
    )


@kernel(
    "f4:2 f4:1 f4:2 f8:1 f8:1 f8 f8 f8 i8 f4:2 f4:3 f4:1 f4:2 f8 f4:2 f4:2",
    parallel=True,
)
def own_frame(
    frame: np.ndarray, logit_grad: np.ndarray, color_grad: np.ndarray, rates: np.ndarray, clips: np.ndarray,
    spread: float, beta1: float, beta2: float, step: int, means: np.ndarray, factors: np.ndarray, logits: np.ndarray,
    colors: np.ndarray, darkest: float, first: np.ndarray, second: np.ndarray,
) -> None:  # fmt: skip
    """mu += M d, M <- M (I + E + E^2 / 2): d, E, logit and colour by Adam; ``step`` counts from 1.

    Gradients ``frame`` (K, 9), ``logit_grad`` (K,), ``color_grad`` (K, 3) and what they are of, ``means`` (K, 3),
    ``factors`` (K, 3, 3), ``logits`` (K,), ``colors`` (K, 3), are float32, as are Adam's moments ``first`` and
    ``second`` (K, COUNT). ``rates`` (5 or more,): d, E on and off the diagonal, logit, colour. ``clips`` (3,): d,
    logit, E. ``spread`` is the dilation's variance at the scene, ``darkest`` the least that a colour becomes.
    """
    fix1, fix2 = 1 / (1 - beta1**step), 1 / (1 - beta2**step)
    for k in nb.prange(means.shape[0]):
        p0, p1, p2 = _gain(factors, k, 0, spread), _gain(factors, k, 1, spread), _gain(factors, k, 2, spread)
        d0, d1, d2, a0, a1, a2, b0, b1, b2 = _directions(frame, k, first, second, beta1, beta2, fix1, fix2)
        d0, d1, d2 = (_clip(d0 * rates[0] * p0, clips[0]), _clip(d1 * rates[0] * p1, clips[0]),
                      _clip(d2 * rates[0] * p2, clips[0]))  # fmt: skip
        a0, a1, a2 = (_clip(a0 * rates[1] * min(p0 * p0, 4.0), clips[2]),
                      _clip(a1 * rates[1] * min(p1 * p1, 4.0), clips[2]),
                      _clip(a2 * rates[1] * min(p2 * p2, 4.0), clips[2]))  # fmt: skip
        b0, b1, b2 = (_clip(b0 * rates[2] * min(p0 * p1, 4.0), clips[2]),
                      _clip(b1 * rates[2] * min(p0 * p2, 4.0), clips[2]),
                      _clip(b2 * rates[2] * min(p1 * p2, 4.0), clips[2]))  # fmt: skip
        for i in range(3):
            m0, m1, m2 = factors[k, i, 0], factors[k, i, 1], factors[k, i, 2]
            means[k, i] -= m0 * d0 + m1 * d1 + m2 * d2
            e0, e1, e2 = m0 * a0 + m1 * b0 + m2 * b1, m0 * b0 + m1 * a1 + m2 * b2, m0 * b1 + m1 * b2 + m2 * a2  # M E
            factors[k, i, 0] = m0 - e0 + 0.5 * (e0 * a0 + e1 * b0 + e2 * b1)
            factors[k, i, 1] = m1 - e1 + 0.5 * (e0 * b0 + e1 * a1 + e2 * b2)
            factors[k, i, 2] = m2 - e2 + 0.5 * (e0 * b1 + e1 * b2 + e2 * a2)
        turn = _adam(logit_grad[k], k, 9, first, second, beta1, beta2, fix1, fix2) * rates[3]
        logits[k] -= _clip(turn, clips[1])
        for i in range(3):
            tint = _adam(color_grad[k, i], k, 10 + i, first, second, beta1, beta2, fix1, fix2) * rates[4]
            colors[k, i] = max(colors[k, i] - tint, darkest)


@kernel("f4:1 f4:1 f8 f8 f8 i8 f4:1 f4:1", parallel=True)
def adam(
    values: np.ndarray, slopes: np.ndarray, rate: float, beta1: float, beta2: float, step: int, first: np.ndarray,
    second: np.ndarray,
) -> None:  # fmt: skip
    """Adam (Kingma and Ba 2015) on ``values`` (n,) in place; ``step`` counts from 1.

    ``slopes`` (n,) gradient, ``first``, ``second`` (n,) its running moments.
    """
    fix1, fix2 = 1 / (1 - beta1**step), 1 / (1 - beta2**step)
    for i in nb.prange(values.shape[0]):
        m = beta1 * first[i] + (1 - beta1) * slopes[i]
        v = beta2 * second[i] + (1 - beta2) * slopes[i] * slopes[i]
        first[i], second[i] = m, v
        values[i] -= rate * m * fix1 / (math.sqrt(v * fix2) + EPSILON)
