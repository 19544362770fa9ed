"""The numba ray caster: pre-integrated emission-absorption with empty-space leaping (conventions: Optics)."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from vvgt_cli.dvr.scene import BRICK, BRICK_BITS

OPAQUE = 1e-5  # transmittance at which a ray ends: half a step of 16-bit output
SUB_DEPTH = 0.3  # optical depth of a sub-segment: colour is constant within one
FLAGS = {"contract", "nsz", "arcp", "afn"}  # no nnan/ninf: non-finite voxels are data

_jit = nb.njit(cache=True, fastmath=FLAGS, inline="never")


@_jit
def sample(values, x, y, z):
    """Trilinear value at voxel coordinates, clamped to the edge voxels; NaN where a corner is not finite."""
    nz, ny, nx = values.shape
    x = min(max(x, 0.0), nx - 1.0)
    y = min(max(y, 0.0), ny - 1.0)
    z = min(max(z, 0.0), nz - 1.0)
    i, j, k = nb.uint64(x), nb.uint64(y), nb.uint64(z)  # unsigned: no wrap-around tests on the eight loads
    fx, fy, fz = x - i, y - j, z - k
    i1 = min(i + nb.uint64(1), nb.uint64(nx - 1))
    j1 = min(j + nb.uint64(1), nb.uint64(ny - 1))
    k1 = min(k + nb.uint64(1), nb.uint64(nz - 1))
    gx, gy = 1.0 - fx, 1.0 - fy
    c00 = values[k, j, i] * gx + values[k, j, i1] * fx
    c01 = values[k, j1, i] * gx + values[k, j1, i1] * fx
    c10 = values[k1, j, i] * gx + values[k1, j, i1] * fx
    c11 = values[k1, j1, i] * gx + values[k1, j1, i1] * fx
    return (c00 * gy + c01 * fy) * (1.0 - fz) + (c10 * gy + c11 * fy) * fz


@_jit
def table_coordinate(value, lo, inv_width, bins):
    """Table coordinate in [0, bins], or -1 for a value that is not finite."""
    if not (abs(value) < np.inf):
        return -1.0
    return min(max((value - lo) * inv_width, 0.0), float(bins))


@_jit
def _integrals(u, nodes, cumulative, bins):
    """Integrals over [0, u] of (tau r, tau g, tau b, tau): trapezoid, exact where tau is linear within a bin."""
    i = nb.uint64(min(int(u), bins - 1))
    f = u - i
    h = 0.5 * f * f
    f -= h
    return (
        cumulative[i, 0] + f * nodes[i, 0] + h * nodes[i + 1, 0],
        cumulative[i, 1] + f * nodes[i, 1] + h * nodes[i + 1, 1],
        cumulative[i, 2] + f * nodes[i, 2] + h * nodes[i + 1, 2],
        cumulative[i, 3] + f * nodes[i, 3] + h * nodes[i + 1, 3],
    )


@_jit
def point_optics(u, nodes, bins):
    """(tau r, tau g, tau b, tau) at one table coordinate."""
    i = nb.uint64(min(int(u), bins - 1))
    f = u - i
    return (
        nodes[i, 0] + f * (nodes[i + 1, 0] - nodes[i, 0]),
        nodes[i, 1] + f * (nodes[i + 1, 1] - nodes[i, 1]),
        nodes[i, 2] + f * (nodes[i + 1, 2] - nodes[i, 2]),
        nodes[i, 3] + f * (nodes[i + 1, 3] - nodes[i, 3]),
    )


@_jit
def mean_optics(u0, u1, nodes, cumulative, bins):
    """Mean of (tau r, tau g, tau b, tau) while the table coordinate goes linearly from u0 to u1."""
    if abs(u1 - u0) < 0.5:
        return point_optics(0.5 * (u0 + u1), nodes, bins)
    inv = 1.0 / (u1 - u0)
    r0, g0, b0, a0 = _integrals(u0, nodes, cumulative, bins)
    r1, g1, b1, a1 = _integrals(u1, nodes, cumulative, bins)
    return (r1 - r0) * inv, (g1 - g0) * inv, (b1 - b0) * inv, (a1 - a0) * inv


@_jit
def _leap(px, py, pz, dx, dy, dz, reach, bi, bj, bk):
    """Ray parameter at which the empty cube of bricks around (bi, bj, bk) ends, from the ray's origin p."""
    t = np.inf
    if dx != 0.0:
        face = (bi + reach) * BRICK if dx > 0 else (bi - reach + 1) * BRICK
        t = min(t, (face - px) / dx)
    if dy != 0.0:
        face = (bj + reach) * BRICK if dy > 0 else (bj - reach + 1) * BRICK
        t = min(t, (face - py) / dy)
    if dz != 0.0:
        face = (bk + reach) * BRICK if dz > 0 else (bk - reach + 1) * BRICK
        t = min(t, (face - pz) / dz)
    return t


@_jit
def box_span(px, py, pz, dx, dy, dz, nx, ny, nz):
    """Entry and exit of a ray (p + t d, t >= 0) through the box [-1/2, n - 1/2]^3; entry >= exit: missed."""
    t0, t1 = 0.0, np.inf
    for p, d, n in ((px, dx, nx), (py, dy, ny), (pz, dz, nz)):
        if d == 0.0:
            if p < -0.5 or p > n - 0.5:
                return 1.0, 0.0
        else:
            a, b = (-0.5 - p) / d, (n - 0.5 - p) / d
            t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
    return t0, t1


@_jit
def cast(values, lo, inv_width, nodes, cumulative, empty, px, py, pz, dx, dy, dz, step):
    """Premultiplied (r, g, b, alpha) along p + t d in voxel coordinates, t in unit-frame lengths.

    ``step`` is the sampling distance in voxels (along the ray, in voxel coordinates).
    """
    nz, ny, nx = values.shape
    bins = nodes.shape[0] - 1
    red = green = blue = 0.0
    trans = 1.0
    t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
    if not t1 > t0:
        return red, green, blue, 0.0
    count = max(int(math.ceil((t1 - t0) * math.sqrt(dx * dx + dy * dy + dz * dz) / step)), 1)
    dt = (t1 - t0) / count
    i = 0
    u0, known = 0.0, False
    while i < count:
        t = t0 + i * dt
        x, y, z = px + t * dx, py + t * dy, pz + t * dz
        bi = min(max(int(x), 0), nx - 1) >> BRICK_BITS
        bj = min(max(int(y), 0), ny - 1) >> BRICK_BITS
        bk = min(max(int(z), 0), nz - 1) >> BRICK_BITS
        reach = int(empty[nb.uint64(bk), nb.uint64(bj), nb.uint64(bi)])
        if reach > 0:
            j = int((min(_leap(px, py, pz, dx, dy, dz, reach, bi, bj, bk), t1) - t0) / dt)
            if j > i:
                i = j
                known = False
                continue
        if not known:
            u0 = table_coordinate(sample(values, x, y, z), lo, inv_width, bins)
        t += dt
        u1 = table_coordinate(sample(values, px + t * dx, py + t * dy, pz + t * dz), lo, inv_width, bins)
        if u0 >= 0.0 and u1 >= 0.0:
            r, g, b, tau = mean_optics(u0, u1, nodes, cumulative, bins)
            depth = tau * dt
            if depth > 0.0:
                parts = 1
                if depth > SUB_DEPTH and abs(u1 - u0) > 0.5:
                    parts = min(int(depth / SUB_DEPTH) + 1, 32)
                for part in range(parts):
                    if parts > 1:
                        ua = u0 + (u1 - u0) * part / parts
                        ub = u0 + (u1 - u0) * (part + 1) / parts
                        r, g, b, tau = mean_optics(ua, ub, nodes, cumulative, bins)
                        depth = tau * dt / parts
                    if depth > 0.0:
                        alpha = -math.expm1(-depth)
                        weight = trans * alpha / tau
                        red += weight * r
                        green += weight * g
                        blue += weight * b
                        trans *= 1.0 - alpha
                if trans < OPAQUE:
                    break
        u0, known = u1, True
        i += 1
    return red, green, blue, 1.0 - trans


@nb.njit(parallel=True, cache=True, fastmath=FLAGS)
def render_rows(values, lo, inv_width, nodes, cumulative, empty, eye, basis, lens, step, order, grid, mask, out):
    """Render one view into ``out`` (h, w, 4) float32 with ``grid`` x ``grid`` rays a pixel where ``mask`` is set.

    ``eye`` (3,) and ``basis`` (3, 3: rows right, down, forward) are in voxel coordinates per unit-frame length;
    ``lens`` is (1/fx, 1/fy, cx, cy); ``order`` permutes rows so that contiguous chunks of threads are balanced.
    """
    height, width = out.shape[:2]
    for index in nb.prange(height):
        row = order[index]
        for col in range(width):
            if not mask[row, col]:
                continue
            acc0 = acc1 = acc2 = acc3 = 0.0
            for sy in range(grid):
                for sx in range(grid):
                    a = (col + (sx + 0.5) / grid - lens[2]) * lens[0]
                    b = (row + (sy + 0.5) / grid - lens[3]) * lens[1]
                    norm = 1.0 / math.sqrt(a * a + b * b + 1.0)
                    dx = (basis[0, 0] * a + basis[1, 0] * b + basis[2, 0]) * norm
                    dy = (basis[0, 1] * a + basis[1, 1] * b + basis[2, 1]) * norm
                    dz = (basis[0, 2] * a + basis[1, 2] * b + basis[2, 2]) * norm
                    r, g, bl, al = cast(
                        values, lo, inv_width, nodes, cumulative, empty, eye[0], eye[1], eye[2], dx, dy, dz, step
                    )
                    acc0 += r
                    acc1 += g
                    acc2 += bl
                    acc3 += al
            scale = 1.0 / (grid * grid)
            out[row, col, 0] = acc0 * scale
            out[row, col, 1] = acc1 * scale
            out[row, col, 2] = acc2 * scale
            out[row, col, 3] = acc3 * scale
