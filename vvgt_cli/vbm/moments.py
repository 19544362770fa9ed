"""Optical moments of base cells: a streaming reduction of the volume, brick by brick.

A base cell is a box of ``2^e`` voxels along each axis (e may be negative). Its moments are integrals of the extinction
``tau(trilinear(scalar))`` by midpoint quadrature, each point averaged over the scalar's spread within its own box
(so that a step function needs no finer points).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np

from vvgt_cli.dvr.kernel import FLAGS, mean_optics, sample, table_coordinate
from vvgt_cli.dvr.scene import BRICK, Scene

# columns of a moment row: M, M x, M y, M z, M xx, M xy, M xz, M yy, M yz, M zz, M r, M g, M b
MOMENTS = 13
CHUNK_CELLS = 1 << 20  # cells of the dense scratch buffer


@dataclass(frozen=True)
class Cells:
    """Base cells with extinction, in Morton order.

    Attributes:
        index: (n, 3) int32 cell indices (x, y, z) from the box's corner.
        moments: (n, 13) float64 integrals of tau times 1, x, y, z, xx, xy, xz, yy, yz, zz and r, g, b
            over the cell (unit-frame lengths: M has units of area).
        edge: (3,) cell edge in unit-frame lengths (x, y, z).
        exponent: (3,) int cell edge in voxels = 2^exponent.
    """

    index: np.ndarray
    moments: np.ndarray
    edge: np.ndarray
    exponent: np.ndarray


@nb.njit(cache=True, fastmath=FLAGS, inline="never")
def _gradient_width(values, x, y, z, dx, dy, dz):
    """Spread of the scalar over a box of edges (dx, dy, dz) voxels: root of the summed squared differences."""
    gx = sample(values, x + 0.5 * dx, y, z) - sample(values, x - 0.5 * dx, y, z)
    gy = sample(values, x, y + 0.5 * dy, z) - sample(values, x, y - 0.5 * dy, z)
    gz = sample(values, x, y, z + 0.5 * dz) - sample(values, x, y, z - 0.5 * dz)
    return math.sqrt(gx * gx + gy * gy + gz * gz)


@nb.njit(parallel=True, cache=True, fastmath=FLAGS)
def _brick_moments(values, lo, inv_width, nodes, cumulative, bricks, cells, points, cell_voxels, half, step, out):
    """Moments of the ``cells`` (x, y, z) cells of each brick with ``points`` (x, y, z) points a cell.

    ``bricks`` (n, 3) origins in voxels (x, y, z); ``out`` (n, cells z, cells y, cells x, 13).
    """
    nz, ny, nx = values.shape
    bins = nodes.shape[0] - 1
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
                                s = sample(values, x, y, z)
                                if not (abs(s) < np.inf):
                                    continue
                                w = 0.5 * _gradient_width(values, x, y, z, dx, dy, dz)
                                if not (w < np.inf):
                                    w = 0.0
                                u0 = table_coordinate(s - w, lo, inv_width, bins)
                                u1 = table_coordinate(s + w, lo, inv_width, bins)
                                r, g, bl, tau = mean_optics(u0, u1, nodes, cumulative, bins)
                                if not tau > 0.0:
                                    continue
                                tau *= box
                                ux = (x + 0.5) * step[0] - half[0]
                                uy = (y + 0.5) * step[1] - half[1]
                                uz = (z + 0.5) * step[2] - half[2]
                                # the point's own box has variance edge^2 / 12
                                row = out[b, cz, cy, cx]
                                row[0] += tau
                                row[1] += tau * ux
                                row[2] += tau * uy
                                row[3] += tau * uz
                                row[4] += tau * (ux * ux + (dx * step[0]) ** 2 / 12)
                                row[5] += tau * ux * uy
                                row[6] += tau * ux * uz
                                row[7] += tau * (uy * uy + (dy * step[1]) ** 2 / 12)
                                row[8] += tau * uy * uz
                                row[9] += tau * (uz * uz + (dz * step[2]) ** 2 / 12)
                                row[10] += box * r
                                row[11] += box * g
                                row[12] += box * bl


def exponents(step: np.ndarray, level: int) -> np.ndarray:
    """Per-axis exponents that make cells of about ``2^level`` x the finest voxel edge, as cubic as powers of two allow."""
    target = float(step.min()) * 2.0**level
    return np.round(np.log2(target / step)).astype(np.int64)


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


def base_cells(scene: Scene, exponent: np.ndarray, points_per_voxel: int = 2) -> Cells:
    """Moments of every base cell with extinction (see `Cells`); memory is that of the result plus a fixed scratch."""
    tables = scene.tables
    block = np.maximum(BRICK, 2.0**exponent).astype(np.int64)  # voxels of one work item, (x, y, z)
    cell_voxels = 2.0**exponent
    cells = np.round(block / cell_voxels).astype(np.int64)
    points = np.maximum(np.round(cell_voxels * points_per_voxel), min(points_per_voxel, 2)).astype(np.int64)
    origins = _active_blocks(scene, block)
    chunk = max(int(CHUNK_CELLS // cells.prod()), 1)
    scratch = np.empty((min(chunk, max(len(origins), 1)), cells[2], cells[1], cells[0], MOMENTS))
    kept_index, kept_moments = [], []
    for first in range(0, len(origins), chunk):
        part = origins[first : first + chunk]
        out = scratch[: len(part)]
        _brick_moments(
            scene.values, tables.lo, tables.inv_width, tables.nodes, tables.cumulative, part.astype(np.float64),
            cells, points, cell_voxels, scene.half, scene.step, out,
        )  # fmt: skip
        at = np.argwhere(out[..., 0] > 0)  # block, z, y, x
        kept_moments.append(out[at[:, 0], at[:, 1], at[:, 2], at[:, 3]])
        corner = np.round(part[at[:, 0]] / cell_voxels).astype(np.int32)
        kept_index.append(corner + at[:, :0:-1].astype(np.int32))
    index = np.concatenate(kept_index) if kept_index else np.empty((0, 3), np.int32)
    moments = np.concatenate(kept_moments) if kept_moments else np.empty((0, MOMENTS))
    order = np.argsort(morton(index), kind="stable")
    return Cells(index[order], moments[order], cell_voxels * scene.step, exponent)


def _active_blocks(scene: Scene, block: np.ndarray) -> np.ndarray:
    """Origins (n, 3) in voxels (x, y, z) of the blocks that hold a brick with extinction, in (z, y, x) order."""
    mask = scene.empty == 0
    for axis in range(3):  # a block's first half voxel interpolates with the brick before it
        ahead = [slice(None)] * 3
        behind = [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        mask[tuple(ahead)] |= mask[tuple(behind)].copy()
    bricks = np.argwhere(mask)[:, ::-1]  # (x, y, z)
    return np.unique((bricks * BRICK // block)[:, ::-1], axis=0)[:, ::-1] * block
