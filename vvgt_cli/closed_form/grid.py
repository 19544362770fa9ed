"""`quadrature.block_moments` of optics grids: exact in mass and colour, as what is interpolated is what is summed."""

from __future__ import annotations

import math

import numpy as np

from vvgt_cli.closed_form.columns import BLUE, GREEN, MASS, RED
from vvgt_cli.closed_form.quadrature import Between, between, deposit, shift_moments
from vvgt_cli.dvr.kernel import FLAGS, U
from vvgt_cli.dvr.layout import GRID, Texels
from vvgt_cli.dvr.vectors import add, lane, mix, texel, zeros4
from vvgt_cli.dvr.vectors import row as row_of
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations

_jit = inlined(fastmath=FLAGS, error_model="numpy")


@_jit
def _row(values: np.ndarray, y: Between, z: Between, first: int, out: np.ndarray) -> bool:
    """Write voxels from ``first`` on, between rows, into ``out`` (n, 4); return whether any has extinction.

    ``y``, ``z`` of `between`; the row holds the edge voxels where it leaves ``values`` (nz, ny, nx, 4).
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
def _gather(
    row: np.ndarray, at: np.ndarray, share: np.ndarray, points: int, d: float, y: float, z: float, out: np.ndarray
) -> None:
    """Apply `quadrature._gather` to points at ``at + share`` (n,) of a ``row`` of `_row`."""
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
            deposit(cell, mass, first, second, y, z)
            cell[RED] += lane(total, 0)
            cell[GREEN] += lane(total, 1)
            cell[BLUE] += lane(total, 2)


@parallel_kernel("Texels f8:2 i8:1 f8:1 f8:1 f8:1 f8:1 f8:5", GRID, fastmath=FLAGS, error_model="numpy")
def grid_moments(
    thread: ThreadSlice,
    texels: Texels, blocks: np.ndarray, points: np.ndarray, cell: np.ndarray, half: np.ndarray, step: np.ndarray,
    begin: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Compute `quadrature.block_moments` of a grid, arguments as there."""
    values = texels.values
    nz, ny, nx, _ = values.shape
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
        row = np.empty((at[inside - 1] + 2 if inside > 0 else 0, 4))
        for pz in range(out.shape[1] * points[2]):
            z = z0 + (pz + 0.5) * dz - 0.5
            for py in range(out.shape[2] * points[1]):
                y = y0 + (py + 0.5) * dy - 0.5
                if inside < 1 or z > nz - 0.5 or y > ny - 0.5:
                    continue
                if not _row(values, between(y, dy, ny), between(z, dz, nz), first, row):
                    continue
                cy, cz = py // points[1], pz // points[2]
                ly, lz = (py - cy * points[1] + 0.5) * box[1], (pz - cz * points[2] + 0.5) * box[2]
                _gather(row, at, share, points[0], box[0], ly, lz, out[b, cz, cy])
        for cz, cy, cx in np.ndindex(out.shape[1:4]):
            if out[b, cz, cy, cx, MASS] > 0.0:
                x = (begin[0] + x0 + cx * cell[0]) * step[0] - half[0]
                y = (begin[1] + y0 + cy * cell[1]) * step[1] - half[1]
                z = (begin[2] + z0 + cz * cell[2]) * step[2] - half[2]
                shift_moments(out[b, cz, cy, cx], x, y, z, box)
