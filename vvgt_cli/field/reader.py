"""What is read of a box of voxels, by any process: values and their optics, as the kernels take them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache

import numpy as np

from vvgt_cli.dvr.layers import Layer, grid_box
from vvgt_cli.dvr.layout import Texels, Voxels
from vvgt_cli.dvr.scene import KernelRule
from vvgt_cli.field.layered import Content, content_of, open_content
from vvgt_cli.look.tables import Optics
from vvgt_cli.volume import ReadOptions, Volume
from vvgt_cli.volume.stored import read_block
from vvgt_cli.volume.types import triple

OPEN = 16  # files that a process keeps open
FEW_SAMPLES = 512  # bricks of layers: each is read for itself
CLASSIFIED = -1  # in the place of a component: what the opacity of colours follows from


@dataclass(frozen=True)
class Place:
    """Where a volume comes from.

    Attributes:
        source, read: as `open_content` takes them; or a volume that is in memory.
        component: number of it in the file's content, or `CLASSIFIED`.
    """

    source: str | Volume
    read: ReadOptions
    component: int = 0

    def volume(self) -> Volume:
        """The volume, opened once a process."""
        content = _opened(self.source, self.read) if isinstance(self.source, str) else content_of(self.source)
        return content.classified[0] if self.component == CLASSIFIED else content.volumes[self.component]


@lru_cache(maxsize=OPEN)
def _opened(source: str, read: ReadOptions) -> Content:
    return open_content(source, read)


@dataclass(frozen=True)
class Box:
    """A box of voxels, as the kernels take it.

    Attributes:
        values: (z, y, x) that optics are over; of an optics grid its extinction.
        grid: (z, y, x, 4) float32 of an optics grid, else None.
        optics: over ``values``.
        begin: (3,) first voxel of it in the volume, (x, y, z).
    """

    values: np.ndarray
    grid: np.ndarray | None
    optics: Optics
    begin: np.ndarray

    @property
    def voxels(self) -> Voxels:
        """`values` as kernels take them."""
        return Voxels(self.values)

    @property
    def texels(self) -> Texels | None:
        """`grid` as kernels take it."""
        return None if self.grid is None else Texels(self.grid)

    def part(self, lo: np.ndarray, hi: np.ndarray) -> Box:
        """The voxels ``lo`` to ``hi`` (3,) of the volume that lie in it, laid out anew."""
        a = np.maximum(lo - self.begin, 0)
        b = np.minimum(hi - self.begin, self.values.shape[::-1])
        index = tuple(slice(int(p), int(q)) for p, q in zip(a[::-1], b[::-1], strict=True))
        grid = None if self.grid is None else np.ascontiguousarray(self.grid[index])
        return Box(_kept(self.values[index]), grid, self.optics, self.begin + a)


def _kept(values: np.ndarray) -> np.ndarray:
    """C-contiguous and read-only, as kernels are compiled for."""
    out = np.ascontiguousarray(values)
    out = out.copy() if out.base is not None and out is values else out
    out.flags.writeable = False
    return out


@dataclass(frozen=True)
class Scalars:
    """Reads boxes of one scalar field.

    Attributes:
        place: of the volume.
        rule: how stored values become those that kernels read.
        optics: over these.
    """

    place: Place
    rule: KernelRule
    optics: Optics = field(repr=False)

    @property
    def all_places(self) -> tuple[Place, ...]:
        """Where each volume comes from."""
        return (self.place,)

    @property
    def voxel_bytes(self) -> int:
        """Of a voxel while it is read."""
        return self.rule.dtype.itemsize + 8

    def box(self, lo: np.ndarray, hi: np.ndarray) -> Box:
        """The voxels ``lo`` to ``hi`` (3,), x first.

        Raises:
            DataError: the file ends early, or a chunk is damaged.
        """
        stored = read_block(self.place.volume(), lo, hi)
        if self.rule.half_width is None and stored.dtype == self.rule.dtype:
            values = stored
        else:
            values = np.empty(stored.shape, self.rule.dtype)
            for z, plane in enumerate(stored):  # in between it is float64
                values[z] = self.rule.apply(plane)
        values.flags.writeable = False
        return Box(values, None, self.optics, lo.astype(np.int64))


@dataclass(frozen=True)
class Layers:
    """Reads boxes of the optics grid that layers add up to.

    Attributes:
        layers: they, without their volumes.
        places: where the volume of each comes from, and its colours.
        grid: their common grid: a volume of one voxel, with the dims beside it.
        dims: voxels along (x, y, z).
        scale: unit-frame lengths per world length.
        optics: over extinction.
    """

    layers: tuple[Layer, ...]
    places: tuple[tuple[Place, ...], ...]
    grid: Volume
    dims: tuple[int, int, int]
    scale: float
    optics: Optics = field(repr=False)
    voxel_bytes = 60

    @property
    def all_places(self) -> tuple[Place, ...]:
        """Where each volume comes from."""
        return tuple(place for places in self.places for place in places)

    def __getstate__(self) -> dict[str, object]:
        """What other processes get: they open the volumes for themselves."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @cached_property
    def _opened(self) -> list[Layer]:
        """The layers with their volumes."""
        found = []
        for layer, places in zip(self.layers, self.places, strict=True):
            volume, *colors = [place.volume() for place in places]
            found.append(replace(layer, volume=volume, colors=triple(colors) if colors else None))
        return found

    def box(self, lo: np.ndarray, hi: np.ndarray) -> Box:
        """See `Scalars.box`."""
        texels = grid_box(self._opened, hollow(self.grid, self.dims), lo, hi)
        texels *= np.float32(1 / self.scale)
        values = np.ascontiguousarray(texels[..., 3])
        values.flags.writeable = False
        return Box(values, texels, self.optics, lo.astype(np.int64))

    def visible(self) -> float:
        """About how many voxels are visible: samples of them are read."""
        from vvgt_cli.closed_form.samples import SAMPLE, estimate, samples_in, visible_share

        places, weights = samples_in(self.dims, np.zeros(3, np.int64), np.array(self.dims))
        size = np.minimum(SAMPLE, self.dims)
        few = np.unique(np.linspace(0, len(places) - 1, min(len(places), FEW_SAMPLES)).astype(np.int64))
        bricks = np.stack([self.box(places[n], places[n] + size).values for n in few])
        return estimate(visible_share(self.optics, bricks), weights[few], math.prod(self.dims))


def hollow(volume: Volume, dims: Sequence[int]) -> Volume:
    """The grid of a volume of ``dims`` (x, y, z) voxels, without values."""
    return replace(volume, data=np.broadcast_to(np.uint8(0), tuple(dims)[::-1]), slope=1.0, intercept=0.0)
