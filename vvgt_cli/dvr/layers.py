"""`Layer`, a volume and what colours it, and the optics grid that several of them add up to."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from vvgt_cli.dvr.layout import Mixture, Texels
from vvgt_cli.errors import DataError
from vvgt_cli.look import LabelTable, TransferFunction
from vvgt_cli.look.tables import Optics, build_tables, extinction
from vvgt_cli.volume import Volume, triple
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.stored import read_block

SLAB = 16  # slices that are laid out at once
MAX_SCALARS = 7  # layers that rays classify: `march` has room for so many; others are classified at voxels
FARTHEST = 1e30  # largest coordinate in a table, so that all are finite
MAX_FINER = 8  # times along an axis that a layer's voxels may refine the first volume's
VOXEL_BYTES = 24  # of a scene: four float32, and extinction again, of labels under light also smoothed


@dataclass(frozen=True)
class Layer:
    """A volume under a function, a table of labels, or with colours of its own.

    Attributes:
        volume: scalars, labels, or with ``colors`` what opacity follows from.
        tf: of its data values; with ``colors`` its opacity alone counts.
        unit_distance, unit_label: world length that opacity refers to, and how it was chosen.
        colors: red, green and blue on the same grid; None: ``tf`` gives the colour.
        white: data value of ``colors`` that is 1.
        shows: something of it is visible, as far as the range of its values tells.
    """

    volume: Volume
    tf: TransferFunction | LabelTable
    unit_distance: float
    unit_label: str = "given"
    colors: tuple[Volume, Volume, Volume] | None = None
    white: float = 1.0
    shows: bool = True

    @property
    def name(self) -> str:
        """Name of the volume and of the function that colours it."""
        return f"{self.volume.name} ({self.tf.name})"

    @property
    def interpolated(self) -> bool:
        """Scalars are interpolated before they are classified, labels and colours after."""
        return self.colors is None and isinstance(self.tf, TransferFunction)

    def classify(self, x: np.ndarray) -> np.ndarray:
        """Return extinction per world length times (r, g, b, 1) at values of any shape, (..., 4) float32; 0 at NaN."""
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

    def box(self, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
        """Return the optics of voxels ``lo`` to ``hi`` (3,) of the layer's own grid, x first: (z, y, x, 4) float32."""
        volume, stored = self.volume, read_block(self.volume, lo, hi)
        if self._table is not None:
            out: np.ndarray = self._table[stored.view(f"u{stored.dtype.itemsize}")]
        else:
            out = self.classify(volume.slope * stored.astype(np.float64) + volume.intercept)
        for c, band in enumerate(self.colors or ()):
            value = (band.slope * read_block(band, lo, hi).astype(np.float64) + band.intercept) / self.white
            out[..., c] *= np.clip(np.nan_to_num(value), 0, 1)
        return out

    @property
    def largest(self) -> float:
        """No extinction of it per world length is above this."""
        return float(extinction(np.array(1.0), self.unit_distance))


def common_grid(layers: Sequence[Layer], stored: bool = False) -> Volume:
    """Return the grid on which layers are added: the first one's box, the finest voxels along each axis; no values.

    Where layers are ``stored`` it is never there as a whole.

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
        if layer.volume.on_grid(first):
            continue
        inner = np.linalg.inv(layer.volume.affine) @ first.affine
        _check_meeting(first, layer.volume, inner)
        finer = np.maximum(finer, np.round(np.abs(inner[:3, :3]).max(axis=0) - 1e-6).astype(np.int64))
    if finer.max() > MAX_FINER:
        raise DataError(f"{first.name}: layers with voxels {finer.max()} times finer; expected at most {MAX_FINER}")
    if (finer == 1).all():
        return first
    shape = tuple(int(n * f) for n, f in zip(first.data.shape, finer[::-1], strict=True))
    spacing = triple(float(s / f) for s, f in zip(first.spacing, finer, strict=True))
    if not stored:
        inner = len(scalar_layers(layers))
        mixed = 4 * inner + 16 * bool(inner and _others(layers))
        check_memory((VOXEL_BYTES + mixed) * math.prod(shape), first.name)
    origin = tuple((first.affine @ [*((1 / finer - 1) / 2), 1.0])[:3].tolist())
    empty = np.broadcast_to(np.uint8(0), shape)
    return replace(first, data=empty, spacing=spacing, origin=origin, slope=1.0, intercept=0.0)


def _check_meeting(first: Volume, other: Volume, inner: np.ndarray) -> None:
    """Reject boxes without a common point, naming the axes of both."""
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
    """Add up layers on the grid of ``target``: (nz, ny, nx, 4) float32 per world length."""
    nx, ny, nz = target.dims
    out = np.zeros((nz, ny, nx, 4), np.float32)
    for z in range(0, nz, SLAB):
        end = min(z + SLAB, nz)
        out[z:end] = grid_box(layers, target, np.array([0, 0, z]), np.array([nx, ny, end]))
    return out


def grid_box(layers: Sequence[Layer], target: Volume, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Return `grid_of` for its voxels ``lo`` to ``hi`` (3,), x first: the same values whatever the box."""
    out = np.zeros((*(hi - lo)[::-1], 4), np.float32)
    for layer in layers:
        if layer.volume.on_grid(target):
            out += layer.box(lo, hi)
        elif layer.interpolated:
            out += layer.classify(_values_in(layer, target, lo, hi))
        else:
            out += _placed(layer, target, lo, hi, layer.box, 0.0).astype(np.float32)
    return out


def mixture_box(
    layers: Sequence[Layer], tables: Sequence[Optics], target: Volume, lo: np.ndarray, hi: np.ndarray,
    texels: np.ndarray, per_unit: float,
) -> Mixture:  # fmt: skip
    """Return voxels ``lo`` to ``hi`` (3,) of ``target``, x first, as rays meet them.

    ``tables``: `scalar_tables` of the layers; ``texels``: their `grid_box` per unit-frame length; ``per_unit``: world
    lengths per unit-frame length.
    """
    if not tables:
        return Mixture(Texels(texels).values)
    inner, others = scalar_layers(layers), _others(layers)
    out = np.empty((len(inner), *texels.shape[:3]), np.float32)
    for layer, own, values in zip(inner, tables, out, strict=True):
        for z in range(0, len(values), SLAB):
            first, end = np.array([*lo[:2], lo[2] + z]), np.array([*hi[:2], min(lo[2] + z + SLAB, hi[2])])
            places = (_values_in(layer, target, first, end, rim=0.5) - own.lo) * own.inv_width
            values[z : z + SLAB] = np.where(np.isfinite(places), np.clip(places, -FARTHEST, FARTHEST), np.nan)
    rest = grid_box(others, target, lo, hi) if others else np.zeros((1, 1, 1, 4), np.float32)
    rest *= np.float32(per_unit)
    return Mixture.of(rest, out, tables)


def scalar_layers(layers: Sequence[Layer]) -> list[Layer]:
    """Return the layers that rays interpolate before they classify them."""
    return [layer for layer in layers if layer.interpolated][:MAX_SCALARS]


def _others(layers: Sequence[Layer]) -> list[Layer]:
    """Return the layers that are classified at voxels."""
    inner = scalar_layers(layers)
    return [layer for layer in layers if all(layer is not one for one in inner)]


def smooth_labels(layers: Sequence[Layer]) -> bool:
    """Return whether what is classified at voxels is labels, whose normals are smoothed under light."""
    return bool(_others(layers)) and all(isinstance(layer.tf, LabelTable) for layer in _others(layers))


def scalar_tables(layers: Sequence[Layer], per_unit: float, voxel: float) -> list[Optics]:
    """Return tables of one length over the data values of the layers that rays interpolate before they classify them.

    ``per_unit``: world lengths per unit-frame length; ``voxel``: mean edge of a voxel in the latter.
    """

    def made(layer: Layer, bins: int | None) -> Optics:
        assert isinstance(layer.tf, TransferFunction)
        ends = -math.inf, math.inf
        return build_tables(
            layer.tf, ends, unit_distance=layer.unit_distance, world_per_unit=per_unit, voxel=voxel, bins=bins
        )

    bins = max((made(layer, None).bins for layer in scalar_layers(layers)), default=0)
    return [made(layer, bins) for layer in scalar_layers(layers)]


def _values_in(layer: Layer, target: Volume, lo: np.ndarray, hi: np.ndarray, rim: float = 0.0) -> np.ndarray:
    """Return a layer's data values at voxels ``lo`` to ``hi`` of ``target``: (z, y, x) float64, NaN outside of it.

    The values go on for ``rim`` of the target's voxels: between a voxel that has none and one that has, rays meet none.
    """
    volume = layer.volume

    def read(first: np.ndarray, last: np.ndarray) -> np.ndarray:
        return volume.slope * read_block(volume, first, last)[..., None].astype(np.float64) + volume.intercept

    values = read(lo, hi) if volume.on_grid(target) else _placed(layer, target, lo, hi, read, np.nan, rim)
    return values[..., 0]


def _placed(
    layer: Layer, target: Volume, lo: np.ndarray, hi: np.ndarray,
    read: Callable[[np.ndarray, np.ndarray], np.ndarray], outside: float, rim: float = 0.0,
) -> np.ndarray:  # fmt: skip
    """Return a layer on another grid, interpolated at voxels ``lo`` to ``hi`` of ``target``: (z, y, x, c) float64.

    ``read`` returns (z, y, x, c) of a box of the layer's voxels; of them what the target's box meets is read, with a
    voxel around. ``outside`` is the value beyond the layer's box and ``rim`` of the target's voxels.
    """
    from vvgt_cli.dvr.place import place

    matrix = np.ascontiguousarray((np.linalg.inv(layer.volume.affine) @ target.affine)[:3])
    corners = np.array(list(itertools.product(*zip(lo, hi - 1, strict=True))), np.float64)
    met, dims = corners @ matrix[:, :3].T + matrix[:, 3], np.array(layer.volume.dims)
    first = np.clip(np.floor(met.min(axis=0)).astype(np.int64) - 1, 0, dims)
    last = np.clip(np.ceil(met.max(axis=0)).astype(np.int64) + 2, 0, dims)
    if (last <= first).any():
        return np.full((*(hi - lo)[::-1], 1), outside)
    values = read(first, last).astype(np.float64)
    out = np.zeros((*(hi - lo)[::-1], values.shape[3]))
    about = lo.astype(np.int64), first.astype(np.int64), dims.astype(np.int64)
    place(values, matrix, *about, rim * np.abs(matrix[:, :3]).sum(axis=1), outside, out)
    return out
