"""Optical moments of base cells: a streaming reduction of the volume, brick by brick.

A base cell is a box of ``2^e`` voxels along each axis (e may be negative). Its moments are integrals of the extinction
``tau(trilinear(scalar))`` by midpoint quadrature, each point averaged over the scalar's spread within its own box
(so that a step function needs no finer points).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba as nb
import numpy as np

from vvgt_cli.dvr.kernel import FLAGS, mean_optics, table_coordinate
from vvgt_cli.dvr.layout import BRICK, TUPLES, Optics, Voxels
from vvgt_cli.dvr.scene import Scene
from vvgt_cli.jit.decorators import inlined, kernel
from vvgt_cli.vbm.columns import BLUE, GREEN, MASS, MOMENTS, RED, XX, XY, XZ, YY, YZ, ZZ, X, Y, Z

U: Any = nb.uint64
FINEST_CUT = -4
CHUNK_CELLS = 1 << 19  # cells of the dense scratch buffer


@dataclass(frozen=True)
class Cells:
    """Base cells with extinction, in Morton order.

    Attributes:
        index: (n, 3) int32 cell indices (x, y, z) from the box's corner.
        moments: (n, 13) float64 integrals of tau over the cell by `columns` (unit-frame lengths: the mass is an area).
        edge: (3,) cell edge in unit-frame lengths (x, y, z).
        exponent: (3,) int cell edge in voxels = 2^exponent.
    """

    index: np.ndarray
    moments: np.ndarray
    edge: np.ndarray
    exponent: np.ndarray


@inlined(fastmath=FLAGS)
def _value_and_spread(
    values: np.ndarray, x: float, y: float, z: float, dx: float, dy: float, dz: float
) -> tuple[float, float]:
    """Trilinear value of ``values`` (nz, ny, nx) at voxel coordinates, and its spread over a box around there.

    The box has edges (dx, dy, dz) voxels.

    The spread is the root of the summed squared differences over the box, from the gradient of the same eight voxels.
    NaN where a voxel is not finite.
    """
    nz, ny, nx = values.shape
    # no spread in the rim before the first voxel centre (beyond the last one both neighbours are the same voxel)
    dx, dy, dz = dx if x > 0.0 else 0.0, dy if y > 0.0 else 0.0, dz if z > 0.0 else 0.0
    x = min(max(x, 0.0), nx - 1.0)
    y = min(max(y, 0.0), ny - 1.0)
    z = min(max(z, 0.0), nz - 1.0)
    i, j, k = U(x), U(y), U(z)
    fx, fy, fz = x - i, y - j, z - k
    i1 = min(i + U(1), U(nx - 1))
    j1 = min(j + U(1), U(ny - 1))
    k1 = min(k + U(1), U(nz - 1))
    a000, a001 = np.float64(values[k, j, i]), np.float64(values[k, j, i1])
    a010, a011 = np.float64(values[k, j1, i]), np.float64(values[k, j1, i1])
    a100, a101 = np.float64(values[k1, j, i]), np.float64(values[k1, j, i1])
    a110, a111 = np.float64(values[k1, j1, i]), np.float64(values[k1, j1, i1])
    c00, c01 = a000 + (a001 - a000) * fx, a010 + (a011 - a010) * fx
    c10, c11 = a100 + (a101 - a100) * fx, a110 + (a111 - a110) * fx
    c0, c1 = c00 + (c01 - c00) * fy, c10 + (c11 - c10) * fy
    g0, g1 = (a001 - a000) + (a011 - a010 - a001 + a000) * fy, (a101 - a100) + (a111 - a110 - a101 + a100) * fy
    gx = (g0 + (g1 - g0) * fz) * dx
    gy = ((c01 - c00) + (c11 - c10 - c01 + c00) * fz) * dy
    gz = (c1 - c0) * dz
    return c0 + (c1 - c0) * fz, math.sqrt(gx * gx + gy * gy + gz * gz)


@kernel(
    "Voxels Optics f8:2 i8:1 i8:1 f8:1 f8:1 f8:1 f8:5",
    TUPLES,
    parallel=True,
    fastmath=FLAGS,
)
def _brick_moments(
    voxels: Voxels, optics: Optics, bricks: np.ndarray, cells: np.ndarray, points: np.ndarray, cell_voxels: np.ndarray,
    half: np.ndarray, step: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Moments of the ``cells`` (3,) cells of each brick with ``points`` (3,) points a cell, both (x, y, z).

    ``bricks`` (n, 3) origins in voxels from the box's corner; ``cell_voxels`` (3,) a cell's edges, voxels; ``half``,
    ``step`` (3,) of `Scene`; all (x, y, z). ``out`` (n, cells z, cells y, cells x, 13) float64.
    """
    values, dark = voxels.values, optics.dark
    nz, ny, nx = values.shape
    dx, dy, dz = cell_voxels[0] / points[0], cell_voxels[1] / points[1], cell_voxels[2] / points[2]
    box = dx * step[0] * dy * step[1] * dz * step[2]
    for b in nb.prange(bricks.shape[0]):
        for cz in range(cells[2]):
            for cy in range(cells[1]):
                for cx in range(cells[0]):
                    for m in range(MOMENTS):
                        out[b, cz, cy, cx, m] = 0.0
                    for pz in range(points[2]):
                        z = bricks[b, 2] + cz * cell_voxels[2] + (pz + 0.5) * dz - 0.5
                        if z > nz - 0.5:
                            continue
                        for py in range(points[1]):
                            y = bricks[b, 1] + cy * cell_voxels[1] + (py + 0.5) * dy - 0.5
                            if y > ny - 0.5:
                                continue
                            for px in range(points[0]):
                                x = bricks[b, 0] + cx * cell_voxels[0] + (px + 0.5) * dx - 0.5
                                if x > nx - 0.5:
                                    continue
                                s, w = _value_and_spread(values, x, y, z, dx, dy, dz)
                                w *= 0.5
                                if not (abs(s) < np.inf and w < np.inf):
                                    continue
                                u0 = table_coordinate(s - w, optics)
                                u1 = table_coordinate(s + w, optics)
                                if max(u0, u1) <= dark[int(min(u0, u1))]:
                                    continue
                                r, g, bl, tau = mean_optics(u0, u1, optics)
                                if not tau > 0.0:
                                    continue
                                tau *= box
                                ux = (x + 0.5) * step[0] - half[0]
                                uy = (y + 0.5) * step[1] - half[1]
                                uz = (z + 0.5) * step[2] - half[2]
                                row = out[b, cz, cy, cx]  # the point's own box has variance edge^2 / 12
                                row[MASS] += tau
                                row[X] += tau * ux
                                row[Y] += tau * uy
                                row[Z] += tau * uz
                                row[XX] += tau * (ux * ux + (dx * step[0]) ** 2 / 12)
                                row[XY] += tau * ux * uy
                                row[XZ] += tau * ux * uz
                                row[YY] += tau * (uy * uy + (dy * step[1]) ** 2 / 12)
                                row[YZ] += tau * uy * uz
                                row[ZZ] += tau * (uz * uz + (dz * step[2]) ** 2 / 12)
                                row[RED] += box * r
                                row[GREEN] += box * g
                                row[BLUE] += box * bl


def exponents(step: np.ndarray, level: int) -> np.ndarray:
    """Per-axis exponents of cells of about ``2^level`` x the finest voxel edge, as cubic as powers of two allow.

    No voxel is cut into more than ``2^-FINEST_CUT`` along an axis: trilinear matter has nothing to show below that.
    """
    target = float(step.min()) * 2.0**level
    return np.maximum(np.round(np.log2(target / step)), FINEST_CUT).astype(np.int64)


def morton(index: np.ndarray) -> np.ndarray:
    """(n, 3) cell indices below 2^21 -> (n,) uint64 Morton codes, x lowest."""
    code = np.zeros(len(index), np.uint64)
    for axis in range(3):
        v = index[:, axis].astype(np.uint64)
        for shift, mask in (
            (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):  # fmt: skip
            v = (v | (v << np.uint64(shift))) & np.uint64(mask)
        code |= v << np.uint64(axis)
    return code


def base_cells(
    scene: Scene, exponent: np.ndarray, points_per_voxel: int = 2, progress: Callable[[float], None] | None = None
) -> Cells:
    """Moments of every base cell with extinction (see `Cells`); memory is that of the result plus a fixed scratch.

    ``progress`` is told the share that is done.
    """
    block = np.maximum(BRICK, 2.0**exponent).astype(np.int64)  # voxels of one work item, (x, y, z)
    cell_voxels = 2.0**exponent
    cells = np.round(block / cell_voxels).astype(np.int64)
    points = np.maximum(np.round(cell_voxels * points_per_voxel), min(points_per_voxel, 2)).astype(np.int64)
    origins = _active_blocks(scene, block)
    chunk = max(int(CHUNK_CELLS // cells.prod()), 1)
    scratch = np.empty((min(chunk, max(len(origins), 1)), cells[2], cells[1], cells[0], MOMENTS))
    kept_index, kept_moments = [], []
    voxels, optics = scene.voxels, scene.optics
    for first in range(0, len(origins), chunk):
        part = origins[first : first + chunk]
        out = scratch[: len(part)]
        _brick_moments(voxels, optics, part.astype(np.float64), cells, points, cell_voxels, scene.half, scene.step, out)
        at = np.argwhere(out[..., MASS] > 0)  # block, z, y, x
        kept_moments.append(out[at[:, 0], at[:, 1], at[:, 2], at[:, 3]])
        corner = np.round(part[at[:, 0]] / cell_voxels).astype(np.int32)
        kept_index.append(corner + at[:, :0:-1].astype(np.int32))
        if progress:
            progress(min(first + chunk, len(origins)) / len(origins))
    del scratch
    index = np.concatenate(kept_index) if kept_index else np.empty((0, 3), np.int32)
    order = np.argsort(morton(index), kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    moments, done = np.empty((len(order), MOMENTS)), 0
    while kept_moments:  # each part is let go of as it is laid in its place
        part = kept_moments.pop(0)
        moments[place[done : done + len(part)]] = part
        done += len(part)
    return Cells(index[order], moments, cell_voxels * scene.step, exponent)


# offsets (x, y, z) of a cell's children, x fastest
CHILDREN = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.int32)


def cell_moments(scene: Scene, corners: np.ndarray, edge: np.ndarray, points_per_voxel: int = 2) -> np.ndarray:
    """Moments (n, 8, 13) of the children of cells of ``edge`` (3,) voxels, ``corners`` (n, 3) voxels from the box's."""
    child = edge / 2
    points = np.maximum(np.round(child * points_per_voxel), 2).astype(np.int64)
    out = np.empty((len(corners), 2, 2, 2, MOMENTS))
    _brick_moments(
        scene.voxels, scene.optics, np.ascontiguousarray(corners, np.float64), np.full(3, 2), points, child,
        scene.half, scene.step, out,
    )  # fmt: skip
    return out.reshape(len(corners), 8, MOMENTS)


def _active_blocks(scene: Scene, block: np.ndarray) -> np.ndarray:
    """Origins (n, 3) in voxels (x, y, z) of the blocks that hold a brick with extinction, in (z, y, x) order."""
    mask = scene.empty == 0
    for axis in range(3):  # a block's first half voxel interpolates with the brick before it
        ahead = [slice(None)] * 3
        behind = [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        mask[tuple(ahead)] |= mask[tuple(behind)].copy()
    bricks = np.argwhere(mask)[:, ::-1]  # (x, y, z)
    result: np.ndarray = np.unique((bricks * BRICK // block)[:, ::-1], axis=0)[:, ::-1] * block
    return result
