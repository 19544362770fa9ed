"""`Layer`, a volume and what colours it, and the optics grid that several of them add up to."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.transfer.function import TransferFunction
from vvgt_cli.transfer.labels import LabelTable
from vvgt_cli.transfer.tables import extinction
from vvgt_cli.volume import Volume
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.types import triple

SAME = 1e-3  # voxels up to which two grids are one
MOST_FINER = 8  # times along an axis that a layer's voxels may refine the first volume's
VOXEL_BYTES = 20  # of a scene: four float32, and extinction once more


@dataclass(frozen=True)
class Layer:
    """A volume under a function, a table of labels, or with colours of its own.

    Attributes:
        volume: scalars, labels, or with ``colors`` what opacity follows from.
        tf: of its data values; with ``colors`` its opacity alone counts.
        unit_distance, unit_label: world length that opacity refers to, and how it was chosen.
        colors: red, green and blue on the same grid; None: ``tf`` gives the colour.
        white: data value of ``colors`` that is 1.
    """

    volume: Volume
    tf: TransferFunction | LabelTable
    unit_distance: float
    unit_label: str = "given"
    colors: tuple[Volume, Volume, Volume] | None = None
    white: float = 1.0

    @property
    def name(self) -> str:
        """Of the volume and what colours it."""
        return f"{self.volume.name} ({self.tf.name})"

    @property
    def interpolated(self) -> bool:
        """Scalars are interpolated before they are classified, labels and colours after."""
        return self.colors is None and isinstance(self.tf, TransferFunction)

    def classify(self, x: np.ndarray) -> np.ndarray:
        """Extinction per world length times (r, g, b, 1) at data values of any shape, (..., 4) float32; 0 at NaN."""
        flat = x.ravel().astype(np.float64)
        known = np.isfinite(flat)
        flat = np.where(known, flat, self.tf.node_range()[0])
        tau = np.where(known, extinction(self.tf.opacity(flat), self.unit_distance), 0.0)
        out = np.empty((flat.size, 4), np.float32)
        out[:, :3] = 1 if self.colors else self.tf.color(flat)
        out[:, :3] *= tau[:, None].astype(np.float32)
        out[:, 3] = tau
        return out.reshape(*x.shape, 4)

    @cached_property
    def _table(self) -> np.ndarray | None:
        """`classify` of every value of an 8- or 16-bit type, by its bits."""
        kind = self.volume.data.dtype.newbyteorder("=")
        if kind.kind not in "iub" or kind.itemsize > 2:
            return None
        bits = np.arange(256**kind.itemsize).astype(f"u{kind.itemsize}")
        stored = bits.astype(np.float64) if kind.kind == "b" else bits.view(kind).astype(np.float64)
        return self.classify(self.volume.slope * stored + self.volume.intercept)

    def slab(self, z: int) -> np.ndarray:
        """The optics of slice ``z`` of its own grid, (ny, nx, 4) float32."""
        volume, stored = self.volume, self.volume.data[z]
        if self._table is not None:
            native = np.ascontiguousarray(stored, stored.dtype.newbyteorder("="))
            out: np.ndarray = self._table[native.view(f"u{native.dtype.itemsize}")]
        else:
            out = self.classify(volume.slope * stored.astype(np.float64) + volume.intercept)
        if self.colors is not None:
            for c, band in enumerate(self.colors):
                value = (band.slope * band.data[z].astype(np.float64) + band.intercept) / self.white
                out[..., c] *= np.clip(np.nan_to_num(value), 0, 1)
        return out


def same_grid(a: Volume, b: Volume) -> bool:
    """Whether two volumes' voxels lie at the same places, to `SAME` voxels."""
    corners = np.array([[0, 0, 0, 1], [*a.dims, 1], [a.dims[0], 0, 0, 1], [0, a.dims[1], 0, 1]], np.float64)
    off = (corners @ (a.affine - b.affine).T)[:, :3]
    return a.dims == b.dims and bool(np.abs(off).max() <= SAME * min(a.spacing))


def common_grid(layers: Sequence[Layer]) -> Volume:
    """The grid that layers add up on: the first one's box, in the finest voxels along each of its axes; no values.

    Raises:
        DataError: a layer that does not meet the first, or more voxels than there is memory for.
    """
    first = layers[0].volume
    finer = np.ones(3, np.int64)
    for layer in layers[1:]:
        if first.reference and layer.volume.reference not in (None, first.reference):
            warnings.warn(
                f"{layer.volume.name}: of another frame of reference (DICOM) than {first.name}: where it lies may not "
                "be right",
                stacklevel=3,
            )
        if same_grid(first, layer.volume):
            continue
        inner = np.linalg.inv(layer.volume.affine) @ first.affine
        _check_meeting(first, layer.volume, inner)
        finer = np.maximum(finer, np.round(np.abs(inner[:3, :3]).max(axis=0) - 1e-6).astype(np.int64))
    if finer.max() > MOST_FINER:
        raise DataError(f"{first.name}: layers with voxels {finer.max()} times finer; expected at most {MOST_FINER}")
    if (finer == 1).all():
        return first
    shape = tuple(int(n * f) for n, f in zip(first.data.shape, finer[::-1], strict=True))
    spacing = triple(float(s / f) for s, f in zip(first.spacing, finer, strict=True))
    check_memory(VOXEL_BYTES * math.prod(shape), first.name)
    origin = tuple((first.affine @ [*((1 / finer - 1) / 2), 1.0])[:3].tolist())
    empty = np.broadcast_to(np.uint8(0), shape)
    return replace(first, data=empty, spacing=spacing, origin=origin, slope=1.0, intercept=0.0)


def _check_meeting(first: Volume, other: Volume, inner: np.ndarray) -> None:
    """Refuse boxes without a common point, by the axes of both."""
    corners = np.array([[x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
    own = corners * [*first.dims, 1] - [0.5, 0.5, 0.5, 0]
    theirs = corners * [*other.dims, 1] - [0.5, 0.5, 0.5, 0]
    for points, box in ((own @ inner.T, other), (theirs @ np.linalg.inv(inner).T, first)):
        low, high = points[:, :3].min(axis=0), points[:, :3].max(axis=0)
        if (high < -0.5).any() or (low > np.array(box.dims) - 0.5).any():
            raise DataError(
                f"{other.name}: lies beside {first.name} in the world, nothing of it within; check that both files "
                "say where they are, in the same space and unit"
            )


def grid_of(layers: Sequence[Layer], target: Volume) -> np.ndarray:
    """What layers add up to on the grid of ``target``: (nz, ny, nx, 4) float32 per world length."""
    from vvgt_cli.dvr.place import place
    from vvgt_cli.dvr.scene import kernel_values

    out = np.zeros((*target.data.shape, 4), np.float32)
    for layer in layers:
        if same_grid(layer.volume, target):
            for z in range(len(out)):
                out[z] += layer.slab(z)
            continue
        matrix = np.ascontiguousarray((np.linalg.inv(layer.volume.affine) @ target.affine)[:3])
        if not layer.interpolated:
            own = np.stack([layer.slab(z) for z in range(len(layer.volume.data))])
            place(own, matrix, 0.0, out)
            continue
        values, slope, intercept = kernel_values(layer.volume)
        scalars = np.zeros((*target.data.shape, 1), np.float32)
        place(np.array(values[..., None], np.float32), matrix, np.nan, scalars)
        for z in range(len(out)):
            out[z] += layer.classify(slope * scalars[z, ..., 0].astype(np.float64) + intercept)
    return out
