"""Numba kernels of the steps: Adam in each Gaussian's own frame, and Adam on the fields of `Gaussians`."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from vvgt_cli.jit import inlined

EPSILON = 1e-15
COUNT = 13  # own frame: d (3), E (6), opacity logit, colour (3)
_jit = inlined()


@_jit
def _adam(g, k, i, first, second, beta1, beta2, fix1, fix2):
    """One value's direction, about 1 in size; updates the running moments."""
    m = beta1 * first[k, i] + (1 - beta1) * g
    v = beta2 * second[k, i] + (1 - beta2) * g * g
    first[k, i], second[k, i] = m, v
    return m * fix1 / (math.sqrt(v * fix2) + EPSILON)


@_jit
def _clip(value, bound):
    return min(max(value, -bound), bound)


@nb.njit(parallel=True, cache=True)
def own_frame(
    frame,
    logit_grad,
    color_grad,
    rates,
    clips,
    pixel,
    beta1,
    beta2,
    step,
    means,
    factors,
    logits,
    colors,
    first,
    second,
):
    """mu += M d, M <- M (I + E + E^2 / 2): d, E, logit and colour by Adam; ``step`` counts from 1.

    ``rates`` (5,): d, E on and off the diagonal, logit, colour. ``clips`` (3,): d, logit, E. ``pixel`` is a pixel's
    width at the scene: an axis of s pixels moves the picture by s^2 / (s^2 + 0.3) of what it would undilated.
    """
    fix1, fix2 = 1 / (1 - beta1**step), 1 / (1 - beta2**step)
    for k in nb.prange(means.shape[0]):
        gain = np.empty(3)
        d = np.empty(3)
        e = np.empty((3, 3))
        for i in range(3):
            size = factors[k, 0, i] ** 2 + factors[k, 1, i] ** 2 + factors[k, 2, i] ** 2
            gain[i] = math.sqrt(min(1 + 0.3 * pixel * pixel / max(size, 1e-30), 9.0))
        for i in range(3):
            d[i] = _adam(frame[k, i], k, i, first, second, beta1, beta2, fix1, fix2) * rates[0] * gain[i]
            d[i] = -_clip(d[i], clips[0])
            grown = _adam(frame[k, 3 + i], k, 3 + i, first, second, beta1, beta2, fix1, fix2) * rates[1]
            e[i, i] = -_clip(grown * min(gain[i] * gain[i], 4.0), clips[2])
        for i in range(2):
            for j in range(i + 1, 3):
                n = 5 + i + j
                sheared = _adam(frame[k, n], k, n, first, second, beta1, beta2, fix1, fix2) * rates[2]
                e[i, j] = -_clip(sheared * min(gain[i] * gain[j], 4.0), clips[2])
                e[j, i] = e[i, j]
        m = np.empty((3, 3))
        for i in range(3):
            for j in range(3):
                m[i, j] = factors[k, i, j]
        for i in range(3):
            means[k, i] += m[i, 0] * d[0] + m[i, 1] * d[1] + m[i, 2] * d[2]
            for j in range(3):
                change = 0.0
                for n in range(3):
                    half = e[n, j] + 0.5 * (e[n, 0] * e[0, j] + e[n, 1] * e[1, j] + e[n, 2] * e[2, j])
                    change += m[i, n] * half
                factors[k, i, j] = m[i, j] + change
        turn = _adam(logit_grad[k], k, 9, first, second, beta1, beta2, fix1, fix2) * rates[3]
        logits[k] -= _clip(turn, clips[1])
        for i in range(3):
            tint = _adam(color_grad[k, i], k, 10 + i, first, second, beta1, beta2, fix1, fix2) * rates[4]
            colors[k, i] = max(colors[k, i] - tint, 0.0)


@nb.njit(parallel=True, cache=True)
def adam(values, slopes, rate, beta1, beta2, step, first, second):
    """Adam (Kingma and Ba 2015) on (n,) ``values`` in place; ``step`` counts from 1."""
    fix1, fix2 = 1 / (1 - beta1**step), 1 / (1 - beta2**step)
    for i in nb.prange(values.shape[0]):
        m = beta1 * first[i] + (1 - beta1) * slopes[i]
        v = beta2 * second[i] + (1 - beta2) * slopes[i] * slopes[i]
        first[i], second[i] = m, v
        values[i] -= rate * m * fix1 / (math.sqrt(v * fix2) + EPSILON)
