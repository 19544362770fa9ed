"""Boxes of voxels, read by any process: values and their optics in the layout of the kernels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache

import numpy as np

from vvgt_cli.dvr.layers import Layer, grid_box, mixture_box, scalar_tables
from vvgt_cli.dvr.layout import Mixture, Texels
from vvgt_cli.dvr.relief import REACH, Shaded, smoothed
from vvgt_cli.dvr.scene import KernelRule, read_only
from vvgt_cli.field.layered import OpenedFile, content_of, open_content
from vvgt_cli.look.tables import Optics
from vvgt_cli.volume import ReadOptions, Volume, triple
from vvgt_cli.volume.stored import read_block

OPEN = 16  # files that a process keeps open
FEW_SAMPLES = 512  # bricks of layers, each of which is read separately
CLASSIFIED = -1  # stands for the volume that determines the opacity of colours


@dataclass(frozen=True)
class VolumeOrigin:
    """The origin of a volume, by which any process can open it.

    Attributes:
        source, read: arguments of `open_content`; or a volume in memory.
        component: number of the component in the file's content, or `CLASSIFIED`.
        other: a volume in whose space and unit it is, without its values; None for its own.
    """

    source: str | Volume
    read: ReadOptions
    component: int = 0
    other: Volume | None = None

    def volume(self) -> Volume:
        """Return the volume, opened once per process."""
        content = _opened(self.source, self.read) if isinstance(self.source, str) else content_of(self.source)
        content = content.beside(self.other)
        return content.classified[0] if self.component == CLASSIFIED else content.volumes[self.component]


@lru_cache(maxsize=OPEN)
def _opened(source: str, read: ReadOptions) -> OpenedFile:
    return open_content(source, read)


def forget() -> None:
    """Close the volumes that this process has opened, as their files may be written again."""
    _opened.cache_clear()


@dataclass(frozen=True)
class VoxelBox(Shaded):
    """A box of voxels in the layout of the kernels.

    Attributes:
        values: (z, y, x) values that the optics apply to; extinction for an optics grid.
        grid: (z, y, x, 4) float32 texels of an optics grid, else None.
        optics: tables over ``values``.
        begin: (3,) first voxel in the volume, (x, y, z).
        mixture: an optics grid as rays meet it, else None.
        relief: as `Scene.relief`.
    """

    values: np.ndarray
    grid: np.ndarray | None
    optics: Optics
    begin: np.ndarray
    mixture: Mixture | None = None
    relief: np.ndarray | None = None

    @property
    def texels(self) -> Texels | None:
        """`grid` in the kernels' type."""
        return None if self.grid is None else Texels(self.grid)

    def part(self, lo: np.ndarray, hi: np.ndarray) -> VoxelBox:
        """Return the voxels ``lo`` to ``hi`` (3,) of the volume that lie in this box."""
        a = np.maximum(lo - self.begin, 0)
        b = np.minimum(hi - self.begin, self.values.shape[::-1])
        index = tuple(slice(int(p), int(q)) for p, q in zip(a[::-1], b[::-1], strict=True))
        grid = None if self.grid is None else np.ascontiguousarray(self.grid[index])
        mixture = None if self.mixture is None else self.mixture.part(index)
        relief = None if self.relief is None else read_only(self.relief[index], np.dtype(np.float32))
        values = read_only(self.values[index], self.values.dtype)
        return VoxelBox(values, grid, self.optics, self.begin + a, mixture, relief)

    def empty(self) -> np.ndarray:
        """Return `empty_bricks` of the box."""
        from vvgt_cli.dvr.bricks import empty_bricks

        return empty_bricks(self.values, self.optics, self.mixture)


@dataclass(frozen=True)
class Scalars:
    """A reader of boxes of one scalar field.

    Attributes:
        place: origin of the volume.
        rule: mapping from stored values to those that kernels read.
        optics: tables over the kernels' values.
    """

    place: VolumeOrigin
    rule: KernelRule
    optics: Optics = field(repr=False)

    @property
    def voxel_bytes(self) -> int:
        """Bytes per voxel while a box is read."""
        return self.rule.dtype.itemsize + 8

    def box(self, lo: np.ndarray, hi: np.ndarray) -> VoxelBox:
        """Read the voxels ``lo`` to ``hi`` (3,), x first; raise DataError if the file or a chunk is damaged."""
        values = self.rule.laid_out(read_block(self.place.volume(), lo, hi))
        return VoxelBox(values, None, self.optics, lo.astype(np.int64))


@dataclass(frozen=True)
class Layers:
    """A reader of boxes of the optics grid that layers add up to.

    Attributes:
        layers: the layers, without their volumes.
        places: origins of each layer's volume and colours.
        grid: geometry of the common grid: a volume of one voxel.
        dims: voxels along (x, y, z).
        scale: unit-frame lengths per world length.
        optics: tables over extinction.
        smooth: boxes have a `Scene.relief`.
    """

    layers: tuple[Layer, ...]
    places: tuple[tuple[VolumeOrigin, ...], ...]
    grid: Volume
    dims: tuple[int, int, int]
    scale: float
    optics: Optics = field(repr=False)
    smooth: bool = False
    voxel_bytes = 80

    def __getstate__(self) -> dict[str, object]:
        """Return the fields alone: other processes open the volumes themselves."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @cached_property
    def _opened(self) -> list[Layer]:
        """The layers with their volumes."""
        layers = []
        for layer, places in zip(self.layers, self.places, strict=True):
            volume, *colors = [place.volume() for place in places]
            layers.append(replace(layer, volume=volume, colors=triple(colors) if colors else None))
        return layers

    @cached_property
    def _tables(self) -> list[Optics]:
        step = hollow(self.grid, self.dims).unit_frame().step
        return scalar_tables(self._opened, 1 / self.scale, float(np.mean(step)))

    def box(self, lo: np.ndarray, hi: np.ndarray) -> VoxelBox:
        """Implement `Scalars.box`."""
        reach = REACH if self.smooth else 0
        first, end = np.maximum(lo - reach, 0), np.minimum(hi + reach, self.dims)
        target, per_unit = hollow(self.grid, self.dims), 1 / self.scale
        texels = grid_box(self._opened, target, first, end)
        texels *= np.float32(per_unit)
        values = read_only(texels[..., 3], texels.dtype)
        mixture = mixture_box(self._opened, self._tables, target, first, end, texels, per_unit)
        relief = smoothed(mixture.grid[..., 3]) if self.smooth else None
        return VoxelBox(values, texels, self.optics, first, mixture, relief).part(lo, hi)

    def visible(self) -> float:
        """Return the approximate number of visible voxels, from samples."""
        from vvgt_cli.closed_form.samples import SAMPLE, estimate, samples_in, visible_share

        places, weights = samples_in(self.dims, np.zeros(3, np.int64), np.array(self.dims))
        size = np.minimum(SAMPLE, self.dims)
        few = np.unique(np.linspace(0, len(places) - 1, min(len(places), FEW_SAMPLES)).astype(np.int64))
        bricks = np.stack([self.box(places[n], places[n] + size).values for n in few])
        return estimate(visible_share(self.optics, bricks), weights[few], math.prod(self.dims))


def hollow(volume: Volume, dims: Sequence[int]) -> Volume:
    """Return a volume's grid with ``dims`` (x, y, z) voxels, without values."""
    return replace(volume, data=np.broadcast_to(np.uint8(0), tuple(dims)[::-1]), slope=1.0, intercept=0.0)
