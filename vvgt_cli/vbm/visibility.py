"""What the cameras see of each cell: one march that deposits optical depth, and the seen part of it, on a grid."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numba as nb
import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.dvr.kernel import FLAGS, box_span, leap, mean_optics, sample, table_coordinate
from vvgt_cli.dvr.layout import BRICK_BITS, TUPLES, Optics, Voxels
from vvgt_cli.dvr.render import camera_arrays
from vvgt_cli.dvr.runs import BORROWED
from vvgt_cli.dvr.scene import Scene
from vvgt_cli.jit.decorators import inlined, kernel

MAX_CELLS = 1 << 24
MIN_RAYS = 8  # that meet a cell: with fewer, some cells are met by none and count as hidden
WORKERS = 4  # each with a grid of its own, so that sums need no atomics; whatever the threads, for the same bytes
MAX_GRID = 1 << 25  # cells of all workers together
THIN = 2.0  # pixels of the march: all of a box that is thinner may lie between two rays


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

    def at(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and largest transmittance (n,) at positions (n, 3) in voxels (x, y, z) from the box's corner."""
        top = np.array(self.mean.shape[::-1]) - 1
        x, y, z = np.clip(np.floor(position / (1 << self.exponent)).astype(np.int64), 0, top).T
        return self.mean[z, y, x], self.largest[z, y, x]


@inlined(fastmath=FLAGS)
def _cell(x: float, y: float, z: float, inv_cell: float, grid: np.ndarray) -> tuple[int, int, int]:
    """Cell (z, y, x) of ``grid`` (3, cz, cy, cx) with a point (voxels); ``inv_cell`` cells a voxel."""
    return (
        min(int(max(z + 0.5, 0.0) * inv_cell), grid.shape[1] - 1),
        min(int(max(y + 0.5, 0.0) * inv_cell), grid.shape[2] - 1),
        min(int(max(x + 0.5, 0.0) * inv_cell), grid.shape[3] - 1),
    )


@inlined(fastmath=FLAGS, **BORROWED)
def _deposit(
    voxels: Voxels, optics: Optics, empty: np.ndarray, px: float, py: float, pz: float, dx: float, dy: float, dz: float,
    step: float, inv_cell: float, grid: np.ndarray,
) -> None:  # fmt: skip
    """March p + t d and add to ``grid`` (3, cz, cy, cx): optical depth, its seen part, largest transmittance.

    p, d, ``step`` in voxels; ``empty`` (bz, by, bx) uint8; ``inv_cell`` grid cells a voxel. What lies behind an opaque
    front adds to the depth only: it is there, and not seen.
    """
    values, dark = voxels.values, optics.dark
    nz, ny, nx = values.shape
    t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
    if not t1 > t0:
        return
    count = max(math.ceil((t1 - t0) * math.sqrt(dx * dx + dy * dy + dz * dz) / step), 1)
    dt = (t1 - t0) / count
    trans, u0, known, i = 1.0, 0.0, False, 0
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
            depth = mean_optics(u0, u1, optics)[3] * dt
            if depth > 0.0:
                t -= 0.5 * dt
                k, j, c = _cell(px + t * dx, py + t * dy, pz + t * dz, inv_cell, grid)
                after = trans * math.exp(-depth)
                grid[0, k, j, c] += depth
                grid[1, k, j, c] += trans - after
                grid[2, k, j, c] = max(grid[2, k, j, c], trans)
                trans = after
        u0, known = u1, True
        i += 1


@kernel(
    "Voxels Optics u1:3 f8:2 f8:3 f8:2 i8 f8 f8 f4:5",
    TUPLES,
    parallel=True,
    fastmath=FLAGS,
)
def _march(
    voxels: Voxels, optics: Optics, empty: np.ndarray, eyes: np.ndarray, bases: np.ndarray, lenses: np.ndarray,
    size: int, step: float, inv_cell: float, grids: np.ndarray,
) -> None:  # fmt: skip
    """Rays of all views, dealt over the workers; ``grids`` (workers, 3, cz, cy, cx) float32.

    ``eyes`` (n, 3), ``bases`` (n, 3, 3), ``lenses`` (n, 4) as `camera_arrays` has them; ``size`` px; ``step`` voxels.
    """
    workers = grids.shape[0]
    for worker in nb.prange(workers):
        for job in range(worker, eyes.shape[0] * size, workers):
            view, row = job // size, job % size
            eye, basis, lens = eyes[view], bases[view], lenses[view]
            for col in range(size):
                a, b = (col + 0.5 - lens[2]) * lens[0], (row + 0.5 - lens[3]) * lens[1]
                norm = 1.0 / math.sqrt(a * a + b * b + 1.0)
                dx = (basis[0, 0] * a + basis[1, 0] * b + basis[2, 0]) * norm
                dy = (basis[0, 1] * a + basis[1, 1] * b + basis[2, 1]) * norm
                dz = (basis[0, 2] * a + basis[1, 2] * b + basis[2, 2]) * norm
                _deposit(
                    voxels, optics, empty, eye[0], eye[1], eye[2], dx, dy, dz, step, inv_cell, grids[worker]
                )  # fmt: skip


def _rays_a_cell(scene: Scene, cameras: Sequence[Camera], exponent: int) -> float:
    """How many rays of all views meet a cell near the centre, on average over directions."""
    x, y, z = np.minimum(1 << exponent, scene.values.shape[::-1]) * scene.step
    area = (x * y + y * z + z * x) / 2  # a convex body shows a quarter of its surface
    return float(
        sum(area * camera.fx * camera.fy / max(float(camera.position @ camera.position), 1) for camera in cameras)
    )


def visibility(
    scene: Scene, cameras: Sequence[Camera], step: float = 1.0, progress: Callable[[float], None] | None = None
) -> Visibility:
    """March every camera (square images of one size) and return what is seen of each cell of a grid.

    In a box that is thinner than `THIN` pixels along some axis, a cell that no ray meets counts as seen: a line along
    z lies between two columns of pixels in every view with z upright. ``progress`` is told the share that is done.
    """
    exponent = 0
    while math.prod(-(-n // (1 << exponent)) for n in scene.values.shape) > MAX_CELLS or (
        _rays_a_cell(scene, cameras, exponent) < MIN_RAYS and 1 << exponent < max(scene.values.shape)
    ):
        exponent += 1
    shape = tuple(-(-n // (1 << exponent)) for n in scene.values.shape)
    workers = max(min(WORKERS, MAX_GRID // math.prod(shape)), 1)
    grids = np.zeros((workers, 3, *shape), np.float32)
    voxels, optics = scene.voxels, scene.optics
    for done, camera in enumerate(cameras, 1):
        eye, basis, lens = camera_arrays(scene, camera)
        _march(
            voxels, optics, scene.empty, eye[None], basis[None], lens[None], camera.width, step,
            1.0 / (1 << exponent), grids,
        )  # fmt: skip
        if progress:
            progress(done / len(cameras))
    depth = grids[:, 0].sum(axis=0)
    unmet = np.float32(2 * scene.half.min() < THIN * max(_pixel(camera) for camera in cameras))
    mean = np.divide(grids[:, 1].sum(axis=0), depth, out=np.full(shape, unmet), where=depth > 0)
    return Visibility(np.clip(mean, 0, 1), np.where(depth > 0, grids[:, 2].max(axis=0), unmet), exponent)


def _pixel(camera: Camera) -> float:
    """Width of a pixel at the centre, unit frame."""
    return float(np.linalg.norm(camera.position)) / camera.fx
