"""What the cameras see of each cell: one march that deposits optical depth, and the seen part of it, on a grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba as nb
import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.dvr.kernel import FLAGS, _leap, box_span, mean_optics, sample, table_coordinate
from vvgt_cli.dvr.render import camera_arrays
from vvgt_cli.dvr.scene import BRICK_BITS, Scene

MAX_CELLS = 1 << 22
MAX_WORKERS = 8  # each has a grid of its own, so that sums need no atomics


@dataclass(frozen=True)
class Visibility:
    """Transmittance with which a cell's extinction is seen.

    Attributes:
        mean: (nz, ny, nx) float32 seen part of the optical depth, averaged over views and rays: in [0, 1].
        largest: (nz, ny, nx) float32 largest transmittance of any sample with extinction.
        exponent: cell edge in voxels = 2^exponent (scalar).
    """

    mean: np.ndarray
    largest: np.ndarray
    exponent: int


@nb.njit(parallel=True, cache=True, fastmath=FLAGS)
def _march(values, lo, inv_width, nodes, cumulative, empty, eyes, bases, lenses, size, step, inv_cell, grids):
    """Rays of all views; ``grids`` (workers, 3, cz, cy, cx) float32: depth, seen depth, largest transmittance."""
    nz, ny, nx = values.shape
    bins = nodes.shape[0] - 1
    workers = grids.shape[0]
    for worker in nb.prange(workers):
        for job in range(worker, eyes.shape[0] * size, workers):
            view, row = job // size, job % size
            px, py, pz = eyes[view, 0], eyes[view, 1], eyes[view, 2]
            basis, lens = bases[view], lenses[view]
            for col in range(size):
                a, b = (col + 0.5 - lens[2]) * lens[0], (row + 0.5 - lens[3]) * lens[1]
                norm = 1.0 / math.sqrt(a * a + b * b + 1.0)
                dx = (basis[0, 0] * a + basis[1, 0] * b + basis[2, 0]) * norm
                dy = (basis[0, 1] * a + basis[1, 1] * b + basis[2, 1]) * norm
                dz = (basis[0, 2] * a + basis[1, 2] * b + basis[2, 2]) * norm
                t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
                if not t1 > t0:
                    continue
                count = max(int(math.ceil((t1 - t0) * math.sqrt(dx * dx + dy * dy + dz * dz) / step)), 1)
                dt = (t1 - t0) / count
                trans, u0, known, i = 1.0, 0.0, False, 0
                while i < count and trans > 1e-4:
                    t = t0 + i * dt
                    x, y, z = px + t * dx, py + t * dy, pz + t * dz
                    bi = min(max(int(x), 0), nx - 1) >> BRICK_BITS
                    bj = min(max(int(y), 0), ny - 1) >> BRICK_BITS
                    bk = min(max(int(z), 0), nz - 1) >> BRICK_BITS
                    reach = int(empty[bk, bj, bi])
                    if reach > 0:
                        j = int((min(_leap(px, py, pz, dx, dy, dz, reach, bi, bj, bk), t1) - t0) / dt)
                        if j > i:
                            i, known = j, False
                            continue
                    if not known:
                        u0 = table_coordinate(sample(values, x, y, z), lo, inv_width, bins)
                    t += dt
                    u1 = table_coordinate(sample(values, px + t * dx, py + t * dy, pz + t * dz), lo, inv_width, bins)
                    if u0 >= 0.0 and u1 >= 0.0:
                        depth = mean_optics(u0, u1, nodes, cumulative, bins)[3] * dt
                        if depth > 0.0:
                            t -= 0.5 * dt
                            ci = min(int(max(px + t * dx + 0.5, 0.0) * inv_cell), grids.shape[4] - 1)
                            cj = min(int(max(py + t * dy + 0.5, 0.0) * inv_cell), grids.shape[3] - 1)
                            ck = min(int(max(pz + t * dz + 0.5, 0.0) * inv_cell), grids.shape[2] - 1)
                            after = trans * math.exp(-depth)
                            grids[worker, 0, ck, cj, ci] += depth
                            grids[worker, 1, ck, cj, ci] += trans - after
                            if trans > grids[worker, 2, ck, cj, ci]:
                                grids[worker, 2, ck, cj, ci] = trans
                            trans = after
                    u0, known = u1, True
                    i += 1
                # what lies behind is not seen: its depth is deposited as unseen by the next loop
                while i < count:
                    t = t0 + (i + 0.5) * dt
                    ci = min(int(max(px + t * dx + 0.5, 0.0) * inv_cell), grids.shape[4] - 1)
                    cj = min(int(max(py + t * dy + 0.5, 0.0) * inv_cell), grids.shape[3] - 1)
                    ck = min(int(max(pz + t * dz + 0.5, 0.0) * inv_cell), grids.shape[2] - 1)
                    u = table_coordinate(
                        sample(values, px + t * dx, py + t * dy, pz + t * dz), lo, inv_width, bins
                    )
                    if u >= 0.0:
                        grids[worker, 0, ck, cj, ci] += mean_optics(u, u, nodes, cumulative, bins)[3] * dt
                    i += 1


def visibility(scene: Scene, cameras: Sequence[Camera], step: float = 1.0) -> Visibility:
    """March every camera (square images of one size) and return what is seen of each cell of a grid."""
    exponent = 0
    while math.prod(-(-n >> exponent) if exponent else n for n in scene.values.shape) > MAX_CELLS:
        exponent += 1
    shape = tuple(-(-n // (1 << exponent)) for n in scene.values.shape)
    workers = min(nb.get_num_threads(), MAX_WORKERS)
    grids = np.zeros((workers, 3, *shape), np.float32)
    arrays = [camera_arrays(scene, camera) for camera in cameras]
    tables = scene.tables
    _march(
        scene.values, tables.lo, tables.inv_width, tables.nodes, tables.cumulative, scene.empty,
        np.stack([a[0] for a in arrays]), np.stack([a[1] for a in arrays]), np.stack([a[2] for a in arrays]),
        cameras[0].width, step, 1.0 / (1 << exponent), grids,
    )  # fmt: skip
    depth = grids[:, 0].sum(axis=0)
    mean = np.divide(grids[:, 1].sum(axis=0), depth, out=np.zeros(shape, np.float32), where=depth > 0)
    return Visibility(np.clip(mean, 0, 1), grids[:, 2].max(axis=0), exponent)
