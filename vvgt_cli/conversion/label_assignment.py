"""Assignment of the Gaussians of a label map to labels, and cells that no view sees; all in the box frame."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.frames import rotations
from vvgt_cli.look.labels import Label, LabelTable
from vvgt_cli.look.tables import extinction
from vvgt_cli.volume import Volume
from vvgt_cli.volume.stored import planes, values_at

DARKENED = 0.1  # difference of colours that counts as much as a label's colour taken for black
OFFSETS = (-2.0, -1.0, 0.0, 1.0, 2.0)  # standard deviations along each axis at which labels are sampled
REACH = (1, 2, 4)  # voxels from a Gaussian in no label, within which labels are near


@dataclass(frozen=True)
class HiddenCells:
    """Cells that no view sees, nor any of their neighbours.

    Attributes:
        cells: (nz, ny, nx) bool.
        edge: (3,) edges (x, y, z) of a cell in voxels.
        half, step: (3,) half extents and voxel edges of the scene, unit frame.
    """

    cells: np.ndarray
    edge: np.ndarray
    half: np.ndarray
    step: np.ndarray

    def contain(self, gaussians: Gaussians) -> np.ndarray:
        """Return (K,) bool, whether the centre of each Gaussian is hidden."""
        voxels = (gaussians.means.astype(np.float64) + self.half) / self.step
        i, j, k = (self._along(axis, voxels[:, axis]) for axis in range(3))
        hidden: np.ndarray = self.cells[k, j, i]
        return hidden

    def meet_label(self, volume: Volume, number: int) -> bool:
        """Return whether part of a label's surface, where it meets other labels or the box, is hidden."""
        middles = [np.arange(n) + 0.5 for n in volume.dims]
        x, y, z = (self._along(axis, middles[axis]) for axis in range(3))
        none = np.zeros(volume.data.shape[1:], bool)
        stored = (volume.slope * plane.astype(np.float64) + volume.intercept == number for plane in planes(volume))
        before, here = none, next(stored)
        for k in range(len(volume.data)):
            after = next(stored, none)
            inside = here & before & after
            inside[1:] &= here[:-1]
            inside[:-1] &= here[1:]
            inside[:, 1:] &= here[:, :-1]
            inside[:, :-1] &= here[:, 1:]
            inside[[0, -1]] = inside[:, [0, -1]] = False
            if (here & ~inside & self.cells[z[k]][y][:, x]).any():
                return True
            before, here = here, after
        return False

    def _along(self, axis: int, voxels: np.ndarray) -> np.ndarray:
        """Return (n,) int64, the cell along an axis of positions in voxels from the box's corner."""
        n = self.cells.shape[2 - axis]
        cells: np.ndarray = np.clip(np.floor(voxels / self.edge[axis]), 0, n - 1).astype(np.int64)
        return cells


def hidden_cells(near: np.ndarray, edge: np.ndarray, half: np.ndarray, step: np.ndarray) -> HiddenCells:
    """Return the cells that no training view sees.

    Args:
        near: (nz, ny, nx) bool, the cells that some view sees.
        edge: see `HiddenCells`.
        half: see `HiddenCells`.
        step: see `HiddenCells`.
    """
    for axis in range(3):
        wider = near.copy()
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        wider[tuple(ahead)] |= near[tuple(behind)]
        wider[tuple(behind)] |= near[tuple(ahead)]
        near = wider
    return HiddenCells(~near, edge, half, step)


def assign_labels(gaussians: Gaussians, shown: Sequence[tuple[Volume, LabelTable, Label]]) -> np.ndarray:
    """Return (K,) int64, the index of the label with most of each Gaussian's extinction, else a near one, by colour.

    Args:
        gaussians: box frame.
        shown: labels with their maps and tables; all maps are on one grid.
    """
    frame = shown[0][0].unit_frame()
    votes = np.zeros((len(gaussians), len(shown)), np.float32)
    tau = extinction(np.array([label.opacity for *_, label in shown]), 1.0)
    axes = rotations(gaussians.quaternions) * np.exp(gaussians.log_scales.astype(np.float64))[:, None, :]  # columns
    for axis in range(3):
        for offset in OFFSETS:
            points = gaussians.means + offset * axes[:, :, axis]
            index = np.floor((points + frame.half) / frame.step).astype(np.int64)
            _vote(index, np.exp(-0.5 * offset**2) * tau, shown, votes)
    labels: np.ndarray = votes.argmax(axis=1)
    lost = np.flatnonzero(votes.max(axis=1) == 0)
    near = _near(np.floor((gaussians.means[lost] + frame.half) / frame.step).astype(np.int64), tau, shown)
    colors = np.array([label.color for *_, label in shown])
    for k, candidates in zip(lost, near, strict=True):
        own = gaussians.colors[k]
        share = np.clip(colors @ own / np.maximum((colors**2).sum(axis=1), 1e-6), 0, 1)  # light darkens
        distance = np.abs(share[:, None] * colors - own).sum(axis=1) + DARKENED * (1 - share)
        labels[k] = np.where(candidates, distance, np.inf).argmin()
    return labels


def _near(index: np.ndarray, weights: np.ndarray, shown: Sequence[tuple[Volume, LabelTable, Label]]) -> np.ndarray:
    """Return (K, labels) bool, the labels near voxels ``index`` (K, 3) (x, y, z); all where none is within `REACH`."""
    nearby = np.zeros((len(index), len(shown)), np.float32)
    for reach in REACH:
        rows = np.flatnonzero(nearby.max(axis=1) == 0)
        votes = np.zeros((len(rows), len(shown)), np.float32)
        shifts = np.array(list(itertools.product((-reach, 0, reach), repeat=3)))
        around = (index[rows][:, None] + shifts).reshape(-1, 3)  # in one pass over a map that stays in its file
        _vote(around, weights, shown, votes, np.repeat(np.arange(len(rows)), len(shifts)))
        nearby[rows] = votes
    near: np.ndarray = (nearby > 0) | (nearby.max(axis=1, keepdims=True) == 0)
    return near


def _vote(
    index: np.ndarray, weights: np.ndarray, shown: Sequence[tuple[Volume, LabelTable, Label]], votes: np.ndarray,
    owner: np.ndarray | None = None,
) -> None:  # fmt: skip
    """Add the ``weights`` (labels,) of the labels of voxels ``index`` (K, 3) (x, y, z) to ``votes`` (K, labels).

    With ``owner`` (K,), each counts in that row instead, once for several voxels of a label.
    """
    maps = {id(volume): volume for volume, *_ in shown}
    dims = np.array(shown[0][0].dims)
    rows = np.flatnonzero(((index >= 0) & (index < dims)).all(axis=1))
    for key, volume in maps.items():
        values = values_at(volume, index[rows])
        own = [(label.number, k) for k, (other, _, label) in enumerate(shown) if id(other) == key]
        numbers, columns = (np.array(part) for part in zip(*sorted(own), strict=True))
        at = np.minimum(np.searchsorted(numbers, values), len(numbers) - 1)
        there = numbers[at] == values
        row = rows[there] if owner is None else owner[rows[there]]
        votes[row, columns[at[there]]] += weights[columns[at[there]]].astype(np.float32)
