"""What is done to one block: each task reads its block, and leaves a part. They may run in any order, anywhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from vvgt_cli.dvr.layout import Optics, Voxels
from vvgt_cli.dvr.scene import KernelRule
from vvgt_cli.files import atomic_write
from vvgt_cli.scale.grid import SAMPLE, Boxes, CellGrid, samples_in
from vvgt_cli.scale.parts import CELLS, COUNTS, HISTOGRAM, ROW, Parts
from vvgt_cli.scale.sight import SUFFIX, Sight, segments
from vvgt_cli.synth.sources import open_volume
from vvgt_cli.transfer.tables import OpticalTables
from vvgt_cli.vbm.columns import MASS, MOMENTS
from vvgt_cli.volume import ReadOptions, Volume
from vvgt_cli.volume.stored import read_block
from vvgt_cli.volume.tallies import Tally, tally


@dataclass(frozen=True)
class Place:
    """Where blocks come from and where their parts go.

    Attributes:
        source, read: as `open_volume` takes them.
        folder: of the parts.
    """

    source: str
    read: ReadOptions
    folder: str

    def volume(self) -> Volume:
        """The volume, opened once a process."""
        return _opened(self.source, self.read)

    @property
    def parts(self) -> Parts:
        return Parts(Path(self.folder))


@lru_cache(maxsize=1)
def _opened(source: str, read: ReadOptions) -> Volume:
    return open_volume(source, read)


@dataclass(frozen=True)
class CountBlocks:
    """Count the values of blocks, and take samples of them.

    Attributes:
        place, boxes: what is read, and how it is cut.
        slices: of a box that are in memory at once.
        limits: data values, of a second pass: their histogram.
    """

    place: Place
    boxes: Boxes
    slices: int
    limits: tuple[float, float] | None = None

    @property
    def kind(self) -> str:
        return COUNTS if self.limits is None else HISTOGRAM

    def __len__(self) -> int:
        return len(self.boxes)

    def __call__(self, number: int) -> None:
        """Leave the part of block ``number``."""
        volume = self.place.volume()
        lo, hi = self.boxes.at(number)
        size = np.minimum(SAMPLE, self.boxes.dims)
        places, weights = samples_in(self.boxes.dims, lo, hi)
        wanted = len(places) if self.limits is None else 0
        bricks = np.empty((wanted, *size[::-1]), volume.data.dtype.newbyteorder("="))
        found: Tally | None = None
        for z in range(lo[2], hi[2], self.slices):
            begin, end = np.array([lo[0], lo[1], z]), np.array([hi[0], hi[1], min(z + self.slices, hi[2])])
            values = read_block(volume, begin, end)
            part = tally(values, volume, self.limits)
            found = part if found is None else found.plus(part)
            for n in range(wanted):
                if z <= places[n, 2] < end[2]:
                    bricks[n] = _brick(volume, values, begin, end, places[n], size)
            del values  # before the next slices are read
        assert found is not None, "a box has a slice"
        self.place.parts.save(
            self.kind,
            number,
            counts=found.counts,
            ends=np.array([found.lo, found.hi, *found.stored]),
            numbers=np.array([found.nan, found.finite], np.int64),
            histogram=found.histogram,
            samples=bricks,
            weights=weights,
        )

    def merged(self) -> tuple[Tally, np.ndarray, np.ndarray]:
        """The sum over all blocks, their samples (n, z, y, x), and the voxels (n,) that each stands for.

        Raises:
            DataError: a part is missing or damaged.
        """
        whole, samples, weights = None, [], []
        for number in range(len(self)):
            part = self.place.parts.load(self.kind, number)
            lo, hi, low, high = part["ends"].tolist()
            nan, finite = part["numbers"].tolist()
            one = Tally(part["counts"], lo, hi, (low, high), nan, finite, part["histogram"])
            whole = one if whole is None else whole.plus(one)
            samples.append(part["samples"])
            weights.append(part["weights"])
        assert whole is not None, "a volume has a block"
        return whole, np.concatenate(samples), np.concatenate(weights)


def _brick(
    volume: Volume, values: np.ndarray, begin: np.ndarray, end: np.ndarray, first: np.ndarray, size: np.ndarray
) -> np.ndarray:
    """``size`` voxels from ``first`` on (3,), of the ``values`` from ``begin`` to ``end`` where they hold them."""
    if (first + size > end).any():
        return read_block(volume, first, first + size)
    (x, y, z), (i, j, k) = first - begin, size
    return values[z : z + k, y : y + j, x : x + i]


@dataclass(frozen=True)
class CellBlocks:
    """Integrate the base cells of blocks.

    Attributes:
        place, grid: what is read, and how it is cut.
        rule: how stored values become those that kernels read.
        sight: views that are marched on the way.
        tables: optics over these.
    """

    place: Place
    grid: CellGrid
    rule: KernelRule
    sight: Sight
    tables: OpticalTables = field(repr=False)
    kind: str = CELLS

    def __len__(self) -> int:
        return len(self.grid.blocks)

    def __call__(self, number: int) -> None:
        """Leave the part of block ``number``: rows of cells, what it shows of rays, and what there is of each tile."""
        grid, parts = self.grid, self.place.parts
        lo, hi = grid.blocks.at(number)
        begin = np.maximum(lo - 1, 0)
        values = _for_kernels(read_block(self.place.volume(), begin, np.minimum(hi + 1, grid.dims)), self.rule)
        values.flags.writeable = False  # as those of a whole volume are: kernels are compiled for such
        tiles, counts, coarse, field, deepest = [], [], [], [], 0.0
        with (
            atomic_write(parts.path(CELLS, number, ".rows"), overwrite=True) as temporary,
            open(temporary, "wb") as stream,
        ):
            for tile in grid.tiles(number):
                index, moments = self._cells(values, begin, tile)
                if not len(index):
                    continue
                stream.write(np.ascontiguousarray(moments).data)
                stream.write((index - tile * grid.tile_cells).astype(np.uint8).tobytes())
                tiles.append(tile)
                counts.append(len(index))
                summary = self._summary(index - (tile * grid.tile_cells).astype(np.int32), moments[:, MASS])
                coarse.append(summary[0])
                field.append(summary[1])
                deepest = max(deepest, summary[2])
        parts.save(CELLS, number, SUFFIX, **segments(values, begin, number, grid, self.tables, self.sight))
        edges = [grid.tile_cells >> grid.march] * 3, [grid.tile_cells >> grid.field] * 3
        parts.save(
            CELLS,
            number,
            tiles=np.array(tiles, np.int64).reshape(-1, 3),
            counts=np.array(counts, np.int64),
            coarse=np.array(coarse).reshape(-1, *edges[0]),
            field=np.array(field).reshape(-1, *edges[1]),
            deepest=np.array(deepest),
        )

    def _cells(self, values: np.ndarray, begin: np.ndarray, tile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cells with extinction of a tile (x, y, z) in ``values``, of which the first voxel is ``begin`` (3,)."""
        from vvgt_cli.vbm.moments import Region, blocks, region_cells
        from vvgt_cli.vbm.ranges import visible_blocks

        grid, t = self.grid, self.tables
        exponent = np.array(grid.exponent, np.int64)
        lo = tile * grid.tile
        edge, _ = blocks(exponent)
        shape = -(-(np.minimum(lo + grid.tile, grid.dims) - lo) // edge)
        which = visible_blocks(values, lo - begin, edge, shape, t)
        if not len(which):
            return np.empty((0, 3), np.int32), np.empty((0, MOMENTS))
        optics = Optics(t.lo, t.inv_width, t.nodes, t.cumulative, t.dark)
        region = Region(Voxels(values), optics, np.array(grid.half), np.array(grid.step), begin.astype(np.float64))
        return region_cells(region, lo + which * edge, exponent, grid.points)

    def _summary(self, local: np.ndarray, mass: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Of a tile's cells ``local`` (n, 3): mass in cells of the march, opacity of the field, largest of a cell."""
        from vvgt_cli.vbm.inset import opaque_depth
        from vvgt_cli.vbm.visibility import summed

        grid = self.grid
        depth = opaque_depth(mass, grid.cell_edge, np.array(grid.step))
        march, wide = np.full(3, grid.tile_cells >> grid.march), np.full(3, grid.tile_cells >> grid.field)
        field = summed(local >> grid.field, np.minimum(depth, 1) / 8.0**grid.field, wide)
        return summed(local >> grid.march, mass, march), field.astype(np.float32), float(depth.max())


def _for_kernels(stored: np.ndarray, rule: KernelRule) -> np.ndarray:
    """A block (z, y, x) as kernels read it; what is converted goes slice by slice, as it is float64 on the way."""
    if rule.half_width is None and stored.dtype == rule.dtype:
        return stored
    values = np.empty(stored.shape, rule.dtype)
    for z, plane in enumerate(stored):
        values[z] = rule.apply(plane)
    return values


def read_rows(parts: Parts, number: int, offset: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Moments (count, 13) and places in their tile (count, 3) int32 of a tile's cells.

    ``offset`` counts the cells of the block before them.

    Raises:
        DataError: the file is not whole.
    """
    from vvgt_cli.errors import DataError

    path = parts.path(CELLS, number, ".rows")
    try:
        with open(path, "rb") as stream:
            stream.seek(offset * ROW)
            content = stream.read(count * ROW)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from error
    if len(content) < count * ROW:
        raise DataError(f"{path}: not whole; remove {path.with_suffix('.npz')} and run the same command again")
    split = count * MOMENTS * 8
    moments = np.frombuffer(content, np.float64, count * MOMENTS).reshape(count, MOMENTS)
    return moments, np.frombuffer(content, np.uint8, offset=split).reshape(count, 3).astype(np.int32)
