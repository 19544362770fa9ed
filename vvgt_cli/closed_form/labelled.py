"""Assign each Gaussian to a label, and find which way the label ends, by samples at its points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vvgt_cli.closed_form.gaussian_samples import NARROW, in_voxels, offsets
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.frames import rotations
from vvgt_cli.volume import Volume
from vvgt_cli.volume.stored import values_at

WIDE = 1.5  # standard deviations of the points that say where a label ends
CHUNK = 1 << 14  # Gaussians whose points are looked up at once


def labels_and_gradients(
    gaussians: Gaussians, maps: Sequence[tuple[Volume, Sequence[int]]], half: np.ndarray, step: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (K,) int64 of the labels that most points of each Gaussian lie in, -1 for none, and gradients (K, 3).

    Args:
        gaussians: box frame.
        maps: label maps on one grid, each with the numbers of its labels, ascending; rows count through all of them.
        half: (3,) half extents of the grid, unit frame.
        step: (3,) voxel edges of the grid, unit frame.

    Returns:
        Rows; and unit vectors of the box frame along which the share of the label rises, by least squares; zeros
        within a label.
    """
    assigned, gradient = np.empty(len(gaussians), np.int64), np.zeros((len(gaussians), 3))
    for k in range(0, len(gaussians), CHUNK):
        part = gaussians.take(np.arange(k, min(k + CHUNK, len(gaussians))))
        assigned[k : k + CHUNK] = _label_assignment(_rows(part, maps, half, step, NARROW))
        own = _rows(part, maps, half, step, WIDE) == assigned[None, k : k + CHUNK, None]
        gradient[k : k + CHUNK] = _gradients(part, own.any(axis=0).astype(np.float64))
    return assigned, gradient


def _rows(
    gaussians: Gaussians, maps: Sequence[tuple[Volume, Sequence[int]]], half: np.ndarray, step: np.ndarray, wide: float
) -> np.ndarray:
    """Return (maps, K, points) int64 rows of the labels at points of ``wide`` standard deviations, -1 for none."""
    centres, arms = in_voxels(gaussians, half, step)
    points = centres[:, None, :] + np.einsum("kij,mj->kmi", arms, offsets() * (wide / NARROW))
    index = np.rint(points).astype(np.int64)
    inside = ((index >= 0) & (index < np.array(maps[0][0].dims))).all(axis=2)
    rows, first = np.full((len(maps), *inside.shape), -1, np.int64), 0
    for layer, (volume, numbers) in enumerate(maps):
        values, known = values_at(volume, index[inside]), np.asarray(numbers, np.float64)
        at = np.minimum(np.searchsorted(known, values), len(known) - 1)
        rows[layer][inside] = np.where(known[at] == values, first + at, -1)
        first += len(known)
    return rows


def _label_assignment(rows: np.ndarray) -> np.ndarray:
    """Return (K,) the row that comes most often among (maps, K, points), -1 where there is none."""
    every = np.sort(rows.transpose(1, 0, 2).reshape(rows.shape[1], -1), axis=1)
    best, most = np.full(len(every), -1, np.int64), np.zeros(len(every), np.int64)
    run = np.zeros(len(every), np.int64)
    for m in range(every.shape[1]):
        same = every[:, m] == every[:, m - 1] if m else np.zeros(len(every), bool)
        run = np.where(same, run + 1, 1)
        better = (run > most) & (every[:, m] >= 0)
        best[better], most[better] = every[better, m], run[better]
    return best


def _gradients(gaussians: Gaussians, own: np.ndarray) -> np.ndarray:
    """Return (K, 3) unit vectors along which values ``own`` (K, points) of `offsets` rise; zeros where they do not."""
    points = offsets()
    rise = (own - own.mean(axis=1, keepdims=True)) @ points @ np.linalg.inv(points.T @ points)
    axes = rotations(gaussians.quaternions.astype(np.float64))
    gradients = np.einsum("kij,kj->ki", axes, rise / np.exp(gaussians.log_scales.astype(np.float64)))
    length = np.linalg.norm(gradients, axis=1, keepdims=True)
    result: np.ndarray = gradients / np.where(length > 1e-9, length, np.inf)
    return result
