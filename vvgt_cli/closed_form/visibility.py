"""Visibility of each cell from the cameras: a march through the cells' extinction that adds up what is seen."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numba as nb
import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.closed_form.cell_kernels import look_up
from vvgt_cli.closed_form.columns import MASS
from vvgt_cli.closed_form.moments import Cells
from vvgt_cli.dvr.kernel import FLAGS, absorbed
from vvgt_cli.dvr.render import BoxFrame, camera_arrays
from vvgt_cli.dvr.scene import Scene
from vvgt_cli.dvr.vectors import Vector
from vvgt_cli.jit.decorators import inlined, kernel, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations

MAX_CELLS = 1 << 21
MIN_RAYS = 8  # that meet a cell: with fewer, some cells are met by none and count as hidden
WORKERS = 4  # each with sums of its own, so that they need no atomics; whatever the threads, for the same bytes
THIN = 2.0  # pixels of the march: all of a box that is thinner may lie between two rays
U = nb.uint64  # indices that cannot be negative need no test
DEPTH, SEEN, LARGEST = 0, 1, 2  # of a cell's sums over rays: optical depth, its seen part, largest transmittance


@dataclass(frozen=True)
class Visibility:
    """Transmittance with which a cell's extinction is seen.

    Attributes:
        mean: (nz, ny, nx) float32 seen part of the optical depth, averaged over views and rays: in [0, 1].
        largest: (nz, ny, nx) float32 largest transmittance with which a ray enters the cell, 0 without extinction.
        edge: (3,) cell edges in voxels (x, y, z).
    """

    mean: np.ndarray
    largest: np.ndarray
    edge: np.ndarray

    def at(self, index: np.ndarray, edge: np.ndarray) -> np.ndarray:
        """Return mean and largest transmittance (n, 2) of cells ``index`` (n, 3) int32 (x, y, z), edges in voxels."""
        out = np.empty((len(index), 2), np.float32)
        look_up(np.ascontiguousarray(index, np.int32), edge / self.edge, self.mean, self.largest, out)
        return out

    def at_least(self, share: float) -> Visibility:
        """Return the same with nothing hidden altogether: transmittances from ``share`` to 1."""
        low, rest = np.float32(share), np.float32(1 - share)
        return Visibility(low + rest * self.mean, low + rest * self.largest, self.edge)


@inlined(fastmath=FLAGS, error_model="numpy")
def _axis(p: float, d: float, t: float, n: int) -> tuple[int, int, float, float]:
    """Return the cell of ``p + t d`` along an axis of ``n``, the direction, where the next begins, its length."""
    i = min(max(math.floor(p + t * d), 0), n - 1)
    if d > 0.0:
        return i, 1, (i + 1 - p) / d, 1 / d
    if d < 0.0:
        return i, -1, (i - p) / d, -1 / d
    return i, 0, np.inf, np.inf


@inlined(fastmath=FLAGS, error_model="numpy")
def _span(p: Vector, d: Vector, n: tuple[int, int, int]) -> tuple[float, float]:
    """Return entry and exit t >= 0 of a ray through the box [0, n]; entry >= exit: missed."""
    t0, t1 = 0.0, np.inf
    for axis in range(3):
        a, b, m = p[axis], d[axis], n[axis]
        if b == 0.0:
            if a < 0.0 or a > m:
                return 1.0, 0.0
        else:
            u, v = -a / b, (m - a) / b
            t0, t1 = max(t0, min(u, v)), min(t1, max(u, v))
    return t0, t1


@inlined(fastmath=FLAGS, error_model="numpy")
def _deposit(extinction: np.ndarray, p: Vector, d: Vector, sums: np.ndarray) -> None:
    """Traverse cells along p + t d and add to ``sums`` (nz, ny, nx, 3).

    p, d (x, y, z) in cells from the box's corner, t in unit-frame lengths as ``extinction`` (nz, ny, nx) is per. What
    lies behind an opaque front adds to the depth only: it is there, and not seen.
    """
    nz, ny, nx = extinction.shape
    t, end = _span(p, d, (nx, ny, nz))
    if not end > t:
        return
    i, step_i, next_i, length_i = _axis(p[0], d[0], t, nx)
    j, step_j, next_j, length_j = _axis(p[1], d[1], t, ny)
    k, step_k, next_k, length_k = _axis(p[2], d[2], t, nz)
    trans = 1.0
    while True:
        ahead = max(min(next_i, next_j, next_k, end), t)
        tau = extinction[U(k), U(j), U(i)]
        if tau > 0.0:
            depth = tau * (ahead - t)
            lost = trans * depth * absorbed(depth)
            cell = sums[U(k), U(j), U(i)]
            cell[DEPTH] += depth
            cell[SEEN] += lost
            cell[LARGEST] = max(cell[LARGEST], trans)
            trans -= lost
        t = ahead
        if next_i <= next_j and next_i <= next_k:
            i, next_i = i + step_i, next_i + length_i
        elif next_j <= next_k:
            j, next_j = j + step_j, next_j + length_j
        else:
            k, next_k = k + step_k, next_k + length_k
        if t >= end or i < 0 or j < 0 or k < 0 or i >= nx or j >= ny or k >= nz:
            return


@parallel_kernel("f4:3 f8:2 f8:3 f8:2 i8 f8:1 f4:5", fastmath=FLAGS, error_model="numpy")
def march(
    thread: ThreadSlice,
    extinction: np.ndarray,
    eyes: np.ndarray,
    bases: np.ndarray,
    lenses: np.ndarray,
    size: int,
    edge: np.ndarray,
    sums: np.ndarray,
) -> None:
    """March rays of all views, dealt over the workers; ``sums`` (workers, nz, ny, nx, 3) float32.

    ``eyes`` (n, 3), ``bases`` (n, 3, 3), ``lenses`` (n, 4) as `camera_arrays` has them; ``size`` px; ``edge`` (3,) of
    a cell in voxels.
    """
    workers = sums.shape[0]
    for worker in iterations(thread, workers):
        for job in range(worker, eyes.shape[0] * size, workers):
            view, row = job // size, job % size
            eye, basis, lens = eyes[view], bases[view], lenses[view]
            p = (eye[0] + 0.5) / edge[0], (eye[1] + 0.5) / edge[1], (eye[2] + 0.5) / edge[2]
            for col in range(size):
                a, b = (col + 0.5 - lens[2]) * lens[0], (row + 0.5 - lens[3]) * lens[1]
                norm = 1.0 / math.sqrt(a * a + b * b + 1.0)
                d = (
                    (basis[0, 0] * a + basis[1, 0] * b + basis[2, 0]) * norm / edge[0],
                    (basis[0, 1] * a + basis[1, 1] * b + basis[2, 1]) * norm / edge[1],
                    (basis[0, 2] * a + basis[1, 2] * b + basis[2, 2]) * norm / edge[2],
                )
                _deposit(extinction, p, d, sums[worker])


def _rays_a_cell(edge: np.ndarray, cameras: Sequence[Camera]) -> float:
    """Return how many rays of all views meet a cell near the centre, on average; ``edge`` (3,) unit frame."""
    x, y, z = edge
    area = (x * y + y * z + z * x) / 2  # a convex body shows a quarter of its surface
    return float(
        sum(area * camera.fx * camera.fy / max(float(camera.position @ camera.position), 1) for camera in cameras)
    )


def _mean_extinction(cells: Cells, scene: Scene | BoxFrame, wider: int) -> np.ndarray:
    """Return (nz, ny, nx) float32 mean extinction of cells ``2^wider`` times as wide as ``cells`` along each axis."""
    edge = 2.0 ** (cells.exponent + wider)
    shape = np.ceil(voxels_of(scene) / edge).astype(np.int64)
    mass = summed(cells.index, cells.moments[:, MASS], wider, shape)
    return (mass / (edge * scene.step).prod()).astype(np.float32)


def voxels_of(box: Scene | BoxFrame) -> np.ndarray:
    """Return the voxels (3,) along x, y, z of a box."""
    return np.round(2 * np.asarray(box.half) / np.asarray(box.step))


@kernel("i4:2 f8:1 i8 f8:3")
def add_cells(index: np.ndarray, values: np.ndarray, wider: int, out: np.ndarray) -> None:
    """Add ``values`` (n,), each at ``index`` (n, 3), x first, in cells 2^``wider`` as wide, to ``out`` (nz, ny, nx)."""
    for i in range(len(values)):
        out[index[i, 2] >> wider, index[i, 1] >> wider, index[i, 0] >> wider] += values[i]


def summed(index: np.ndarray, values: np.ndarray, wider: int, shape: np.ndarray) -> np.ndarray:
    """Sum ``values`` (n,), in order, by cell 2^``wider`` times as wide as those of ``index`` (n, 3): (nz, ny, nx).

    ``index`` and ``shape`` (3,) of the wider ones are x first.
    """
    if (index.max(axis=0, initial=0) >> wider >= shape).any():
        raise ValueError(f"cells up to {index.max(axis=0) >> wider} in a grid of {shape}")
    out = np.zeros(shape[::-1])
    add_cells(np.ascontiguousarray(index, np.int32), np.ascontiguousarray(values, np.float64), wider, out)
    return out


def visibility(
    scene: Scene | BoxFrame, cells: Cells, cameras: Sequence[Camera], progress: Callable[[float], None] | None = None
) -> Visibility:
    """March every camera (square images of one size) through the mean extinction of cells: what is seen of each.

    The cells are ``cells``, or wider by a power of two where these are too many or meet too few rays. ``progress`` is
    called with the completed share.
    """
    wider = widening(voxels_of(scene), cells.exponent, scene.step, cameras)
    extinction = _mean_extinction(cells, scene, wider)
    return march_views(extinction, 2.0 ** (cells.exponent + wider), scene, cameras, progress)


def widening(dims: np.ndarray, exponent: np.ndarray, step: np.ndarray, cameras: Sequence[Camera]) -> int:
    """Return the exponent of two by which the march's cells are wider than those of 2^``exponent`` (3,) voxels.

    ``dims`` (3,) voxels and ``step`` (3,) their edges in the unit frame, (x, y, z).
    """
    wider = 0

    def edge() -> np.ndarray:
        return np.minimum(2.0 ** (exponent + wider), dims)

    while np.ceil(dims / edge()).prod() > MAX_CELLS or (
        _rays_a_cell(edge() * step, cameras) < MIN_RAYS and (edge() < dims).any()
    ):
        wider += 1
    return wider


def march_views(
    extinction: np.ndarray,
    voxels: np.ndarray,
    scene: Scene | BoxFrame,
    cameras: Sequence[Camera],
    progress: Callable[[float], None] | None = None,
) -> Visibility:
    """March what cameras see through ``extinction`` (nz, ny, nx) float32, mean over cells of ``voxels`` (3,) voxels.

    In a box that is thinner than `THIN` pixels along some axis, a cell that no ray meets counts as seen: a line along z
    lies between two columns of pixels in every view with z upright.
    """
    sums = np.zeros((WORKERS, *extinction.shape, 3), np.float32)
    for done, camera in enumerate(cameras, 1):
        eye, basis, lens = camera_arrays(scene, camera)
        march(extinction, eye[None], basis[None], lens[None], camera.width, voxels, sums)
        if progress:
            progress(done / len(cameras))
    depth = sums[..., DEPTH].sum(axis=0)
    pixel = max(float(np.linalg.norm(camera.position)) / camera.fx for camera in cameras)  # its width at the centre
    unmet = np.float32(2 * scene.half.min() < THIN * pixel)
    mean = np.divide(sums[..., SEEN].sum(axis=0), depth, out=np.full(depth.shape, unmet), where=depth > 0)
    largest = np.where(depth > 0, sums[..., LARGEST].max(axis=0), unmet)
    return Visibility(np.clip(mean, 0, 1), largest, voxels)
