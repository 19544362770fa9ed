"""Numba kernels of the steps: Adam in each Gaussian's own frame, and Adam on the fields of `Gaussians`."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from vvgt_cli.jit.decorators import inlined, kernel

f32: Any = np.float32
ONE, HALF, FOUR, EPSILON = f32(1), f32(0.5), f32(4), f32(1e-15)
COUNT = 13  # own frame: d (3), E (6), opacity logit, colour (3)
_jit = inlined()


@_jit
def _adam(
    g: float, k: int, i: int, first: np.ndarray, second: np.ndarray, beta1: float, beta2: float, fix1: float,
    fix2: float,
) -> float:  # fmt: skip
    """One value's direction, about 1 in size; updates the running moments ``first`` and ``second`` (K, COUNT)."""
    m: float = beta1 * first[k, i] + (ONE - beta1) * g
    v: float = beta2 * second[k, i] + (ONE - beta2) * g * g
    first[k, i], second[k, i] = m, v
    direction: float = m * fix1 / (math.sqrt(v * fix2) + EPSILON)
    return direction


@_jit
def _clip(value: float, bound: float) -> float:
    """``value`` within +-``bound``."""
    return min(max(value, -bound), bound)


@_jit
def _gain(factors: np.ndarray, k: int, i: int, spread: float) -> float:
    """How much further axis i, column i of ``factors`` (K, 3, 3), may go than a long one.

    The dilation, of variance ``spread``, hides part of its step.
    """
    x, y, z = factors[k, 0, i], factors[k, 1, i], factors[k, 2, i]
    return math.sqrt(min(ONE + spread / max(x * x + y * y + z * z, f32(1e-30)), f32(9)))


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
    ``second`` (K, COUNT) and what is computed. ``rates`` (5 or more,): d, E on and off the diagonal, logit, colour.
    ``clips`` (3,): d, logit, E. ``spread`` is the dilation's variance at the scene, ``darkest`` the least that a colour
    becomes.
    """
    fix1, fix2 = f32(1 / (1 - beta1**step)), f32(1 / (1 - beta2**step))
    b1, b2, hidden, least = f32(beta1), f32(beta2), f32(spread), f32(darkest)
    r0, r1, r2, r3, r4 = f32(rates[0]), f32(rates[1]), f32(rates[2]), f32(rates[3]), f32(rates[4])
    c0, c1, c2 = f32(clips[0]), f32(clips[1]), f32(clips[2])
    for k in nb.prange(means.shape[0]):
        p0, p1, p2 = _gain(factors, k, 0, hidden), _gain(factors, k, 1, hidden), _gain(factors, k, 2, hidden)
        d0, d1, d2, e00, e11, e22, e01, e02, e12 = _directions(frame, k, first, second, b1, b2, fix1, fix2)
        d0, d1, d2 = _clip(d0 * r0 * p0, c0), _clip(d1 * r0 * p1, c0), _clip(d2 * r0 * p2, c0)
        e00 = _clip(e00 * r1 * min(p0 * p0, FOUR), c2)
        e11 = _clip(e11 * r1 * min(p1 * p1, FOUR), c2)
        e22 = _clip(e22 * r1 * min(p2 * p2, FOUR), c2)
        e01 = _clip(e01 * r2 * min(p0 * p1, FOUR), c2)
        e02 = _clip(e02 * r2 * min(p0 * p2, FOUR), c2)
        e12 = _clip(e12 * r2 * min(p1 * p2, FOUR), c2)
        for i in range(3):
            m0, m1, m2 = factors[k, i, 0], factors[k, i, 1], factors[k, i, 2]
            means[k, i] -= m0 * d0 + m1 * d1 + m2 * d2
            s0 = m0 * e00 + m1 * e01 + m2 * e02  # M E
            s1 = m0 * e01 + m1 * e11 + m2 * e12
            s2 = m0 * e02 + m1 * e12 + m2 * e22
            factors[k, i, 0] = m0 - s0 + HALF * (s0 * e00 + s1 * e01 + s2 * e02)
            factors[k, i, 1] = m1 - s1 + HALF * (s0 * e01 + s1 * e11 + s2 * e12)
            factors[k, i, 2] = m2 - s2 + HALF * (s0 * e02 + s1 * e12 + s2 * e22)
        turn = _adam(logit_grad[k], k, 9, first, second, b1, b2, fix1, fix2) * r3
        logits[k] -= _clip(turn, c1)
        for i in range(3):
            tint = _adam(color_grad[k, i], k, 10 + i, first, second, b1, b2, fix1, fix2) * r4
            colors[k, i] = max(colors[k, i] - tint, least)


@kernel("f4:1 f4:1 f8 f8 f8 i8 f4:1 f4:1", parallel=True)
def adam(
    values: np.ndarray, slopes: np.ndarray, rate: float, beta1: float, beta2: float, step: int, first: np.ndarray,
    second: np.ndarray,
) -> None:  # fmt: skip
    """Adam (Kingma and Ba 2015) on ``values`` (n,) in place; ``step`` counts from 1.

    ``slopes`` (n,) gradient, ``first``, ``second`` (n,) its running moments.
    """
    fix1, fix2 = f32(1 / (1 - beta1**step)), f32(1 / (1 - beta2**step))
    b1, b2, pace = f32(beta1), f32(beta2), f32(rate)
    for i in nb.prange(values.shape[0]):
        m = b1 * first[i] + (ONE - b1) * slopes[i]
        v = b2 * second[i] + (ONE - b2) * slopes[i] * slopes[i]
        first[i], second[i] = m, v
        values[i] -= pace * m * fix1 / (math.sqrt(v * fix2) + EPSILON)
