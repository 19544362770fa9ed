"""Numba kernels of the steps: Adam along each Gaussian's own axes, and Adam on the fields of `Gaussians`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations
from vvgt_cli.splat.lanes import LANES, U

f32: Any = np.float32
ONE, HALF, FOUR, NINE, EPSILON = f32(1), f32(0.5), f32(4), f32(9), f32(1e-15)
COUNT = 13  # own frame: d (3), E (6), opacity logit, colour (3)
KNOWN = 10  # of them that Gaussians share: not E off the diagonal
FEATURES = 64  # that these are linear in
RUN = 16  # Gaussians of a sample that lie side by side in memory
_P1, _P2, _P3, _P4 = U(LANES), U(2 * LANES), U(3 * LANES), U(4 * LANES)  # of a buffer, from plane to plane
PLACE = U(COUNT * LANES)  # where the nine of M begin
_jit = inlined(error_model="numpy")  # a division that could raise is none of vectors


@_jit
def clip(value: float, bound: float) -> float:
    """Limit ``value`` to +-``bound``."""
    return min(max(value, -bound), bound)


@_jit
def adam_parts(g: float, m: float, v: float, betas: tuple[float, ...]) -> tuple[float, float, float, float]:
    """Return Adam's moments after a slope g, and its direction's numerator and divisor; ``betas`` as of `_turn`."""
    beta1, beta2, fix1, fix2 = betas
    m = beta1 * m + (ONE - beta1) * g
    v = beta2 * v + (ONE - beta2) * g * g
    return m, v, m * fix1, math.sqrt(v * fix2)


@_jit
def _turn(
    slopes: np.ndarray, begin: int, count: int, first: np.ndarray, second: np.ndarray, betas: tuple[float, ...],
    floors: np.ndarray, buf: np.ndarray,
) -> None:  # fmt: skip
    """Write Adam's directions, about 1 in size, of ``count`` Gaussians from ``begin`` on into planes 0 to 12.

    ``slopes`` and the running moments ``first`` and ``second``, which are updated, (COUNT, K); ``betas`` beta1, beta2
    and what undoes their start from zero; ``floors`` (COUNT,) are added to the divisors.
    """
    start, lanes = U(begin), U(count)
    for field in range(U(COUNT)):
        for i in range(lanes):
            k = start + i
            m, v, towards, size = adam_parts(slopes[field, k], first[field, k], second[field, k], betas)
            first[field, k], second[field, k] = m, v
            buf[field * _P1 + i] = towards / (size + floors[field])


@inlined(error_model="numpy", fastmath={"contract"})
def _share(features: np.ndarray, chunk: int, weights: np.ndarray, known: np.ndarray, buf: np.ndarray) -> None:
    """Add what ``weights`` (KNOWN, FEATURES) foretell of the ``features`` (blocks, FEATURES, LANES) of a block.

    ``known`` (FEATURES x LANES,) is room for them as float32. Eight at a time: the planes of ``buf`` are read and
    written an eighth as often.
    """
    for f in range(U(FEATURES)):
        for i in range(U(LANES)):
            known[f * _P1 + i] = f32(features[chunk, f, i])
    for row in range(KNOWN):
        plane = U(row if row < 6 else row + 3) * _P1
        for f in range(0, FEATURES, 8):
            at = U(f) * _P1
            w0, w1, w2, w3 = weights[row, f], weights[row, f + 1], weights[row, f + 2], weights[row, f + 3]
            w4, w5, w6, w7 = weights[row, f + 4], weights[row, f + 5], weights[row, f + 6], weights[row, f + 7]
            for i in range(U(LANES)):
                j = at + i
                first = buf[plane + i] + w0 * known[j] + w1 * known[j + _P1] + w2 * known[j + _P2] + w3 * known[j + _P3]
                j += _P4
                rest = w4 * known[j] + w5 * known[j + _P1] + w6 * known[j + _P2] + w7 * known[j + _P3]
                buf[plane + i] = first + rest


@_jit
def _gain(x: float, y: float, z: float, spread: float) -> float:
    """Return how much further an axis may go than a long one: a column of M.

    The dilation, of variance ``spread``, hides part of its step.
    """
    return math.sqrt(min(ONE + spread / max(x * x + y * y + z * z, f32(1e-30)), NINE))


@_jit
def _bend(row: tuple[float, ...], e: tuple[float, ...]) -> tuple[float, float, float]:
    """Return a row of ``M (I - E + E^2 / 2)``; ``e``: 00, 11, 22, 01, 02, 12."""
    m0, m1, m2 = row
    e00, e11, e22, e01, e02, e12 = e
    s0 = m0 * e00 + m1 * e01 + m2 * e02  # M E
    s1 = m0 * e01 + m1 * e11 + m2 * e12
    s2 = m0 * e02 + m1 * e12 + m2 * e22
    return (
        m0 - s0 + HALF * (s0 * e00 + s1 * e01 + s2 * e02),
        m1 - s1 + HALF * (s0 * e01 + s1 * e11 + s2 * e12),
        m2 - s2 + HALF * (s0 * e02 + s1 * e12 + s2 * e22),
    )


@_jit
def move_one(
    way: tuple[float, ...], m: tuple[float, ...], rates: tuple[float, ...], clips: tuple[float, ...], spread: float
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Return what is subtracted from a mean, and the rows of M after the step.

    ``way`` (9): directions of d and E, ``m`` (9) M row by row; ``rates`` and ``clips`` of d, E on and off the diagonal.
    """
    r0, r1, r2 = rates
    c0, c1 = clips
    p0, p1, p2 = _gain(m[0], m[3], m[6], spread), _gain(m[1], m[4], m[7], spread), _gain(m[2], m[5], m[8], spread)
    d0, d1, d2 = clip(way[0] * r0 * p0, c0), clip(way[1] * r0 * p1, c0), clip(way[2] * r0 * p2, c0)
    e = (
        clip(way[3] * r1 * min(p0 * p0, FOUR), c1), clip(way[4] * r1 * min(p1 * p1, FOUR), c1),
        clip(way[5] * r1 * min(p2 * p2, FOUR), c1), clip(way[6] * r2 * min(p0 * p1, FOUR), c1),
        clip(way[7] * r2 * min(p0 * p2, FOUR), c1), clip(way[8] * r2 * min(p1 * p2, FOUR), c1),
    )  # fmt: skip
    back = (
        m[0] * d0 + m[1] * d1 + m[2] * d2, m[3] * d0 + m[4] * d1 + m[5] * d2, m[6] * d0 + m[7] * d1 + m[8] * d2
    )  # fmt: skip
    return back, _bend(m[:3], e), _bend(m[3:6], e), _bend(m[6:], e)


@_jit
def _move(buf: np.ndarray, rates: tuple[float, ...], clips: tuple[float, ...], spread: float) -> None:
    """Write what is subtracted from means, and M after the step, into planes 0 to 2 and from `PLACE` on."""
    for i in range(U(LANES)):
        p = i + PLACE
        way = (
            buf[i], buf[i + _P1], buf[i + _P2], buf[i + _P3], buf[i + _P4], buf[i + U(5) * _P1], buf[i + U(6) * _P1],
            buf[i + U(7) * _P1], buf[i + U(8) * _P1],
        )  # fmt: skip
        m = (
            buf[p], buf[p + _P1], buf[p + _P2], buf[p + _P3], buf[p + _P4], buf[p + U(5) * _P1], buf[p + U(6) * _P1],
            buf[p + U(7) * _P1], buf[p + U(8) * _P1],
        )  # fmt: skip
        back, row0, row1, row2 = move_one(way, m, rates, clips, spread)
        buf[i], buf[i + _P1], buf[i + _P2] = back
        buf[p], buf[p + _P1], buf[p + _P2] = row0
        buf[p + _P3], buf[p + _P4], buf[p + U(5) * _P1] = row1
        buf[p + U(6) * _P1], buf[p + U(7) * _P1], buf[p + U(8) * _P1] = row2


@parallel_kernel("f4:2 f8:1 f8:1 f8 f8 f8 i8 f4:2 f4:3 f4:1 f4:2 f8 f4:2 f4:2 f4:1 i1:3 f4:2")
def own_axes(
    thread: ThreadSlice,
    slopes: np.ndarray, rates: np.ndarray, clips: np.ndarray, spread: float, beta1: float, beta2: float, step: int,
    means: np.ndarray, factors: np.ndarray, logits: np.ndarray, colors: np.ndarray, darkest: float, first: np.ndarray,
    second: np.ndarray, floors: np.ndarray, features: np.ndarray, weights: np.ndarray,
) -> None:  # fmt: skip
    """Step mu += M d, M <- M (I + E + E^2 / 2): d, E, logit and colour by Adam; ``step`` counts from 1.

    Gradients ``slopes`` (COUNT, K) of `own_axes_backward` and what they are of, ``means`` (K, 3), ``factors``
    (K, 3, 3), ``logits`` (K,), ``colors`` (K, 3), are float32, as are Adam's moments ``first`` and ``second``
    (COUNT, K) and what is computed, `LANES` Gaussians at a time. ``rates`` (5 or more,): d, E on and off the diagonal,
    logit, colour. ``clips`` (3,): d, logit, E. ``spread`` is the dilation's variance at the scene, ``darkest`` the
    least that a colour becomes. ``floors`` (COUNT,) are added to Adam's divisors, and to its directions those of
    ``weights`` (KNOWN, FEATURES) for the ``features`` (blocks or none, FEATURES, LANES) of each Gaussian.
    """
    betas = f32(beta1), f32(beta2), f32(1 / (1 - beta1**step)), f32(1 / (1 - beta2**step))
    paces, bounds = (f32(rates[0]), f32(rates[1]), f32(rates[2])), (f32(clips[0]), f32(clips[2]))
    by_logit, by_color, farthest = f32(rates[3]), f32(rates[4]), f32(clips[1])
    hidden, least, total = f32(spread), f32(darkest), means.shape[0]
    for chunk in iterations(thread, (total + LANES - 1) // LANES):
        begin = chunk * LANES
        count = min(LANES, total - begin)
        buf = np.ones((COUNT + 9) * LANES, np.float32)
        _turn(slopes, begin, count, first, second, betas, floors, buf)
        if chunk < features.shape[0]:
            _share(features, chunk, weights, np.empty(FEATURES * LANES, np.float32), buf)
        for i in range(count):
            for entry in range(9):
                buf[U(i) + PLACE + U(entry) * _P1] = factors[begin + i, entry // 3, entry % 3]
        _move(buf, paces, bounds, hidden)
        for i in range(count):
            k, at = begin + i, U(i)
            for axis in range(3):
                means[k, axis] -= buf[at + U(axis) * _P1]
                tint = buf[at + U(10 + axis) * _P1] * by_color
                colors[k, axis] = max(colors[k, axis] - tint, least)
            for entry in range(9):
                factors[k, entry // 3, entry % 3] = buf[at + PLACE + U(entry) * _P1]
            logits[k] -= clip(buf[at + U(9) * _P1] * by_logit, farthest)


@parallel_kernel("f4:2 f4:2 f4:2 f8 f8 i8 i8 f4:2 f4:2", error_model="numpy")
def adam_sizes(
    thread: ThreadSlice, slopes: np.ndarray, first: np.ndarray, second: np.ndarray, beta1: float, beta2: float,
    step: int, every: int, towards: np.ndarray, sizes: np.ndarray,
) -> None:  # fmt: skip
    """Write numerators ``towards`` and divisors ``sizes`` (COUNT, n) of Adam's directions after ``step`` steps.

    One in ``every`` runs of `RUN` Gaussians is read, in that order; ``slopes`` (COUNT, K) are new, ``first``,
    ``second`` (COUNT, K) the running moments without them.
    """
    betas = f32(beta1), f32(beta2), f32(1 / (1 - beta1**step)), f32(1 / (1 - beta2**step))
    for row in iterations(thread, COUNT):
        for begin in range(0, sizes.shape[1], RUN):
            for i in range(U(begin), U(min(begin + RUN, sizes.shape[1]))):
                k = i + U(begin * (every - 1))
                parts = adam_parts(slopes[row, k], first[row, k], second[row, k], betas)
                towards[row, i], sizes[row, i] = parts[2], parts[3]


@parallel_kernel("f4:2 f8:1 f8 f4:2 f4:1", error_model="numpy")
def adam_directions(
    thread: ThreadSlice, sizes: np.ndarray, most: np.ndarray, damping: float, towards: np.ndarray, floors: np.ndarray
) -> None:
    """Divide ``towards`` by ``sizes`` (COUNT, n) and ``floors``, in place; 0 where that is not finite.

    ``floors`` (COUNT,): ``damping`` times the mean of sizes, of which none counts for more than ``most`` (COUNT,).
    """
    for row in iterations(thread, COUNT):
        bound, total = f32(most[row]), 0.0
        for i in range(sizes.shape[1]):
            size = sizes[row, i]
            total += np.float64(size if size < bound else bound)
        floors[row] = damping * total / sizes.shape[1] + EPSILON
        for i in range(sizes.shape[1]):
            way = towards[row, i] / (sizes[row, i] + floors[row])
            towards[row, i] = way if abs(way) < f32(math.inf) else f32(0)


@parallel_kernel("f4:2 f4:2 f8 f4:2")
def regress(thread: ThreadSlice, solver: np.ndarray, directions: np.ndarray, gain: float, weights: np.ndarray) -> None:
    """Write ``weights`` (KNOWN, FEATURES): ``gain`` x ``directions`` (COUNT, n) by ``solver`` (FEATURES, n), float32.

    Only shared directions, all finite. Sums have one order for any number of threads, unlike BLAS'.
    """
    whole = directions.shape[1] // LANES * LANES
    for f in iterations(thread, FEATURES):
        sums = np.empty(LANES, np.float32)
        for row in range(KNOWN):
            field = row if row < 6 else row + 3
            for i in range(U(LANES)):
                sums[i] = f32(0)
            for begin in range(0, whole, LANES):
                for i in range(U(LANES)):
                    sums[i] += solver[f, U(begin) + i] * directions[field, U(begin) + i]
            total = f32(0)
            for k in range(whole, directions.shape[1]):
                total += solver[f, k] * directions[field, k]
            for i in range(U(LANES)):
                total += sums[i]
            weights[row, f] = f32(gain) * total


@parallel_kernel("f4:1 f4:1 f8 f8 f8 i8 f4:1 f4:1", error_model="numpy")
def adam(
    thread: ThreadSlice,
    values: np.ndarray, slopes: np.ndarray, rate: float, beta1: float, beta2: float, step: int, first: np.ndarray,
    second: np.ndarray,
) -> None:  # fmt: skip
    """Apply Adam (Kingma and Ba 2015) to ``values`` (n,) in place; ``step`` counts from 1.

    ``slopes`` (n,) gradient, ``first``, ``second`` (n,) its running moments.
    """
    fix1, fix2 = f32(1 / (1 - beta1**step)), f32(1 / (1 - beta2**step))
    b1, b2, pace = f32(beta1), f32(beta2), f32(rate)
    for i in iterations(thread, values.shape[0]):
        m = b1 * first[i] + (ONE - b1) * slopes[i]
        v = b2 * second[i] + (ONE - b2) * slopes[i] * slopes[i]
        first[i], second[i] = m, v
        values[i] -= pace * m * fix1 / (math.sqrt(v * fix2) + EPSILON)
