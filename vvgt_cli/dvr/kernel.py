"""The numba ray caster: pre-integrated emission-absorption with empty-space leaping (conventions: Optics)."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from vvgt_cli.dvr.runs import RUN, sample_run, stack_run
from vvgt_cli.dvr.scene import BRICK, BRICK_BITS
from vvgt_cli.jit import inlined

OPAQUE = 1e-3  # times step^2, as the error of integration goes: the transmittance at which a ray ends
SUB_DEPTH = 0.3  # optical depth of a sub-segment: colour is constant within one
PARTS = 32  # the most sub-segments; at the largest extinctions what lies behind the first few is not seen
UNKNOWN = (0.0, 0.0, 0.0, -1.0)  # of integrals that were not looked up
TILE = 16  # pixels along the edge of a tile: its rays share what they read
FLAGS = {"contract", "nsz", "arcp", "afn"}  # no nnan/ninf: non-finite voxels are data

U = nb.uint64

_jit = inlined(fastmath=FLAGS, error_model="numpy")


@_jit
def sample(values, x, y, z):
    """Trilinear value at voxel coordinates, clamped to the edge voxels; NaN where a corner is not finite."""
    nz, ny, nx = values.shape
    x = min(max(x, 0.0), nx - 1.0)
    y = min(max(y, 0.0), ny - 1.0)
    z = min(max(z, 0.0), nz - 1.0)
    i, j, k = int(x), int(y), int(z)
    fx, fy, fz = x - i, y - j, z - k
    gx, gy = 1.0 - fx, 1.0 - fy
    # unsigned: no wrap-around tests on the eight loads
    i1, j1, k1 = U(min(i + 1, nx - 1)), U(min(j + 1, ny - 1)), U(min(k + 1, nz - 1))
    i0, j0, k0 = U(i), U(j), U(k)
    c00 = values[k0, j0, i0] * gx + values[k0, j0, i1] * fx
    c01 = values[k0, j1, i0] * gx + values[k0, j1, i1] * fx
    c10 = values[k1, j0, i0] * gx + values[k1, j0, i1] * fx
    c11 = values[k1, j1, i0] * gx + values[k1, j1, i1] * fx
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
    index = min(int(u), bins - 1)
    f = u - index
    i, j = U(index), U(index + 1)
    h = 0.5 * f * f
    f -= h
    return (
        cumulative[i, 0] + f * nodes[i, 0] + h * nodes[j, 0],
        cumulative[i, 1] + f * nodes[i, 1] + h * nodes[j, 1],
        cumulative[i, 2] + f * nodes[i, 2] + h * nodes[j, 2],
        cumulative[i, 3] + f * nodes[i, 3] + h * nodes[j, 3],
    )


@_jit
def point_optics(u, nodes, bins):
    """(tau r, tau g, tau b, tau) at one table coordinate."""
    index = min(int(u), bins - 1)
    f = u - index
    g = 1.0 - f
    i, j = U(index), U(index + 1)
    return (
        g * nodes[i, 0] + f * nodes[j, 0],
        g * nodes[i, 1] + f * nodes[j, 1],
        g * nodes[i, 2] + f * nodes[j, 2],
        g * nodes[i, 3] + f * nodes[j, 3],
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
def absorbed(depth):
    """(1 - exp(-x)) / x for x >= 0; the series' error is below 1e-10."""
    if depth > 0.35:
        return (1.0 - math.exp(-depth)) / depth
    p = 1 / 5040 - depth * (1 / 40320 - depth * (1 / 362880))
    return 1.0 - depth * (
        1 / 2 - depth * (1 / 6 - depth * (1 / 24 - depth * (1 / 120 - depth * (1 / 720 - depth * p))))
    )


@_jit
def _composite(u0, u1, dt, nodes, cumulative, bins, light, start):
    """``light`` (r, g, b, T) behind a segment of length dt along which the table coordinate goes from u0 to u1.

    ``start`` holds `_integrals` at u0, or -1 as its last entry where they are not known. Returns the new light and the
    integrals at u1 in the same form.
    """
    red, green, blue, trans = light
    r0, g0, b0, a0 = start
    width = u1 - u0
    if abs(width) < 0.5:
        r, g, b, tau = point_optics(0.5 * (u0 + u1), nodes, bins)
        f = absorbed(tau * dt) * trans * dt
        return (red + f * r, green + f * g, blue + f * b, trans - f * tau), UNKNOWN
    scale = dt / width
    if a0 < 0.0:
        r0, g0, b0, a0 = _integrals(u0, nodes, cumulative, bins)
    r1, g1, b1, a1 = _integrals(u1, nodes, cumulative, bins)
    end = r1, g1, b1, a1
    parts = min(int((a1 - a0) * scale / SUB_DEPTH) + 1, PARTS)
    for part in range(1, parts + 1):
        if parts > 1:
            r1, g1, b1, a1 = _integrals(u0 + width * (part / parts), nodes, cumulative, bins)
        f = absorbed(max((a1 - a0) * scale, 0.0)) * trans * scale
        red += f * (r1 - r0)
        green += f * (g1 - g0)
        blue += f * (b1 - b0)
        trans -= f * (a1 - a0)
        r0, g0, b0, a0 = r1, g1, b1, a1
    return (red, green, blue, max(trans, 0.0)), end


@_jit
def _inverse(d):
    """1 / d, or so large for d = 0 that a face across that axis is never reached."""
    return 1.0 / d if d != 0.0 else 1e300


@_jit
def _exit(px, py, pz, ix, iy, iz, reach, bi, bj, bk):
    """Ray parameter at which the cube of bricks within ``reach`` of (bi, bj, bk) ends; ix, iy, iz: `_inverse`."""
    x = (bi + reach if ix > 0.0 else bi - reach + 1) * BRICK
    y = (bj + reach if iy > 0.0 else bj - reach + 1) * BRICK
    z = (bk + reach if iz > 0.0 else bk - reach + 1) * BRICK
    return min((x - px) * ix, (y - py) * iy, (z - pz) * iz)


@_jit
def _leap(px, py, pz, dx, dy, dz, reach, bi, bj, bk):
    """Ray parameter at which the empty cube of bricks around (bi, bj, bk) ends, from the ray's origin p."""
    return _exit(px, py, pz, _inverse(dx), _inverse(dy), _inverse(dz), reach, bi, bj, bk)


@_jit
def _brick(p, d, t, n):
    """Brick along one axis in which the ray p + t d is, clamped to the volume."""
    return min(max(int(p + t * d), 0), n - 1) >> BRICK_BITS


@_jit
def _skip(shape, empty, px, py, pz, dx, dy, dz, ix, iy, iz, t0, dt, count, i):
    """The sample from which on, after sample i, the ray may meet something visible; > count: none.

    Leaps from one empty cube of bricks to the next while what lies between is empty too: bricks that share a face make
    a box, and a cube of more than one brick holds the brick that the ray comes from. The last sample in empty space is
    returned, where the next segment starts.
    """
    nz, ny, nx = shape
    bi, bj, bk = _brick(px, dx, t0 + i * dt, nx), _brick(py, dy, t0 + i * dt, ny), _brick(pz, dz, t0 + i * dt, nz)
    reach = int(empty[U(bk), U(bj), U(bi)])
    if reach == 0:
        return i
    while True:
        i = max(int((_exit(px, py, pz, ix, iy, iz, reach, bi, bj, bk) - t0) / dt), i)
        if i >= count:
            return count + 1
        t = t0 + i * dt
        bi, bj, bk = _brick(px, dx, t, nx), _brick(py, dy, t, ny), _brick(pz, dz, t, nz)
        t = t0 + (i + 1) * dt
        ci, cj, ck = _brick(px, dx, t, nx), _brick(py, dy, t, ny), _brick(pz, dz, t, nz)
        reach = int(empty[U(ck), U(cj), U(ci)])
        if reach == 0 or (reach == 1 and abs(ci - bi) + abs(cj - bj) + abs(ck - bk) > 1):
            return i
        i += 1
        bi, bj, bk = ci, cj, ck


@_jit
def cast(values, lo, inv_width, nodes, cumulative, dark, empty, px, py, pz, dx, dy, dz, step):
    """Premultiplied (r, g, b, alpha) along p + t d in voxel coordinates, t in unit-frame lengths.

    ``step`` is the sampling distance in voxels (along the ray, in voxel coordinates); ``dark``: `OpticalTables.dark`.
    """
    nz, ny, nx = values.shape
    bins = nodes.shape[0] - 1
    flat = values.reshape(-1)
    run = nb.carray(stack_run(), RUN)  # type: ignore[call-arg]
    light = (0.0, 0.0, 0.0, 1.0)
    t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
    if not t1 > t0:
        return 0.0, 0.0, 0.0, 0.0
    count = max(math.ceil((t1 - t0) * math.sqrt(dx * dx + dy * dy + dz * dz) / step), 1)
    dt = (t1 - t0) / count
    opaque = OPAQUE * min(step * step, 1.0)
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    u0, known = -1.0, UNKNOWN  # -1: no sample there, or not finite
    i = 0
    while True:
        start = _skip(values.shape, empty, px, py, pz, dx, dy, dz, ix, iy, iz, t0, dt, count, i)
        if start > count:
            return light[0], light[1], light[2], 1.0 - light[3]
        if start > i:
            u0, i = -1.0, start
        t = t0 + i * dt
        sample_run(
            values, flat, px + t * dx, py + t * dy, pz + t * dz, dx * dt, dy * dt, dz * dt, lo, inv_width, bins, run
        )
        for n in range(min(RUN, count + 1 - i)):
            u1 = run[n]
            first = min(u0, u1)
            if first >= 0.0 and max(u0, u1) > dark[U(int(first))]:
                light, known = _composite(u0, u1, dt, nodes, cumulative, bins, light, known)
                if light[3] < opaque:
                    return light[0], light[1], light[2], 1.0 - light[3]
            else:
                known = UNKNOWN
            u0 = u1
        i += RUN
        if i > count:
            return light[0], light[1], light[2], 1.0 - light[3]


@_jit
def _pixel(values, lo, inv_width, nodes, cumulative, dark, empty, eye, basis, lens, step, col, row, grid, known):
    """Sums over ``grid`` x ``grid`` rays of a pixel; with ``known`` the central one is left out."""
    acc0 = acc1 = acc2 = acc3 = 0.0
    for ray in range(grid * grid):
        if known and 2 * ray + 1 == grid * grid:
            continue
        a = (col + (ray % grid + 0.5) / grid - lens[2]) * lens[0]
        b = (row + (ray // grid + 0.5) / grid - lens[3]) * lens[1]
        norm = 1.0 / math.sqrt(a * a + b * b + 1.0)
        dx = (basis[0, 0] * a + basis[1, 0] * b + basis[2, 0]) * norm
        dy = (basis[0, 1] * a + basis[1, 1] * b + basis[2, 1]) * norm
        dz = (basis[0, 2] * a + basis[1, 2] * b + basis[2, 2]) * norm
        red, green, blue, alpha = cast(
            values, lo, inv_width, nodes, cumulative, dark, empty, eye[0], eye[1], eye[2], dx, dy, dz, step
        )
        acc0, acc1, acc2, acc3 = acc0 + red, acc1 + green, acc2 + blue, acc3 + alpha
    return acc0, acc1, acc2, acc3


@nb.njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def render_tiles(
    values, lo, inv_width, nodes, cumulative, dark, empty, eye, basis, lens, step, order, grid, mask, known, out
):
    """Render one view into ``out`` (h, w, 4) float32 with ``grid`` x ``grid`` rays a pixel where ``mask`` is set.

    ``eye`` (3,) and ``basis`` (3, 3: rows right, down, forward) are in voxel coordinates per unit-frame length;
    ``lens`` is (1/fx, 1/fy, cx, cy); ``order`` permutes the tiles (row-major) so that contiguous chunks of threads are
    balanced; ``known`` says that ``out`` holds the central ray's result already and that ``grid`` is odd.
    """
    height, width = out.shape[:2]
    across = (width + TILE - 1) // TILE
    scale = 1.0 / (grid * grid)
    for index in nb.prange(len(order)):
        top, left = order[index] // across * TILE, order[index] % across * TILE
        for row in range(top, min(top + TILE, height)):
            for col in range(left, min(left + TILE, width)):
                if not mask[row, col]:
                    continue
                pixel = out[row, col]
                red, green, blue, alpha = _pixel(
                    values, lo, inv_width, nodes, cumulative, dark, empty, eye, basis, lens, step, col, row, grid, known
                )
                if known:
                    red, green, blue, alpha = red + pixel[0], green + pixel[1], blue + pixel[2], alpha + pixel[3]
                pixel[0], pixel[1], pixel[2], pixel[3] = red * scale, green * scale, blue * scale, alpha * scale
