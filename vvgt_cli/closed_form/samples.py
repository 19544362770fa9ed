"""How many voxels of a volume are visible, estimated from small bricks of it on a lattice."""

from __future__ import annotations

import math

import numpy as np

from vvgt_cli.dvr.layout import BRICK
from vvgt_cli.dvr.scene import Scene
from vvgt_cli.look.tables import Optics

SAMPLES = 4096  # bricks at most
SAMPLE = 9  # voxels along their edge: eight cubes of eight voxels
Triple = tuple[int, int, int]


def sample_spacing(dims: Triple) -> int:
    """Return the voxels between two bricks."""
    spacing = 16
    while math.prod(-(-n // spacing) for n in dims) > SAMPLES:
        spacing *= 2
    return spacing


def samples_in(dims: Triple, lo: np.ndarray, hi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return first voxels (n, 3) of the bricks from ``lo`` to ``hi`` (3,), and the voxels each represents (n,).

    One lies in the middle of every cube of `sample_spacing` voxels, of which the box holds whole ones; at the volume's
    end it is moved into what is left of the cube, or there is none.
    """
    spacing, axes, weights = sample_spacing(dims), [], []
    for n, a, b in zip(dims, lo, hi, strict=True):
        begin = np.arange(a, b, spacing)
        end = np.minimum(begin + spacing, n)
        first = np.minimum(begin + (spacing - SAMPLE) // 2, np.maximum(end - min(SAMPLE, n), 0))
        fits = (first >= begin) | (n <= SAMPLE)
        axes.append(first[fits])
        weights.append((end - begin)[fits].astype(np.float64))
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    x, y, z = weights
    return places, (x[:, None, None] * y[:, None] * z).ravel()


def visible_share(tables: Optics, values: np.ndarray) -> np.ndarray:
    """Return the share (n,) of the cubes of eight voxels of bricks ``values`` (n, z, y, x) that hold extinction."""
    positive = np.concatenate([[0], np.cumsum(tables.nodes[:, 3] > 0)])
    u = tables.coordinate(values)
    u = np.where(np.isfinite(u), u, 0)
    low, high = u, u
    for axis in (1, 2, 3):  # range over the corners of each cube
        if u.shape[axis] > 1:
            n = low.shape[axis]
            low = np.minimum(np.take(low, range(n - 1), axis), np.take(low, range(1, n), axis))
            high = np.maximum(np.take(high, range(n - 1), axis), np.take(high, range(1, n), axis))
    visible = positive[np.ceil(high).astype(np.int64) + 1] > positive[np.floor(low).astype(np.int64)]
    return visible.mean(axis=(1, 2, 3))


def estimate(shares: np.ndarray, weights: np.ndarray, voxels: int) -> float:
    """Estimate the visible ones of ``voxels``, from bricks' shares (n,) and the voxels (n,) that each represents."""
    return float((shares * weights).sum() / weights.sum() * voxels)


def visible_voxels(scene: Scene) -> float:
    """Estimate how many voxels of a scene in memory have extinction."""
    nx, ny, nz = dims = scene.volume.dims
    places, weights = samples_in(dims, np.zeros(3, np.int64), np.array(dims))
    x, y, z = np.minimum(SAMPLE, dims)
    most = np.array(scene.empty.shape[::-1]) - 1
    first, last = places // BRICK, np.minimum((places + np.array([x - 1, y - 1, z - 1])) // BRICK, most)
    seen = np.zeros(len(places), bool)
    for a in (first[:, 0], last[:, 0]):
        for b in (first[:, 1], last[:, 1]):
            for c in (first[:, 2], last[:, 2]):
                seen |= scene.empty[c, b, a] == 0
    shares = np.zeros(len(places))
    if seen.any():
        bricks = np.stack([scene.values[k : k + z, j : j + y, i : i + x] for i, j, k in places[seen]])
        shares[seen] = visible_share(scene.optics, bricks)
    return estimate(shares, weights, nx * ny * nz)
