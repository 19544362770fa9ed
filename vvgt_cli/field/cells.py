"""Tasks over blocks: moments and normals of base cells, rays, and values and normals at points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.closed_form.columns import FIRST, MASS, MOMENTS
from vvgt_cli.dvr.layout import Light, Texels, Voxels
from vvgt_cli.field.block_store import CELLS, BlockStore
from vvgt_cli.field.grid import CellGrid
from vvgt_cli.field.rays import HALO, RayFile, save_rays
from vvgt_cli.field.reader import Layers, Scalars, VoxelBox
from vvgt_cli.files import atomic_write, write_arrays

if TYPE_CHECKING:
    from vvgt_cli.dvr.traced import Scattering

NORMALS = ".normals.npy"
Reader = Scalars | Layers


@dataclass(frozen=True)
class Blockwise:
    """A task with one step per block of cells.

    Attributes:
        reader: reader of boxes.
        grid: division of the volume into blocks and cells.
        store: destination of the results.
    """

    reader: Reader
    grid: CellGrid
    store: BlockStore

    def __len__(self) -> int:
        """Return the number of blocks."""
        return len(self.grid.blocks)

    def box(self, number: int, halo: int) -> VoxelBox:
        """Read block ``number`` with ``halo`` voxels around it."""
        lo, hi = self.grid.blocks.at(number)
        return self.reader.box(np.maximum(lo - halo, 0), np.minimum(hi + halo, self.grid.dims))


@dataclass(frozen=True)
class CellBlocks(Blockwise):
    """The integration of base cells.

    Attributes:
        rays: rays to cast while a block is in memory, None for none.
        light: lighting; with it cells get normals.
        labels: whether all layers are label maps.
    """

    rays: RayFile | None = None
    light: Light | None = None
    labels: bool = False
    kind: str = CELLS

    def __call__(self, number: int) -> None:
        """Save the cells of block ``number``, what its rays see, and a summary of each tile."""
        grid, store = self.grid, self.store
        box = self.box(number, HALO)
        tiles, counts, coarse, field, deepest = [], [], [], [], 0.0
        normals = [np.empty((0, 3))]
        with (
            atomic_write(store.path(CELLS, number, ".rows"), overwrite=True) as temporary,
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
            save_rays(self.rays, box, number, grid.blocks, self.light, store)
        if self.light is not None:
            write_arrays(store.path(CELLS, number, NORMALS), np.concatenate(normals))
        edges = [grid.tile_cells >> grid.march] * 3, [grid.tile_cells >> grid.field] * 3
        store.save(
            CELLS,
            number,
            tiles=np.array(tiles, np.int64).reshape(-1, 3),
            counts=np.array(counts, np.int64),
            coarse=np.array(coarse).reshape(-1, *edges[0]),
            field=np.array(field).reshape(-1, *edges[1]),
            deepest=np.array(deepest),
        )

    def _cells(self, box: VoxelBox, tile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices and moments of the cells with extinction in a tile (x, y, z) of a box."""
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

    def _normals(self, box: VoxelBox, moments: np.ndarray) -> np.ndarray:
        """Return normals (n, 3) at the centroids of cells."""
        half, step = np.array(self.grid.half), np.array(self.grid.step)
        points = (moments[:, FIRST] / moments[:, [MASS]] + half) / step - 0.5
        return normals_in(box, points, step)[:, :3]

    def _summary(self, local: np.ndarray, mass: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return a tile's mass in cells of the visibility march, its opacity field, and its largest opacity."""
        from vvgt_cli.closed_form.surface_offset import covered, opaque_depth
        from vvgt_cli.closed_form.visibility import summed

        grid = self.grid
        depth = opaque_depth(mass, grid.cell_edge, np.array(grid.step))
        march, wide = np.full(3, grid.tile_cells >> grid.march), np.full(3, grid.tile_cells >> grid.field)
        field = summed(local, covered(depth, self.labels) / 8.0**grid.field, grid.field, wide)
        return summed(local, mass, grid.march, march), field.astype(np.float32), float(depth.max())


def normals_in(box: VoxelBox, points: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return normals and extinction (n, 4) at the volume's voxel coordinates ``points`` (n, 3), all inside a box."""
    from vvgt_cli.closed_form.lit import point_normals

    out = np.empty((len(points), 4))
    point_normals(box.voxels, box.shaded, box.optics, step, np.ascontiguousarray(points - box.begin), out)
    return out


@dataclass(frozen=True)
class RayBlocks(Blockwise):
    """The casting of rays, for pictures requested after the cells were integrated; attributes as in `CellBlocks`."""

    rays: RayFile
    light: Light | None = None

    @property
    def kind(self) -> str:
        """Kind of the results."""
        return self.rays.kind

    def __call__(self, number: int) -> None:
        """Save what the rays see of block ``number``."""
        box = self.box(number, HALO)
        save_rays(self.rays, box, number, self.grid.blocks, self.light, self.store)


@dataclass(frozen=True)
class PointBlocks(Blockwise):
    """Normals and extinction at ``points``, a file of voxel coordinates (n, 3)."""

    points: str
    kind: str

    def __call__(self, number: int) -> None:
        """Save those at points in block ``number``."""
        lo, hi = self.grid.blocks.at(number)
        points = np.load(self.points, mmap_mode="r")
        low, high = np.where(lo == 0, -np.inf, lo - 0.5), np.where(hi == self.grid.dims, np.inf, hi - 0.5)
        which = np.flatnonzero(((points >= low) & (points < high)).all(axis=1))
        normals = np.empty((0, 4))
        if len(which):
            normals = normals_in(self.box(number, HALO), points[which], np.array(self.grid.step))
        self.store.save(self.kind, number, which=which, normals=normals)


@dataclass(frozen=True)
class ValueBlocks(Blockwise):
    """Values and normals at the sample points of Gaussians.

    Attributes:
        gaussians: file of centres and axes (n, 12) in voxels.
        kind: kind of the results.
    """

    gaussians: str
    kind: str

    def __call__(self, number: int) -> None:
        """Save what the Gaussians with points in block ``number`` have there.

        Saved are the values, with the points' numbers over all Gaussians, and the sums of each Gaussian's normals.
        """
        from vvgt_cli.closed_form.gaussian_samples import NORMAL_SUMS, POINTS, reach, samples_of

        lo, hi = self.grid.blocks.at(number)
        rows = np.load(self.gaussians, mmap_mode="r")
        far = np.linalg.norm(rows[:, 3:].reshape(-1, 3, 3), axis=2) * reach()  # largest distance along each axis
        near = (rows[:, :3] + far >= lo - 0.5) & (rows[:, :3] - far < hi - 0.5)
        which = np.flatnonzero(near.all(axis=1))
        values, numbers = np.empty(0, np.float32), np.empty(0, np.int64)
        sums = np.zeros((len(which), NORMAL_SUMS))
        if len(which):
            box = self.box(number, HALO)
            some, part = np.array(rows[which]), (box.begin.astype(np.int64), lo.astype(np.int64), hi.astype(np.int64))
            where = some[:, :3].copy(), some[:, 3:].reshape(-1, 3, 3).copy()
            samples, sums = samples_of(box.voxels, *where, *part, np.array(self.grid.step))
            row, column = np.nonzero(np.isfinite(samples))
            values, numbers = samples[row, column], which[row] * POINTS + column
        self.store.save(self.kind, number, numbers=numbers, values=values, which=which, sums=sums)


@dataclass(frozen=True)
class MeanBlocks(Blockwise):
    """Mean values, or texels of an optics grid, of the cells through which the light of a sky is traced.

    Their edge is ``cell`` voxels, which divides that of a block.
    """

    cell: int
    kind: str = "means"

    def __call__(self, number: int) -> None:
        """Save the cells of block ``number``."""
        box = self.box(number, 0)
        means = np.asarray(box.values if box.grid is None else box.grid, np.float64)
        for axis, n in enumerate(box.values.shape):
            first = np.arange(0, n, self.cell)
            means = np.add.reduceat(means, first, axis)
            means /= np.diff([*first, n]).reshape(-1, *[1] * (means.ndim - 1 - axis))
        self.store.save(self.kind, number, means=means.astype(np.float32))

    def gathered(self) -> np.ndarray:
        """Return the cells of the whole volume, (cz, cy, cx[, 4]); raise DataError if one is missing or damaged."""
        shape, out = tuple(-(-int(n) // self.cell) for n in self.grid.dims[::-1]), np.empty(0, np.float32)
        for number in range(len(self)):
            x, y, z = (int(n) // self.cell for n in self.grid.blocks.at(number)[0])
            part = self.store.load(self.kind, number)[self.kind]
            out = out if len(out) else np.empty((*shape, *part.shape[3:]), np.float32)
            out[z : z + part.shape[0], y : y + part.shape[1], x : x + part.shape[2]] = part
        return out

    def scattering(self, step: np.ndarray) -> Scattering:
        """Return what `gathered` does as paths are traced through it; ``step`` (3,) voxel edges, unit frame."""
        from vvgt_cli.dvr.bricks import brick_ranges, empty_distance
        from vvgt_cli.dvr.traced import Scattering

        means, optics = self.gathered(), self.reader.box(np.zeros(3, np.int64), np.ones(3, np.int64)).optics
        values = means if means.ndim == 3 else np.ascontiguousarray(means[..., 3])
        values.flags.writeable = False
        empty = empty_distance(brick_ranges(values), optics)
        texels = None if means.ndim == 3 else Texels(means)
        return Scattering(Voxels(values), optics, texels, empty, step * self.cell, self.cell)
