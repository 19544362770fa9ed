"""The kernel under `moments`: midpoint quadrature of the extinction, point by point, in rows along x.

The points of a row lie between the same four rows of voxels: these are interpolated once, and every point from two
neighbours in what comes of it. Moments are gathered about each cell's corner and moved to the centre at the end.
"""

from __future__ import annotations

import math

import numpy as np

from vvgt_cli.closed_form.columns import BLUE, GREEN, MASS, MOMENTS, RED, XX, XY, XZ, YY, YZ, ZZ, X, Y, Z
from vvgt_cli.dvr.kernel import FLAGS, U, mean_optics, table_coordinate
from vvgt_cli.dvr.layout import LIT_GRID, TUPLES, Optics, Texels, Voxels
from vvgt_cli.dvr.vectors import add, lane, mix, texel, zeros4
from vvgt_cli.dvr.vectors import row as row_of
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations

_Near = tuple[int, int, float, float]  # of `_between`
Rows = tuple[np.ndarray, np.ndarray, np.ndarray]  # of `_rows`

_jit = inlined(fastmath=FLAGS, error_model="numpy")


@_jit
def _between(p: float, d: float, n: int) -> _Near:
    """Return voxels on both sides of ``p`` along an axis of ``n``, the second's share, and the length of spread there.

    That is ``d``, and 0 in the rim before the first centre (beyond the last one both neighbours are the same voxel).
    """
    spread = d if p > 0.0 else 0.0
    p = min(max(p, 0.0), n - 1.0)
    i = int(p)
    return i, min(i + 1, n - 1), p - i, spread


@_jit
def _rows(
    values: np.ndarray, y: _Near, z: _Near, first: int, value: np.ndarray, along_y: np.ndarray, along_z: np.ndarray
) -> tuple[float, float, float]:
    """Write voxels from ``first`` on, between rows: ``value``, and its differences over a point's box along y and z.

    ``y``, ``z`` of `_between`; the three rows (n,) float64 hold the edge voxels where they leave ``values``. Returns
    the smallest and largest value, and the largest square of both differences.
    """
    j0, j1, fy, dy = y
    k0, k1, fz, dz = z
    n, nx = value.shape[0], values.shape[2]
    start, stop = max(-first, 0), min(n, nx - first)
    low, high, steep = np.inf, -np.inf, 0.0
    for i in range(start, stop):
        a00, a01 = np.float64(values[k0, j0, first + i]), np.float64(values[k0, j1, first + i])
        a10, a11 = np.float64(values[k1, j0, first + i]), np.float64(values[k1, j1, first + i])
        c0, c1 = a00 + (a01 - a00) * fy, a10 + (a11 - a10) * fy
        value[i] = c0 + (c1 - c0) * fz
        along_y[i] = ((a01 - a00) + (a11 - a10 - a01 + a00) * fz) * dy
        along_z[i] = (c1 - c0) * dz
        low, high = min(low, value[i]), max(high, value[i])
        steep = max(steep, along_y[i] * along_y[i] + along_z[i] * along_z[i])
    for i in range(start):
        value[i], along_y[i], along_z[i] = value[start], along_y[start], along_z[start]
    for i in range(stop, n):
        value[i], along_y[i], along_z[i] = value[stop - 1], along_y[stop - 1], along_z[stop - 1]
    return low, high, steep


@_jit
def _all_dark(low: float, high: float, spread: float, optics: Optics) -> bool:
    """Return whether nothing within ``spread`` of the values from ``low`` to ``high`` has extinction."""
    if not low <= high:
        return True  # no voxel is finite
    u0, u1 = table_coordinate(low - spread, optics), table_coordinate(high + spread, optics)
    return min(u0, u1) >= 0.0 and max(u0, u1) <= optics.dark[int(min(u0, u1))]


@_jit
def _ranges(
    rows: Rows, at: np.ndarray, share: np.ndarray, dx: float, optics: Optics, u0: np.ndarray, u1: np.ndarray
) -> None:
    """Write table coordinates of both ends of the spread of a row's points; ``u1`` -1 where a voxel is not finite.

    Points lie at ``at + share`` (n,) of the ``rows`` of `_rows`. The spread is the root of the summed squared
    differences over a point's box.
    """
    value, along_y, along_z = rows
    bins = float(optics.nodes.shape[0] - 1)
    for m in range(at.shape[0]):
        i, f = at[m], share[m]
        d = value[i + 1] - value[i]
        s, gx = value[i] + d * f, d * dx
        gy = along_y[i] + (along_y[i + 1] - along_y[i]) * f
        gz = along_z[i] + (along_z[i + 1] - along_z[i]) * f
        w = 0.5 * math.sqrt(gx * gx + gy * gy + gz * gz)
        a = min(max((s - w - optics.lo) * optics.inv_width, 0.0), bins)
        b = min(max((s + w - optics.lo) * optics.inv_width, 0.0), bins)
        finite = abs(s) + w < np.inf
        u0[m] = min(a, b) if finite else 0.0
        u1[m] = max(a, b) if finite else -1.0


@_jit
def _deposit(row: np.ndarray, mass: float, first: float, second: float, y: float, z: float) -> None:
    """Add ``mass`` at (y, z), of moments ``first`` and ``second`` along x, to a cell's ``row`` (13,) of moments."""
    row[MASS] += mass
    row[X] += first
    row[Y] += mass * y
    row[Z] += mass * z
    row[XX] += second
    row[XY] += first * y
    row[XZ] += first * z
    row[YY] += mass * y * y
    row[YZ] += mass * y * z
    row[ZZ] += mass * z * z


@_jit
def _gather(
    u0: np.ndarray, u1: np.ndarray, optics: Optics, points: int, d: float, y: float, z: float, out: np.ndarray
) -> None:
    """Add a row of points to the moments ``out`` (cells, 13) about the cells' corners; ``points`` along x in a cell.

    The points lie at (m + 1/2) ``d`` from a corner along x and at ``y`` and ``z`` along the others, unit frame.
    """
    for m0 in range(0, u0.shape[0], points):
        mass, first, second, r, g, b = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for m in range(m0, min(m0 + points, u0.shape[0])):
            if u1[m] <= optics.dark[int(u0[m])]:
                continue
            red, green, blue, tau = mean_optics(u0[m], u1[m], optics)
            if tau > 0.0:
                x = (m - m0 + 0.5) * d
                mass, first, second = mass + tau, first + tau * x, second + tau * x * x
                r, g, b = r + red, g + green, b + blue
        if mass > 0.0:
            row = out[m0 // points]
            _deposit(row, mass, first, second, y, z)
            row[RED] += r
            row[GREEN] += g
            row[BLUE] += b


@_jit
def shift_moments(row: np.ndarray, x: float, y: float, z: float, d: tuple[float, float, float]) -> None:
    """Move moments about a cell's corner (x, y, z) to the origin; a point's own box ``d`` has variance d^2 / 12."""
    mass, first_x, first_y, first_z = row[MASS], row[X], row[Y], row[Z]
    row[XX] += mass * (x * x + d[0] * d[0] / 12) + 2 * x * first_x
    row[YY] += mass * (y * y + d[1] * d[1] / 12) + 2 * y * first_y
    row[ZZ] += mass * (z * z + d[2] * d[2] / 12) + 2 * z * first_z
    row[XY] += mass * x * y + x * first_y + y * first_x
    row[XZ] += mass * x * z + x * first_z + z * first_x
    row[YZ] += mass * y * z + y * first_z + z * first_y
    row[X] += mass * x
    row[Y] += mass * y
    row[Z] += mass * z
    for column in range(MOMENTS):
        row[column] *= d[0] * d[1] * d[2]


@_jit
def _texel_row(values: np.ndarray, y: _Near, z: _Near, first: int, out: np.ndarray) -> bool:
    """Write voxels from ``first`` on, between rows, into ``out`` (n, 4); return whether any has extinction.

    ``y``, ``z`` of `_between`; the row holds the edge voxels where it leaves ``values`` (nz, ny, nx, 4).
    """
    j0, j1, fy, _ = y
    k0, k1, fz, _ = z
    ny, nx, absorbs = values.shape[1], values.shape[2], False
    n00, n01, n10, n11 = (k0 * ny + j0) * nx, (k0 * ny + j1) * nx, (k1 * ny + j0) * nx, (k1 * ny + j1) * nx
    for m in range(out.shape[0]):
        i = min(max(first + m, 0), nx - 1)
        near = mix(texel(values, U(n00 + i)), texel(values, U(n01 + i)), fy)
        far = mix(texel(values, U(n10 + i)), texel(values, U(n11 + i)), fy)
        here = mix(near, far, fz)
        for c in range(4):
            out[m, c] = lane(here, c)
        absorbs = absorbs or out[m, 3] > 0.0
    return absorbs


@_jit
def _gather_texels(
    row: np.ndarray, at: np.ndarray, share: np.ndarray, points: int, d: float, y: float, z: float, out: np.ndarray
) -> None:
    """Apply `_gather` to points at ``at + share`` (n,) of a ``row`` of `_texel_row`."""
    for m0 in range(0, at.shape[0], points):
        first = second = 0.0
        total = zeros4()
        for m in range(m0, min(m0 + points, at.shape[0])):
            i = at[m]
            here = mix(row_of(row, U(i)), row_of(row, U(i + 1)), share[m])
            x, tau = (m - m0 + 0.5) * d, lane(here, 3)
            total, first, second = add(total, here), first + tau * x, second + tau * x * x
        mass = lane(total, 3)
        if mass > 0.0:
            cell = out[m0 // points]
            _deposit(cell, mass, first, second, y, z)
            cell[RED] += lane(total, 0)
            cell[GREEN] += lane(total, 1)
            cell[BLUE] += lane(total, 2)


def _moments(
    thread: ThreadSlice, voxels: Voxels, optics: Optics, texels: Texels | None, blocks: np.ndarray, points: np.ndarray,
    cell: np.ndarray, half: np.ndarray, step: np.ndarray, begin: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Integrate the moments of the cells of each block by ``points`` (3,) points a cell.

    ``texels`` is an optics grid or None; in mass and colour a grid is exact, as what is interpolated is what is summed.
    ``blocks`` (n, 3) origins in voxels from the corner of ``voxels``; ``cell`` (3,) a cell's edges, voxels; ``half``,
    ``step`` (3,) of `Scene`; ``begin`` (3,) voxel of the whole volume that ``voxels`` begin with; all (x, y, z).
    ``out`` (n, cells z, cells y, cells x, 13) float64.
    """
    nz, ny, nx = voxels.values.shape
    dx, dy, dz = cell[0] / points[0], cell[1] / points[1], cell[2] / points[2]
    box = dx * step[0], dy * step[1], dz * step[2]
    for b in iterations(thread, blocks.shape[0]):
        out[b] = 0.0
        x0, y0, z0 = blocks[b]
        first = math.floor(x0 - 0.5)
        inside = min(out.shape[3] * points[0], math.floor((nx - x0) / dx + 0.5))  # points along x within the box
        at, share = np.empty(inside, np.int64), np.empty(inside)
        for m in range(inside):
            x = (m + 0.5) * dx + (x0 - 0.5 - first)
            at[m] = int(x)
            share[m] = x - at[m]
        n = at[inside - 1] + 2 if inside > 0 else 0
        if texels is None:
            u0, u1, value, along_y, along_z = np.empty(inside), np.empty(inside), np.empty(n), np.empty(n), np.empty(n)
        else:
            row = np.empty((n, 4))
        for pz in range(out.shape[1] * points[2]):
            z = z0 + (pz + 0.5) * dz - 0.5
            for py in range(out.shape[2] * points[1]):
                y = y0 + (py + 0.5) * dy - 0.5
                if inside < 1 or z > nz - 0.5 or y > ny - 0.5:
                    continue
                near_y, near_z, cy, cz = _between(y, dy, ny), _between(z, dz, nz), py // points[1], pz // points[2]
                ly, lz = (py - cy * points[1] + 0.5) * box[1], (pz - cz * points[2] + 0.5) * box[2]
                if texels is None:
                    low, high, steep = _rows(voxels.values, near_y, near_z, first, value, along_y, along_z)
                    if _all_dark(low, high, 0.5 * math.sqrt(steep + (high - low) ** 2 * dx * dx), optics):
                        continue
                    _ranges((value, along_y, along_z), at, share, dx, optics, u0, u1)
                    _gather(u0, u1, optics, points[0], box[0], ly, lz, out[b, cz, cy])
                elif _texel_row(texels.values, near_y, near_z, first, row):
                    _gather_texels(row, at, share, points[0], box[0], ly, lz, out[b, cz, cy])
        for cz, cy, cx in np.ndindex(out.shape[1:4]):
            if out[b, cz, cy, cx, MASS] > 0.0:
                x = (begin[0] + x0 + cx * cell[0]) * step[0] - half[0]
                y = (begin[1] + y0 + cy * cell[1]) * step[1] - half[1]
                z = (begin[2] + z0 + cz * cell[2]) * step[2] - half[2]
                shift_moments(out[b, cz, cy, cx], x, y, z, box)


REST = "f8:2 i8:1 f8:1 f8:1 f8:1 f8:1 f8:5"
block_moments = parallel_kernel(
    f"Voxels Optics none {REST}", TUPLES, name="block_moments", fastmath=FLAGS, error_model="numpy"
)(_moments)
grid_moments = parallel_kernel(
    f"Voxels Optics Texels {REST}", LIT_GRID, name="grid_moments", fastmath=FLAGS, error_model="numpy"
)(_moments)


@parallel_kernel("f8:5 i8:1 i8:1 f8:2 i4:2")
def compact(
    thread: ThreadSlice, dense: np.ndarray, order: np.ndarray, start: np.ndarray, moments: np.ndarray, cells: np.ndarray
) -> None:
    """Copy rows with mass of ``dense`` (n, cells z, cells y, cells x, 13), block by block, by ``order`` within a block.

    ``order`` (cells,) numbers of a block's cells, x fastest; ``start`` (n,) where a block's rows begin in ``moments``
    (rows, 13) and ``cells`` (rows, 3), which get the cells' (x, y, z) in their block.
    """
    cy, cx = dense.shape[2], dense.shape[3]
    for b in iterations(thread, dense.shape[0]):
        to = start[b]
        for cell in order:
            x, y, z = cell % cx, cell // cx % cy, cell // (cx * cy)
            if dense[b, z, y, x, MASS] > 0.0:
                for column in range(MOMENTS):  # an assignment of slices takes 2 s to compile
                    moments[to, column] = dense[b, z, y, x, column]
                cells[to, 0], cells[to, 1], cells[to, 2] = x, y, z
                to += 1
