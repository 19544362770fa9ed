"""`LANES` Gaussians at a time through the arithmetic of the projection and of its gradient, in vector instructions.

Gaussians lie in memory as the fields of each one after the other. A kernel that works on one after the other computes
one number at a time; so `LANES` of them are put into a buffer, a plane of `LANES` numbers a field, and the loops over a
plane have a fixed length, unsigned indices at constant distances and no branches, which LLVM turns into vectors (as in
`splat.buffer`). Exponentials and logarithms stay outside: these have no vectors here. Nothing is added in another order
than one by one would: the bytes are the same.

``buf`` (planes x LANES,) float64. ``pose`` 12 float64: the rotation world to camera, row by row, and the translation;
``lens`` and ``rule`` as of `splat.kernel`, as tuples.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from vvgt_cli.gaussians.constants import NEAR
from vvgt_cli.jit.decorators import inlined

LANES = 64
U: Any = nb.uint64
_P1, _P2, _P3, _P4, _P5, _P6 = U(LANES), U(2 * LANES), U(3 * LANES), U(4 * LANES), U(5 * LANES), U(6 * LANES)
_P7, _P8, _P9, _P10, _P11 = U(7 * LANES), U(8 * LANES), U(9 * LANES), U(10 * LANES), U(11 * LANES)
OPACITY = U(12 * LANES)
PROJECTED = 17  # planes that a projection uses
TOTALS, CONIC, SLOPED = 12, 21, 24  # first plane of the pairs' sums and of the conic; planes that a gradient uses
SINGULAR = 1e-9  # det S of det S' below which the gradient of the compensation is skipped
_lane_jit = inlined(error_model="numpy")  # no fastmath, no order of sums of its own


@_lane_jit
def pose_of(rot: np.ndarray, trans: np.ndarray) -> tuple[float, ...]:
    """Return ``rot`` (3, 3) and ``trans`` (3,) as 12 numbers."""
    return (
        rot[0, 0], rot[0, 1], rot[0, 2], rot[1, 0], rot[1, 1], rot[1, 2], rot[2, 0], rot[2, 1], rot[2, 2],
        trans[0], trans[1], trans[2],
    )  # fmt: skip


@_lane_jit
def place_of(k: int, means: np.ndarray, factors: np.ndarray) -> tuple[float, ...]:
    """Return Gaussian k's centre and M, row by row, of ``means`` (K, 3), ``factors`` (K, 3, 3): 12 numbers."""
    return (
        np.float64(means[k, 0]), np.float64(means[k, 1]), np.float64(means[k, 2]),
        np.float64(factors[k, 0, 0]), np.float64(factors[k, 0, 1]), np.float64(factors[k, 0, 2]),
        np.float64(factors[k, 1, 0]), np.float64(factors[k, 1, 1]), np.float64(factors[k, 1, 2]),
        np.float64(factors[k, 2, 0]), np.float64(factors[k, 2, 1]), np.float64(factors[k, 2, 2]),
    )  # fmt: skip


@_lane_jit
def load_place(buf: np.ndarray, j: int, k: int, means: np.ndarray, factors: np.ndarray) -> None:
    """Load `place_of` Gaussian k into lane j of planes 0 to 11."""
    place = place_of(k, means, factors)
    buf[j], buf[j + _P1], buf[j + _P2], buf[j + _P3], buf[j + _P4], buf[j + _P5] = place[:6]
    buf[j + _P6], buf[j + _P7], buf[j + _P8], buf[j + _P9], buf[j + _P10], buf[j + _P11] = place[6:]


@_lane_jit
def _lane_place(buf: np.ndarray, i: int) -> tuple[float, ...]:
    """Return the 12 numbers of `place_of` that lane i holds."""
    return (
        buf[i], buf[i + _P1], buf[i + _P2], buf[i + _P3], buf[i + _P4], buf[i + _P5],
        buf[i + _P6], buf[i + _P7], buf[i + _P8], buf[i + _P9], buf[i + _P10], buf[i + _P11],
    )  # fmt: skip


@_lane_jit
def put_column(buf: np.ndarray, j: int, axis: int, column: tuple[float, float, float], scale: float) -> None:
    """Put column ``axis`` of M, ``scale`` times a column of a rotation, into lane j."""
    at = U(j) + U(axis) * _P1
    buf[at + _P3], buf[at + _P6], buf[at + _P9] = column[0] * scale, column[1] * scale, column[2] * scale


@_lane_jit
def _centre(place: tuple[float, ...], pose: tuple[float, ...]) -> tuple[float, float, float]:
    """Return a Gaussian's centre in camera coordinates."""
    m0, m1, m2 = place[0], place[1], place[2]
    return (
        pose[0] * m0 + pose[1] * m1 + pose[2] * m2 + pose[9],
        pose[3] * m0 + pose[4] * m1 + pose[5] * m2 + pose[10],
        pose[6] * m0 + pose[7] * m1 + pose[8] * m2 + pose[11],
    )


@_lane_jit
def _axis(
    a: float, b: float, c: float, pose: tuple[float, ...], jx: float, jy: float, jxz: float, jyz: float
) -> tuple[float, float, float, float, float]:
    """Return W (a, b, c), a column of W M (3), and J W (a, b, c), one of N (2)."""
    v0 = pose[0] * a + pose[1] * b + pose[2] * c
    v1 = pose[3] * a + pose[4] * b + pose[5] * c
    v2 = pose[6] * a + pose[7] * b + pose[8] * c
    return v0, v1, v2, jx * v0 + jxz * v2, jy * v1 + jyz * v2


@_lane_jit
def project_one(
    place: tuple[float, ...], opacity: float, pose: tuple[float, ...], lens: tuple[float, ...], rule: tuple[float, ...]
) -> tuple[float, ...]:
    """Project a Gaussian by EWA (Zwicker et al. 2001).

    Returns centre (px), conic and opacity as drawn, opacity over the least that is drawn (0 where nothing is seen),
    sxx, syy (px^2), and depth: 10 numbers.
    """
    dilation, compensate, min_alpha, _, min_variance = rule
    fx, fy = lens[0], lens[1]
    x, y, z = _centre(place, pose)
    inv = 1.0 / z
    jx, jy, jxz, jyz = fx * inv, fy * inv, -fx * x * inv * inv, -fy * y * inv * inv
    _, _, _, a0, b0 = _axis(place[3], place[6], place[9], pose, jx, jy, jxz, jyz)
    _, _, _, a1, b1 = _axis(place[4], place[7], place[10], pose, jx, jy, jxz, jyz)
    _, _, _, a2, b2 = _axis(place[5], place[8], place[11], pose, jx, jy, jxz, jyz)
    sxx = a0 * a0 + a1 * a1 + a2 * a2
    sxy = a0 * b0 + a1 * b1 + a2 * b2
    syy = b0 * b0 + b1 * b1 + b2 * b2
    own = sxx * syy - sxy * sxy
    sxx += dilation
    syy += dilation
    det = sxx * syy - sxy * sxy
    drawn = opacity * math.sqrt(max(own, 0.0) / det) if compensate > 0.0 else opacity
    half = 0.5 * (sxx - syy)
    longest = 0.5 * (sxx + syy) + math.sqrt(half * half + sxy * sxy)
    seen = (z > NEAR) & (det > 0.0) & (det < np.inf) & (drawn >= min_alpha) & (longest >= min_variance)
    per_det = 1.0 / det
    return (
        fx * x * inv + lens[2], fy * y * inv + lens[3], syy * per_det, -sxy * per_det, sxx * per_det, drawn,
        drawn / min_alpha if seen else 0.0, sxx, syy, z,
    )  # fmt: skip


@_lane_jit
def project_lanes(buf: np.ndarray, pose: tuple[float, ...], lens: tuple[float, ...], rule: tuple[float, ...]) -> None:
    """Replace planes 0 to 9 by `project_one`; plane `OPACITY` holds the opacity that was given."""
    for i in range(U(LANES)):
        drawn = project_one(_lane_place(buf, i), buf[i + OPACITY], pose, lens, rule)
        buf[i], buf[i + _P1], buf[i + _P2], buf[i + _P3], buf[i + _P4] = drawn[:5]
        buf[i + _P5], buf[i + _P6], buf[i + _P7], buf[i + _P8], buf[i + _P9] = drawn[5:]


@_lane_jit
def reach_of(ratio: float, farthest: float) -> float:
    """Return twice the exponent to which a Gaussian is drawn, from its opacity over the least; -1 if it is unseen."""
    return 2.0 * min(math.log(ratio), farthest) if ratio > 0.0 else -1.0


@_lane_jit
def box_of(
    u: float, v: float, reach: float, sxx: float, syy: float, width: float, height: float
) -> tuple[float, float, float, float]:
    """Return the pixel box x0, y0, x1, y1 of a Gaussian at (u, v), by its `reach_of`; zeros where nothing is seen."""
    seen = reach >= 0.0
    reach = max(reach, 0.0)
    ex, ey = math.sqrt(reach * sxx), math.sqrt(reach * syy)
    x0, x1 = max(math.ceil(u - ex - 0.5), 0.0), min(math.floor(u + ex - 0.5) + 1.0, width)
    y0, y1 = max(math.ceil(v - ey - 0.5), 0.0), min(math.floor(v + ey - 0.5) + 1.0, height)
    seen = seen & (x1 > x0) & (y1 > y0)
    return x0 if seen else 0.0, y0 if seen else 0.0, x1 if seen else 0.0, y1 if seen else 0.0


@_lane_jit
def boxes(buf: np.ndarray, farthest: float, width: float, height: float) -> None:
    """Write `box_of` into planes 10, 11, 13, 14, after `project_lanes`."""
    for i in range(U(LANES)):
        buf[i + _P6] = reach_of(buf[i + _P6], farthest)
    for i in range(U(LANES)):
        x0, y0, x1, y1 = box_of(buf[i], buf[i + _P1], buf[i + _P6], buf[i + _P7], buf[i + _P8], width, height)
        buf[i + _P10], buf[i + _P11], buf[i + OPACITY + _P1], buf[i + OPACITY + _P2] = x0, y0, x1, y1


@_lane_jit
def store_one(
    k: int, box: tuple[float, ...], drawn: tuple[float, ...], opacity: float, z: float, flat: np.ndarray,
    depth: np.ndarray, extent: np.ndarray,
) -> None:  # fmt: skip
    """Store row k of ``flat``, ``depth``, ``extent``: 0 if unseen; ``drawn`` (6): centre, conic, opacity as drawn."""
    extent[k, 0], extent[k, 1], extent[k, 2], extent[k, 3] = int(box[0]), int(box[1]), int(box[2]), int(box[3])
    if box[2] > box[0]:
        depth[k] = z
        flat[k, 0], flat[k, 1], flat[k, 2], flat[k, 3] = drawn[0], drawn[1], drawn[2], drawn[3]
        flat[k, 4], flat[k, 5], flat[k, 6] = drawn[4], drawn[5], opacity
    else:
        depth[k] = 0.0
        flat[k, 0] = flat[k, 1] = flat[k, 2] = flat[k, 3] = flat[k, 4] = flat[k, 5] = flat[k, 6] = 0.0


@_lane_jit
def store_projected(
    buf: np.ndarray, begin: int, count: int, flat: np.ndarray, depth: np.ndarray, extent: np.ndarray
) -> None:
    """Store the first ``count`` lanes in rows from ``begin`` on, as `store_one` does."""
    for i in range(count):
        j = U(i)
        box = buf[j + _P10], buf[j + _P11], buf[j + OPACITY + _P1], buf[j + OPACITY + _P2]
        drawn = buf[j], buf[j + _P1], buf[j + _P2], buf[j + _P3], buf[j + _P4], buf[j + _P5]
        store_one(begin + i, box, drawn, buf[j + OPACITY], buf[j + _P9], flat, depth, extent)


@_lane_jit
def slope_one(
    place: tuple[float, ...], sums: tuple[float, ...], conic: tuple[float, ...], pose: tuple[float, ...],
    lens: tuple[float, ...], dilation: float, compensate: float,
) -> tuple[float, ...]:  # fmt: skip
    """Return the gradients of d (3) and E (6), by the first six sums of `splat.backward` and the conic as drawn."""
    fx, fy = lens[0], lens[1]
    x, y, z = _centre(place, pose)
    du, dv, h00, h01, h11 = screen_slope(
        conic[0], conic[1], conic[2], sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], dilation, compensate
    )
    inv = 1.0 / z
    jx, jy, jxz, jyz = fx * inv, fy * inv, -fx * x * inv * inv, -fy * y * inv * inv
    a0, a1, a2, m0, n0 = _axis(place[3], place[6], place[9], pose, jx, jy, jxz, jyz)
    b0, b1, b2, m1, n1 = _axis(place[4], place[7], place[10], pose, jx, jy, jxz, jyz)
    c0, c1, c2, m2, n2 = _axis(place[5], place[8], place[11], pose, jx, jy, jxz, jyz)
    p0, q0 = 2.0 * (h00 * m0 + h01 * n0), 2.0 * (h01 * m0 + h11 * n0)  # dL/dN, a column each
    p1, q1 = 2.0 * (h00 * m1 + h01 * n1), 2.0 * (h01 * m1 + h11 * n1)
    p2, q2 = 2.0 * (h00 * m2 + h01 * n2), 2.0 * (h01 * m2 + h11 * n2)
    d00, d02 = p0 * a0 + p1 * b0 + p2 * c0, p0 * a2 + p1 * b2 + p2 * c2  # dL/dJ
    d11, d12 = q0 * a1 + q1 * b1 + q2 * c1, q0 * a2 + q1 * b2 + q2 * c2
    dx, dy, dz = centre_slope(x, y, z, fx, fy, du, dv, d00, d02, d11, d12)
    return (
        dx * a0 + dy * a1 + dz * a2, dx * b0 + dy * b1 + dz * b2, dx * c0 + dy * c1 + dz * c2,
        p0 * m0 + q0 * n0, p1 * m1 + q1 * n1, p2 * m2 + q2 * n2,
        2.0 * (p0 * m1 + q0 * n1), 2.0 * (p0 * m2 + q0 * n2), 2.0 * (p1 * m2 + q1 * n2),
    )  # fmt: skip


@_lane_jit
def slope_lanes(
    buf: np.ndarray, pose: tuple[float, ...], lens: tuple[float, ...], dilation: float, compensate: float
) -> None:
    """Replace planes 0 to 8 by `slope_one`.

    Planes 0 to 11 hold centre and M, those from `TOTALS` on the nine sums of `splat.backward`, those from `CONIC` on
    the conic as drawn.
    """
    for i in range(U(LANES)):
        t, c = i + U(TOTALS) * _P1, i + U(CONIC) * _P1
        sums = buf[t], buf[t + _P1], buf[t + _P2], buf[t + _P3], buf[t + _P4], buf[t + _P5]
        conic = buf[c], buf[c + _P1], buf[c + _P2]
        slopes = slope_one(_lane_place(buf, i), sums, conic, pose, lens, dilation, compensate)
        buf[i], buf[i + _P1], buf[i + _P2], buf[i + _P3], buf[i + _P4] = slopes[:5]
        buf[i + _P5], buf[i + _P6], buf[i + _P7], buf[i + _P8] = slopes[5:]


@_lane_jit
def screen_slope(
    a: float, b: float, c: float, t0: float, t1: float, t2: float, t3: float, t4: float, t5: float, dilation: float,
    compensate: float,
) -> tuple[float, ...]:  # fmt: skip
    """Return gradients by the projected centre (u, v) and the projected covariance (H, symmetric).

    Takes the conic a, b, c as drawn and the first six of a Gaussian's sums. Where opacity is compensated by
    sqrt(det S / det S'), half of S^-1 - S'^-1 for each part of its gradient is added.
    """
    du, dv = a * t1 + b * t2, b * t1 + c * t2
    p0, p1 = a * t3 + b * t4, a * t4 + b * t5  # conic x second moments
    q0, q1 = b * t3 + c * t4, b * t4 + c * t5
    h00, h01, h11 = 0.5 * (p0 * a + p1 * b), 0.5 * (p0 * b + p1 * c), 0.5 * (q0 * b + q1 * c)
    det = 1.0 / (a * c - b * b)
    sxx, sxy, syy = c * det - dilation, -b * det, a * det - dilation
    own = sxx * syy - sxy * sxy
    valid = (compensate > 0.0) & (own > SINGULAR * det)
    h00 += 0.5 * t0 * (syy / own - a) if valid else 0.0
    h01 -= 0.5 * t0 * (sxy / own + b) if valid else 0.0
    h11 += 0.5 * t0 * (sxx / own - c) if valid else 0.0
    return du, dv, h00, h01, h11


@_lane_jit
def centre_slope(
    x: float, y: float, z: float, fx: float, fy: float, du: float, dv: float, d00: float, d02: float, d11: float,
    d12: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the gradient by the centre in camera coordinates; d is the gradient of the Jacobian J."""
    inv = 1.0 / z
    jx, jy, jxz, jyz = fx * inv, fy * inv, -fx * x * inv * inv, -fy * y * inv * inv
    dx = jx * (du - d02 * inv)
    dy = jy * (dv - d12 * inv)
    dz = jxz * du + jyz * dv - (jx * d00 + jy * d11 + 2.0 * (jxz * d02 + jyz * d12)) * inv
    return dx, dy, dz
