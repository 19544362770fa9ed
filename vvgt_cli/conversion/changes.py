"""Differences between two frames of a series: blocks of voxels, and the Gaussians and pixels that meet them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vvgt_cli.cameras import BLOCK, Camera
from vvgt_cli.dvr.layers import Layer
from vvgt_cli.field.source import StyledVolume
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.frames import axes_of
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.volume import Statistics, Volume
from vvgt_cli.volume.stored import read_block

EDGE = 4  # voxels along the edge of a block
AT_ONCE = 1 << 23  # voxels that are compared at once, or `EDGE` slices: about 80 bytes each
SAME = 1e-5  # share of the range of values: less than half a level of 255 after hundreds of frames
BINS = 4096  # bins of the range of values, each visible or not
REACH = 2.0  # standard deviations within which a Gaussian meets a block


@dataclass(frozen=True)
class Changes:
    """Blocks of `EDGE` voxels along each edge that differ between two frames, from the box's corner.

    Attributes:
        blocks: (nz, ny, nx) bool, whether a block may look different.
        half, edge: (3,) half extents of the box, and edges of a block, box frame.
    """

    blocks: np.ndarray
    half: np.ndarray
    edge: np.ndarray

    def meet(self, gaussians: Gaussians) -> np.ndarray:
        """Return (K,) bool, whether the bounding boxes of Gaussians (box frame) reach into a block that differs."""
        reach = REACH * np.sqrt((axes_of(gaussians) ** 2).sum(axis=2))
        most = np.array(self.blocks.shape[::-1])
        low = np.floor((gaussians.means - reach + self.half) / self.edge).astype(np.int64)
        high = np.floor((gaussians.means + reach + self.half) / self.edge).astype(np.int64) + 1
        low, high = np.clip(low, 0, most), np.clip(high, 0, most)
        sums = np.zeros(np.array(self.blocks.shape) + 1, np.int64)
        sums[1:, 1:, 1:] = self.blocks.cumsum(0).cumsum(1).cumsum(2)
        differing = np.zeros(len(gaussians), np.int64)
        for corner in range(8):
            x, y, z = (np.where(corner >> axis & 1, high[:, axis], low[:, axis]) for axis in range(3))
            differing += (1 if corner in (1, 2, 4, 7) else -1) * sums[z, y, x]
        return differing > 0

    def seen_by(self, camera: Camera) -> np.ndarray:
        """Return (rows, columns) bool, the blocks of pixels, from the upper left corner, that show a difference."""
        shown = np.zeros((-(-camera.height // BLOCK), -(-camera.width // BLOCK)), bool)
        if not self.blocks.any():
            return shown
        centres = (np.argwhere(self.blocks)[:, ::-1] + 0.5) * self.edge - self.half
        x, y, z = camera.rotation @ centres.T + camera.translation[:, None]
        around = 0.5 * float(np.linalg.norm(self.edge))
        if (z <= 2 * around).any():  # the camera is in the box
            return np.ones_like(shown)
        radius = max(camera.fx, camera.fy) * around / (z - around) + 1
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        left, right = (np.floor((u + side * radius) / BLOCK).astype(np.int64) for side in (-1, 1))
        top, bottom = (np.floor((v + side * radius) / BLOCK).astype(np.int64) for side in (-1, 1))
        for dy in range(int((bottom - top).max()) + 1):
            for dx in range(int((right - left).max()) + 1):
                row, column = np.minimum(top + dy, bottom), np.minimum(left + dx, right)
                inside = (row >= 0) & (row < shown.shape[0]) & (column >= 0) & (column < shown.shape[1])
                shown[row[inside], column[inside]] = True
        return shown


def changes(before: StyledVolume, after: StyledVolume) -> Changes:
    """Compare two frames on one grid under one function, slab by slab."""
    volume = after.volume
    dims = np.array(volume.dims)
    blocks = np.zeros(tuple(-(-dims[::-1] // EDGE)), bool)
    reach = 1 if after.lighting is None else 2  # values are interpolated, and normals their differences
    for z0, z1, changed in _slabs(before, after, reach):
        grown = np.zeros(tuple(-(-np.array(changed.shape) // EDGE) * EDGE), bool)
        grown[tuple(slice(0, n) for n in changed.shape)] = changed
        each = grown.reshape(grown.shape[0] // EDGE, EDGE, grown.shape[1] // EDGE, EDGE, -1, EDGE)
        blocks[z0 // EDGE : -(-z1 // EDGE)] = each.any(axis=(1, 3, 5))
    step = np.array(volume.spacing) * volume.unit_frame().scale
    return Changes(blocks, dims * step / 2, EDGE * step)


def _slabs(before: StyledVolume, after: StyledVolume, reach: int) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield the first and last slice of each slab, and (z, y, x) bool, the voxels near a difference."""
    dims = after.volume.dims
    ranges = [*after.series, *[after.overall] * len(after.layers)]  # of a frame's layers those of the whole series
    slab = max(AT_ONCE // (dims[0] * dims[1]) // EDGE, 1) * EDGE
    for z0 in range(0, dims[2], slab):
        z1 = min(z0 + slab, dims[2])
        low, high = max(z0 - reach - 1, 0), min(z1 + reach + 1, dims[2])
        changed = np.zeros((high - low, dims[1], dims[0]), bool)
        for old, new, stats in zip(before.layers, after.layers, ranges, strict=False):
            if new.volume.dims == dims:  # layers on other grids are the same file in all frames
                changed |= _differ(old, new, stats, low, high)
        for _ in range(reach):
            changed = around(changed, np.maximum)
        yield z0, z1, changed[z0 - low : z1 - low]


def _differ(old: Layer, new: Layer, over: Statistics, low: int, high: int) -> np.ndarray:
    """Return (z, y, x) bool of slices ``low`` to ``high``: whether a layer looks different at or around a voxel."""
    if new.colors is not None:
        assert old.colors is not None
        pairs = zip((old.volume, *old.colors), (new.volume, *new.colors), strict=True)
        return np.any([_slices(a, low, high) != _slices(b, low, high) for a, b in pairs], axis=0)
    first, second = (_slices(volume, low, high) for volume in (old.volume, new.volume))
    changed: np.ndarray
    if not isinstance(new.tf, TransferFunction):  # labels: optics at voxels
        changed = first != second
        looks = [
            np.column_stack([layer.tf.color(x), layer.tf.opacity(x)])
            for layer, x in ((old, _data(old.volume, first[changed])), (new, _data(new.volume, second[changed])))
        ]
        visible = (looks[0][:, 3] > 0) | (looks[1][:, 3] > 0)
        changed[changed] = visible & (looks[0] != looks[1]).any(axis=1)
        return changed
    lo, hi = over.lo, over.hi
    a, b = _data(old.volume, first), _data(new.volume, second)
    same: np.ndarray = (a == b) | (np.abs(a - b) <= SAME * (hi - lo)) | (np.isnan(a) & np.isnan(b))
    if not same.all():
        least, most = around(np.fmin(a, b), np.fmin), around(np.fmax(a, b), np.fmax)
        same |= ~_visible(new.tf, lo, hi, least, most)
    changed = ~same
    return changed


def _visible(tf: TransferFunction, lo: float, hi: float, least: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Return bool per voxel, whether a function shows anything between ``least`` and ``most``."""
    scale = BINS / (hi - lo) if hi > lo else 0.0
    marks = np.zeros(BINS + 2, np.int64)
    for begin, end in tf.support(lo, hi):
        first, last = (int(np.clip((x - lo) * scale, 0, BINS)) for x in (begin, end))
        marks[max(first - 1, 0) : last + 2] = 1
    before = np.concatenate([[0], marks.cumsum()])
    rows = [np.nan_to_num(np.clip((x - lo) * scale, 0, BINS)).astype(np.int64) for x in (least, most)]
    return before[rows[1] + 1] > before[rows[0]]


def _slices(volume: Volume, low: int, high: int) -> np.ndarray:
    return read_block(volume, np.array([0, 0, low]), np.array([*volume.dims[:2], high]))


def _data(volume: Volume, stored: np.ndarray) -> np.ndarray:
    return stored * np.float64(volume.slope) + volume.intercept


def around(values: np.ndarray, take: np.ufunc) -> np.ndarray:
    """Apply ``take``, a maximum or minimum, to each voxel and its 26 neighbours."""
    for axis in range(3):
        out = values.copy()
        view, old = np.moveaxis(out, axis, 0), np.moveaxis(values, axis, 0)
        take(view[1:], old[:-1], out=view[1:])
        take(view[:-1], old[1:], out=view[:-1])
        values = out
    return values
