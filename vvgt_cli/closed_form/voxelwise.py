"""Moments of cells of whole voxels: one point a voxel where the function is straight over its values, else eight.

Bricks of 8^3 voxels with their neighbours are laid out as table coordinates. Range, mean and mean slopes of the
trilinear values over each voxel's box follow from the 27 voxels around, for all of a brick at once, axis by axis.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from vvgt_cli.closed_form.columns import BLUE, GREEN, MASS, RED, XX, XY, XZ, YY, YZ, ZZ, X, Y, Z
from vvgt_cli.closed_form.quadrature import shift_moments
from vvgt_cli.dvr.kernel import FLAGS, U, mean_optics
from vvgt_cli.dvr.layout import BRICK, TUPLES, Optics, Voxels
from vvgt_cli.dvr.vectors import add, lane, row, scale, sub
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations

EDGE = BRICK + 2  # of a brick with a voxel around it
PLANE = EDGE * EDGE
ALL = EDGE * PLANE
F = nb.float32
VALUE, LOW, HIGH, MEAN, ALONG_X, ALONG_Y, ALONG_Z, SPARE, OTHER = range(9)
ROWS = 9  # of the scratch (9, ALL) float32, named before
ROUNDING = 0.01  # of a table coordinate in float32

Place = tuple[float, float, float]
Sums = tuple[tuple[float, float, float, float], float, float, float, float, float, float]

_jit = inlined(fastmath=FLAGS, error_model="numpy")


@_jit
def _smooth(source: np.ndarray, to: np.ndarray, stride: int) -> None:
    """Write means of linear values over the boxes of voxels, along the axis of ``stride``."""
    n = ALL - 2 * stride
    before, here, after, out = source[:n], source[stride : stride + n], source[2 * stride :], to[stride : stride + n]
    for i in range(n):
        out[i] = F(0.125) * (before[i] + after[i]) + F(0.75) * here[i]


@_jit
def _slopes(source: np.ndarray, to: np.ndarray, stride: int) -> None:
    """Write mean slopes over the boxes of voxels."""
    n = ALL - 2 * stride
    before, after, out = source[:n], source[2 * stride :], to[stride : stride + n]
    for i in range(n):
        out[i] = F(0.5) * (after[i] - before[i])


@_jit
def _least(source: np.ndarray, to: np.ndarray, stride: int) -> None:
    """Write the smallest of each voxel and the middles between it and both neighbours."""
    n = ALL - 2 * stride
    before, here, after, out = source[:n], source[stride : stride + n], source[2 * stride :], to[stride : stride + n]
    for i in range(n):
        a = min(before[i] if before[i] < after[i] else after[i], here[i])
        out[i] = F(0.5) * (a + here[i])


@_jit
def _most(source: np.ndarray, to: np.ndarray, stride: int) -> None:
    """Write the largest of each voxel and the middles between it and both neighbours."""
    n = ALL - 2 * stride
    before, here, after, out = source[:n], source[stride : stride + n], source[2 * stride :], to[stride : stride + n]
    for i in range(n):
        a = max(before[i] if before[i] > after[i] else after[i], here[i])
        out[i] = F(0.5) * (a + here[i])


@_jit
def _lay_out(values: np.ndarray, x0: int, y0: int, z0: int, optics: Optics, to: np.ndarray) -> None:
    """Write table coordinates, beyond the table too, of the brick from voxel (x0, y0, z0) on and its surroundings."""
    nz, ny, nx = values.shape
    start, stop = min(max(1 - x0, 0), EDGE), min(EDGE, nx + 1 - x0)
    for k in range(EDGE):
        for j in range(EDGE):
            line = values[min(max(z0 + k - 1, 0), nz - 1), min(max(y0 + j - 1, 0), ny - 1)]
            part, out = line[x0 - 1 + start : x0 - 1 + stop], to[k * PLANE + j * EDGE : k * PLANE + (j + 1) * EDGE]
            for i in range(stop - start):
                out[start + i] = F((np.float64(part[i]) - optics.lo) * optics.inv_width)
            for i in range(start):
                out[i] = out[start]
            for i in range(stop, EDGE):
                out[i] = out[stop - 1]


@_jit
def _means(s: np.ndarray) -> None:
    """Fill rows MEAN to ALONG_Z of the scratch from row VALUE."""
    _smooth(s[VALUE], s[MEAN], PLANE)
    _slopes(s[VALUE], s[ALONG_Z], PLANE)
    _slopes(s[MEAN], s[ALONG_Y], EDGE)
    _smooth(s[MEAN], s[SPARE], EDGE)
    _smooth(s[ALONG_Z], s[OTHER], EDGE)
    _slopes(s[SPARE], s[ALONG_X], 1)
    _smooth(s[SPARE], s[MEAN], 1)
    _smooth(s[OTHER], s[ALONG_Z], 1)
    _smooth(s[ALONG_Y], s[OTHER], 1)


@_jit
def _linear(s: np.ndarray, p: int, optics: Optics) -> Sums:
    """Sum over the eight points of voxel ``p`` of a brick, where the function is linear."""
    top = optics.nodes.shape[0] - 1
    u = min(max(np.float64(s[MEAN, p]), 0.0), float(top))
    index = min(int(u), top - 1)
    first, second = row(optics.nodes, U(index)), row(optics.nodes, U(index + 1))
    here, rise = scale(8.0, add(first, scale(u - index, sub(second, first)))), 2.0 * (lane(second, 3) - lane(first, 3))
    total = lane(here, 0), lane(here, 1), lane(here, 2), lane(here, 3)
    return total, rise * s[ALONG_X, p], rise * s[OTHER, p], rise * s[ALONG_Z, p], 0.0, 0.0, 0.0


@_jit
def _curved(v: np.ndarray, p: int, optics: Optics) -> Sums:
    """Sum over the same points where it is not linear, each averaged over the spread of its own box."""
    bins = float(optics.nodes.shape[0] - 1)
    red = green = blue = mass = fx = fy = fz = xy = xz = yz = 0.0
    for octant in range(8):
        right, down, back = (octant & 1) * 2 - 1, (octant >> 1 & 1) * 2 - 1, (octant >> 2) * 2 - 1
        q, r = p + down * EDGE, p + back * PLANE
        t = q + r - p
        a, b, c, e = np.float64(v[U(p)]), np.float64(v[U(q)]), np.float64(v[U(r)]), np.float64(v[U(t)])
        da, db = np.float64(v[U(p + right)]) - a, np.float64(v[U(q + right)]) - b
        dc, de = np.float64(v[U(r + right)]) - c, np.float64(v[U(t + right)]) - e
        a, b, c, e = a + 0.25 * da, b + 0.25 * db, c + 0.25 * dc, e + 0.25 * de
        near, far = da + 0.25 * (db - da), dc + 0.25 * (de - dc)
        gx, gy = near + 0.25 * (far - near), (b - a) + 0.25 * ((e - c) - (b - a))
        a, c = a + 0.25 * (b - a), c + 0.25 * (e - c)
        gz, u = c - a, a + 0.25 * (c - a)
        w = 0.25 * math.sqrt(gx * gx + gy * gy + gz * gz)
        if not abs(u) + w < np.inf:
            continue
        u0, u1 = min(max(u - w, 0.0), bins), min(max(u + w, 0.0), bins)
        if u1 <= optics.dark[U(int(u0))]:
            continue
        own_red, own_green, own_blue, tau = mean_optics(u0, u1, optics)
        tau = max(tau, 0.0)
        red, green, blue, mass = red + own_red, green + own_green, blue + own_blue, mass + tau
        tx, ty = tau * right, tau * down
        fx, fy, fz = fx + tx, fy + ty, fz + tau * back
        xy, xz, yz = xy + tx * down, xz + tx * back, yz + ty * back
    return (red, green, blue, mass), fx, fy, fz, xy, xz, yz


@_jit
def _deposit(to: np.ndarray, at: Place, d: Place, sums: Sums) -> None:
    """Add the ``sums`` over the points of the voxel at ``at`` from a cell's corner; the points are ``d`` apart."""
    (x, y, z), (dx, dy, dz) = at, (0.5 * d[0], 0.5 * d[1], 0.5 * d[2])
    total, fx, fy, fz, xy, xz, yz = sums
    mass, fx, fy, fz = total[3], fx * dx, fy * dy, fz * dz
    to[MASS] += mass
    to[X] += mass * x + fx
    to[Y] += mass * y + fy
    to[Z] += mass * z + fz
    to[XX] += mass * (x * x + dx * dx) + 2.0 * x * fx
    to[XY] += mass * x * y + x * fy + y * fx + xy * dx * dy
    to[XZ] += mass * x * z + x * fz + z * fx + xz * dx * dz
    to[YY] += mass * (y * y + dy * dy) + 2.0 * y * fy
    to[YZ] += mass * y * z + y * fz + z * fy + yz * dy * dz
    to[ZZ] += mass * (z * z + dz * dz) + 2.0 * z * fz
    to[RED] += total[0]
    to[GREEN] += total[1]
    to[BLUE] += total[2]


@_jit
def _brick(values: np.ndarray, optics: Optics, x0: int, y0: int, z0: int, s: np.ndarray) -> None:
    """Fill the scratch for the brick from voxel (x0, y0, z0) on."""
    _lay_out(values, x0, y0, z0, optics, s[VALUE])
    _least(s[VALUE], s[SPARE], PLANE)
    _least(s[SPARE], s[OTHER], EDGE)
    _least(s[OTHER], s[LOW], 1)
    _most(s[VALUE], s[SPARE], PLANE)
    _most(s[SPARE], s[OTHER], EDGE)
    _most(s[OTHER], s[HIGH], 1)
    _means(s)


@_jit
def _add_row(
    s: np.ndarray, p: int, x0: int, x1: int, optics: Optics, linear_until: np.ndarray, shift: int, y: float, z: float,
    step: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Add the voxels ``x0`` to ``x1`` of a row, at ``p + x`` of a brick, to cells ``out`` (n, 13) of 2^``shift`` each.

    The row lies at ``y`` and ``z`` from the cells' corners; ``step`` (3,) a voxel's edges, unit frame.
    """
    bins, d, mask = float(optics.nodes.shape[0] - 1), (0.5 * step[0], 0.5 * step[1], 0.5 * step[2]), (1 << shift) - 1
    for x in range(x0, x1):
        low, high = np.float64(s[LOW, p + x]), np.float64(s[HIGH, p + x])
        u0, u1, finite = min(max(low, 0.0), bins), min(max(high, 0.0), bins), abs(s[MEAN, p + x]) < np.inf
        first = U(int(u0))
        if finite and u1 <= optics.dark[first]:
            continue
        at = (x & mask) * step[0] + d[0], y, z
        if finite and u1 <= linear_until[first] and low >= -ROUNDING and high <= bins + ROUNDING:
            _deposit(out[U(x >> shift)], at, d, _linear(s, p + x, optics))
        else:
            _deposit(out[U(x >> shift)], at, d, _curved(s[VALUE], p + x, optics))


@parallel_kernel("Voxels Optics f8:1 f8:2 i8:1 f8:1 f8:1 f8:1 f8:5", TUPLES, fastmath=FLAGS, error_model="numpy")
def voxel_moments(
    thread: ThreadSlice,
    voxels: Voxels, optics: Optics, linear_until: np.ndarray, blocks: np.ndarray, exponent: np.ndarray,
    half: np.ndarray, step: np.ndarray, begin: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Integrate `quadrature.block_moments` of cells of 2^``exponent`` (3,) voxels, two points a voxel and axis.

    ``linear_until`` (bins + 1,) of `linear_ranges`; other arguments as there.
    """
    nz, ny, nx = voxels.values.shape
    ex, ey, ez = exponent
    for b in iterations(thread, blocks.shape[0]):
        out[b] = 0.0
        x0, y0, z0 = int(blocks[b, 0]), int(blocks[b, 1]), int(blocks[b, 2])
        last_x, last_y = min(out.shape[3] << ex, nx - x0), min(out.shape[2] << ey, ny - y0)
        last_z = min(out.shape[1] << ez, nz - z0)
        s = np.empty((ROWS, ALL), np.float32)
        for kz in range(0, last_z, BRICK):
            for ky in range(0, last_y, BRICK):
                for kx in range(0, last_x, BRICK):
                    _brick(voxels.values, optics, x0 + kx, y0 + ky, z0 + kz, s)
                    for z in range(kz, min(kz + BRICK, last_z)):
                        for y in range(ky, min(ky + BRICK, last_y)):
                            p = (z - kz + 1) * PLANE + (y - ky + 1) * EDGE + 1 - kx
                            dy = ((y & ((1 << ey) - 1)) + 0.5) * step[1]
                            dz = ((z & ((1 << ez) - 1)) + 0.5) * step[2]
                            stop = min(kx + BRICK, last_x)
                            _add_row(s, p, kx, stop, optics, linear_until, ex, dy, dz, step, out[b, z >> ez, y >> ey])
        for k, j, i in np.ndindex(out.shape[1:4]):
            if out[b, k, j, i, MASS] > 0.0:
                x = (begin[0] + x0 + (i << ex)) * step[0] - half[0]
                y = (begin[1] + y0 + (j << ey)) * step[1] - half[1]
                z = (begin[2] + z0 + (k << ez)) * step[2] - half[2]
                shift_moments(out[b, k, j, i], x, y, z, (0.5 * step[0], 0.5 * step[1], 0.5 * step[2]))
