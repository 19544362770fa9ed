"""Light that arrives attenuated: transmittance towards lights and towards what is around, on a grid of cells."""

from __future__ import annotations

import math

import numpy as np

from vvgt_cli.dvr.kernel import FLAGS, box_span, leap, mean_optics, sample, table_coordinate
from vvgt_cli.dvr.layout import BRICK_BITS, EXTINCTION, TUPLES, Optics, Voxels
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations

BLACK = 1e-3  # transmittance at which a ray ends, as none


@inlined(fastmath=FLAGS, error_model="numpy", borrowed=True)
def _transmittance(
    voxels: Voxels,
    optics: Optics,
    empty: np.ndarray,
    px: float,
    py: float,
    pz: float,
    dx: float,
    dy: float,
    dz: float,
    first: float,
    last: float,
    step: float,
) -> float:
    """Return transmittance from p along d (voxels a unit length), from ``first`` voxels to the length ``last``."""
    values, dark = voxels.values, optics.dark
    nz, ny, nx = values.shape
    t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
    pace = math.sqrt(dx * dx + dy * dy + dz * dz)
    t0, t1 = max(t0, first / pace), min(t1, last)
    if not t1 > t0:
        return 1.0
    count = max(math.ceil((t1 - t0) * pace / step), 1)
    dt = (t1 - t0) / count
    depth, u0, known, i = 0.0, 0.0, False, 0
    limit = -math.log(BLACK)
    while i < count:
        t = t0 + i * dt
        x, y, z = px + t * dx, py + t * dy, pz + t * dz
        bi = min(max(int(x), 0), nx - 1) >> BRICK_BITS
        bj = min(max(int(y), 0), ny - 1) >> BRICK_BITS
        bk = min(max(int(z), 0), nz - 1) >> BRICK_BITS
        reach = int(empty[bk, bj, bi])
        if reach > 0:
            j = int((min(leap(px, py, pz, dx, dy, dz, reach, bi, bj, bk), t1) - t0) / dt)
            if j > i:
                i, known = j, False
                continue
        if not known:
            u0 = table_coordinate(sample(values, x, y, z), optics)
        t += dt
        u1 = table_coordinate(sample(values, px + t * dx, py + t * dy, pz + t * dz), optics)
        if u0 >= 0.0 and u1 >= 0.0 and max(u0, u1) > dark[int(min(u0, u1))]:
            depth += max(mean_optics(u0, u1, optics)[3], 0.0) * dt
            if depth > limit:
                return 0.0
        u0, known = u1, True
        i += 1
    return math.exp(-depth)


@parallel_kernel("Voxels Optics u1:3 f8:2 b1:3 f8 f8 f8 f8 f4:3", EXTINCTION, fastmath=FLAGS, error_model="numpy")
def mean_transmittance(
    thread: ThreadSlice,
    voxels: Voxels,
    optics: Optics,
    empty: np.ndarray,
    directions: np.ndarray,
    wanted: np.ndarray,
    cell: float,
    first: float,
    last: float,
    step: float,
    out: np.ndarray,
) -> None:
    """Average over ``directions`` (n, 3), voxels a unit-frame length, at the centres of cubes of ``cell`` voxels.

    ``out`` (cz, cy, cx) float32; cells that are not ``wanted`` (cz, cy, cx) get 1.
    Rays begin ``first`` voxels from there and end at the unit-frame length ``last``; ``step`` in voxels.
    """
    nz, ny, nx = voxels.values.shape
    cz, cy, cx = out.shape
    for flat in iterations(thread, cz * cy):
        k, j = flat // cy, flat % cy
        z, y = min((k + 0.5) * cell, nz - 0.5) - 0.5, min((j + 0.5) * cell, ny - 0.5) - 0.5
        for i in range(cx):
            x = min((i + 0.5) * cell, nx - 0.5) - 0.5
            if not wanted[k, j, i]:
                out[k, j, i] = 1.0
                continue
            total = 0.0
            for n in range(directions.shape[0]):
                total += _transmittance(
                    voxels, optics, empty, x, y, z, directions[n, 0], directions[n, 1], directions[n, 2],
                    first, last, step,
                )  # fmt: skip
            out[k, j, i] = total / directions.shape[0]


@parallel_kernel("Voxels Optics u1:3 i8 f4:3", TUPLES, fastmath=FLAGS, error_model="numpy")
def cell_extinction(
    thread: ThreadSlice, voxels: Voxels, optics: Optics, empty: np.ndarray, cell: int, out: np.ndarray
) -> None:
    """Write the mean extinction of each cube of ``cell`` voxels along an edge into ``out`` (cz, cy, cx)."""
    nz, ny, nx = voxels.values.shape
    cz, cy, cx = out.shape
    for flat in iterations(thread, cz * cy):
        k, j = flat // cy, flat % cy
        z0, z1, y0, y1 = k * cell, min((k + 1) * cell, nz), j * cell, min((j + 1) * cell, ny)
        for i in range(cx):
            x0, x1, total = i * cell, min((i + 1) * cell, nx), 0.0
            for z in range(z0, z1):
                for y in range(y0, y1):
                    for x in range(x0, x1):
                        if empty[z >> BRICK_BITS, y >> BRICK_BITS, x >> BRICK_BITS] > 0:
                            continue
                        u = table_coordinate(np.float64(voxels.values[z, y, x]), optics)
                        if u >= 0.0:
                            n = min(int(u), optics.nodes.shape[0] - 2)
                            total += optics.nodes[n, 3] + (u - n) * (optics.nodes[n + 1, 3] - optics.nodes[n, 3])
            out[k, j, i] = total / ((z1 - z0) * (y1 - y0) * (x1 - x0))
