"""Base cells of blocks: the moments of each, its normal where it is lit, and what of the block rays see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vvgt_cli.closed_form.columns import FIRST, MASS, MOMENTS
from vvgt_cli.dvr.layout import Light
from vvgt_cli.errors import DataError
from vvgt_cli.field.grid import CellGrid
from vvgt_cli.field.parts import CELLS, ROW, Parts
from vvgt_cli.field.rays import HALO, LIT_HALO, RayFile, leave_rays
from vvgt_cli.field.reader import Box, Layers, Scalars
from vvgt_cli.files import atomic_write

NORMALS = ".normals.npy"
Reader = Scalars | Layers


@dataclass(frozen=True)
class Blockwise:
    """A task for every block of cells.

    Attributes:
        reader, grid: what is read, and how it is cut.
        parts: where what comes of it goes.
    """

    reader: Reader
    grid: CellGrid
    parts: Parts

    def __len__(self) -> int:
        return len(self.grid.blocks)

    def box(self, number: int, halo: int) -> Box:
        """Block ``number`` with ``halo`` voxels around it."""
        lo, hi = self.grid.blocks.at(number)
        return self.reader.box(np.maximum(lo - halo, 0), np.minimum(hi + halo, self.grid.dims))


@dataclass(frozen=True)
class CellBlocks(Blockwise):
    """Integrate the base cells of blocks.

    Attributes:
        rays: that are cast on the way, None for none.
        light: that falls on the volume: cells then have normals.
    """

    rays: RayFile | None = None
    light: Light | None = None
    kind: str = CELLS

    def __call__(self, number: int) -> None:
        """Leave the part of block ``number``: rows of cells, what it shows of rays, and what there is of each tile."""
        grid, parts = self.grid, self.parts
        box = self.box(number, HALO if self.light is None else LIT_HALO)
        tiles, counts, coarse, field, deepest = [], [], [], [], 0.0
        normals = [np.empty((0, 3))]
        with (
            atomic_write(parts.path(CELLS, number, ".rows"), overwrite=True) as temporary,
            open(temporary, "wb") as stream,
        ):
            for tile in grid.tiles(number):
                index, moments = self._cells(box, tile)
                if not len(index):
                    continue
                stream.write(np.ascontiguousarray(moments).data)
                stream.write((index - tile * grid.tile_cells).astype(np.uint8).tobytes())
                if self.light is not None:
                    normals.append(self._normals(box, moments))
                tiles.append(tile)
                counts.append(len(index))
                summary = self._summary(index - (tile * grid.tile_cells).astype(np.int32), moments[:, MASS])
                coarse.append(summary[0])
                field.append(summary[1])
                deepest = max(deepest, summary[2])
        if self.rays is not None:
            leave_rays(self.rays, box, number, grid.blocks, self.light, parts)
        if self.light is not None:
            path = parts.path(CELLS, number, NORMALS)
            with atomic_write(path, overwrite=True) as temporary, open(temporary, "wb") as stream:
                np.save(stream, np.concatenate(normals))
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

    def _cells(self, box: Box, tile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cells with extinction of a tile (x, y, z) in a box."""
        from vvgt_cli.closed_form.moments import Region, blocks, region_cells
        from vvgt_cli.dvr.bricks import visible_blocks

        grid = self.grid
        exponent = np.array(grid.exponent, np.int64)
        lo = tile * grid.tile
        edge, _ = blocks(exponent)
        shape = -(-(np.minimum(lo + grid.tile, grid.dims) - lo) // edge)
        which = visible_blocks(box.values, lo - box.begin, edge, shape, box.optics)
        if not len(which):
            return np.empty((0, 3), np.int32), np.empty((0, MOMENTS))
        half, step = np.array(grid.half), np.array(grid.step)
        region = Region(box.voxels, box.optics, half, step, box.begin.astype(np.float64), box.texels)
        return region_cells(region, lo + which * edge, exponent)

    def _normals(self, box: Box, moments: np.ndarray) -> np.ndarray:
        """(n, 3) at the centroids of cells."""
        half, step = np.array(self.grid.half), np.array(self.grid.step)
        points = (moments[:, FIRST] / moments[:, [MASS]] + half) / step - 0.5
        return normals_in(box, points, step)[:, :3]

    def _summary(self, local: np.ndarray, mass: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Of a tile's cells ``local`` (n, 3): mass in cells of the march, opacity of the field, largest of a cell."""
        from vvgt_cli.closed_form.surface_offset import opaque_depth
        from vvgt_cli.closed_form.visibility import summed

        grid = self.grid
        depth = opaque_depth(mass, grid.cell_edge, np.array(grid.step))
        march, wide = np.full(3, grid.tile_cells >> grid.march), np.full(3, grid.tile_cells >> grid.field)
        field = summed(local, np.minimum(depth, 1) / 8.0**grid.field, grid.field, wide)
        return summed(local, mass, grid.march, march), field.astype(np.float32), float(depth.max())


def normals_in(box: Box, points: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Normals and extinction (n, 4) at voxel coordinates ``points`` (n, 3) of the volume that lie in a box."""
    from vvgt_cli.closed_form.lit import point_normals

    out = np.empty((len(points), 4))
    point_normals(box.voxels, box.optics, step, np.ascontiguousarray(points - box.begin), out)
    return out


@dataclass(frozen=True)
class RayBlocks(Blockwise):
    """Cast rays through blocks: a pass for pictures that were not known before. Attributes: as of `CellBlocks`."""

    rays: RayFile
    light: Light | None = None

    @property
    def kind(self) -> str:
        return self.rays.kind

    def __call__(self, number: int) -> None:
        """Leave what block ``number`` shows of them."""
        box = self.box(number, HALO if self.light is None else LIT_HALO)
        leave_rays(self.rays, box, number, self.grid.blocks, self.light, self.parts)


@dataclass(frozen=True)
class PointBlocks(Blockwise):
    """Normals and extinction at ``points``, a file of voxel coordinates (n, 3)."""

    points: str
    kind: str

    def __call__(self, number: int) -> None:
        """Leave those of the points that lie in block ``number``."""
        lo, hi = self.grid.blocks.at(number)
        points = np.load(self.points, mmap_mode="r")
        low, high = np.where(lo == 0, -np.inf, lo - 0.5), np.where(hi == self.grid.dims, np.inf, hi - 0.5)
        which = np.flatnonzero(((points >= low) & (points < high)).all(axis=1))
        found = np.empty((0, 4))
        if len(which):
            found = normals_in(self.box(number, LIT_HALO), points[which], np.array(self.grid.step))
        self.parts.save(self.kind, number, which=which, found=found)


@dataclass(frozen=True)
class ValueBlocks(Blockwise):
    """Values at the points of Gaussians.

    Attributes:
        gaussians: file of centres and axes (n, 12) in voxels.
        kind: of the parts.
    """

    gaussians: str
    kind: str

    def __call__(self, number: int) -> None:
        """Leave the values of those points that lie in block ``number``: numbers of them, over all Gaussians."""
        from vvgt_cli.closed_form.gaussian_samples import POINTS, offsets, reach, sample_points

        lo, hi = self.grid.blocks.at(number)
        rows = np.load(self.gaussians, mmap_mode="r")
        far = np.linalg.norm(rows[:, 3:].reshape(-1, 3, 3), axis=2) * reach()  # of points along each axis, at most
        near = (rows[:, :3] + far >= lo - 0.5) & (rows[:, :3] - far < hi - 0.5)
        which = np.flatnonzero(near.all(axis=1))
        found, numbers = np.empty(0, np.float32), np.empty(0, np.int64)
        if len(which):
            box = self.box(number, HALO)
            samples = np.full((len(which), POINTS), np.nan, np.float32)
            some, begin = np.array(rows[which]), box.begin.astype(np.int64)
            sample_points(
                box.voxels, some[:, :3].copy(), some[:, 3:].reshape(-1, 3, 3).copy(), offsets(), begin,
                lo.astype(np.int64), hi.astype(np.int64), samples,
            )  # fmt: skip
            row, column = np.nonzero(np.isfinite(samples))
            found, numbers = samples[row, column], which[row] * POINTS + column
        self.parts.save(self.kind, number, numbers=numbers, found=found)


@dataclass(frozen=True)
class ExtinctionBlocks(Blockwise):
    """Mean extinction of the cells that shadows and occlusion are marched through.

    ``cell``: voxels along their edge, of which blocks hold whole ones.
    """

    cell: int
    kind: str = "extinction"

    def __call__(self, number: int) -> None:
        """Leave those of block ``number``."""
        from vvgt_cli.dvr.bricks import brick_ranges, empty_distance
        from vvgt_cli.dvr.shadows import cell_extinction

        box = self.box(number, 0)
        out = np.empty(tuple(-(-n // self.cell) for n in box.values.shape), np.float32)
        empty = empty_distance(brick_ranges(box.values), box.optics)
        cell_extinction(box.voxels, box.optics, empty, self.cell, out)
        self.parts.save(self.kind, number, extinction=out)

    def gathered(self) -> np.ndarray:
        """(cz, cy, cx) float32 of the whole volume.

        Raises:
            DataError: a part is missing or damaged.
        """
        out = np.empty(tuple(-(-int(n) // self.cell) for n in self.grid.dims[::-1]), np.float32)
        for number in range(len(self)):
            x, y, z = (int(n) // self.cell for n in self.grid.blocks.at(number)[0])
            part = self.parts.load(self.kind, number)["extinction"]
            out[z : z + part.shape[0], y : y + part.shape[1], x : x + part.shape[2]] = part
        return out


def read_rows(parts: Parts, number: int, offset: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Moments (count, 13) and places in their tile (count, 3) int32 of a tile's cells.

    ``offset`` counts the cells of the block before them.

    Raises:
        DataError: the file is not whole.
    """
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
