"""A pyramid on disk, of which one tile at a time is in memory.

The cells of each tile form a tree that ends in the tile's own cell; these roots are the base of a top tree.
Scores are kept in a file a block, two numbers per cell, so that a threshold is found without the moments.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from vvgt_cli.cameras import default_views, pixel_width
from vvgt_cli.closed_form.columns import COLUMNS, MASS, MOMENTS, SEEN
from vvgt_cli.closed_form.lit import SEEN_LITTLE, Shading, base_rows
from vvgt_cli.closed_form.moments import Cells, morton
from vvgt_cli.closed_form.pyramid import Pyramid, Tile
from vvgt_cli.closed_form.surface_offset import SURFACE, nowhere, smoothed
from vvgt_cli.closed_form.tree import Leaves, Scores, Tree, leaves_of, split_score, threshold_for, tree_over
from vvgt_cli.closed_form.visibility import Visibility, march_views
from vvgt_cli.dvr.layout import Light
from vvgt_cli.dvr.render import BoxFrame
from vvgt_cli.field.block_store import CELLS, COARSE, ROW, TREES, BlockStore
from vvgt_cli.field.cells import NORMALS
from vvgt_cli.field.grid import CellGrid
from vvgt_cli.files import atomic_write

SCORES = ".scores"


class Place(NamedTuple):
    """Location of a tile's cells: index (x, y, z), block, offset within the block's cells, and count."""

    x: int
    y: int
    z: int
    block: int
    offset: int
    cells: int


def places_of(store: BlockStore, grid: CellGrid) -> list[Place]:
    """Return the locations of all tiles with cells, in Morton order; raise DataError if a block is damaged."""
    places = []
    for number in range(len(grid.blocks)):
        part = store.load(CELLS, number, names=("tiles", "counts"))
        offsets = np.cumsum(part["counts"]) - part["counts"]
        rows = zip(part["tiles"].tolist(), offsets.tolist(), part["counts"].tolist(), strict=True)
        places += [Place._make((*tile, number, offset, count)) for tile, offset, count in rows]
    order = np.argsort(morton(np.array([place[:3] for place in places], np.int32).reshape(-1, 3)))
    return [places[k] for k in order]


def read_cells(store: BlockStore, grid: CellGrid, place: Place, lit: bool) -> Cells:
    """Return the cells of a tile, with normals if they are ``lit``; raise DataError if a file is damaged."""
    with store.reading(CELLS, place.block, ".rows") as path, open(path, "rb") as stream:
        stream.seek(place.offset * ROW)
        read = stream.readinto(content := bytearray(place.cells * ROW))  # writable, as kernels are compiled for
        if read < place.cells * ROW:
            raise EOFError("truncated")
    moments = np.frombuffer(content, np.float64, place.cells * MOMENTS).reshape(place.cells, MOMENTS)
    local = np.frombuffer(content, np.uint8, offset=moments.nbytes).reshape(place.cells, 3).astype(np.int32)
    index = local + np.array(place[:3], np.int32) * grid.tile_cells
    normals = None
    if lit:
        with store.reading(CELLS, place.block, NORMALS) as path:
            normals = np.load(path, mmap_mode="r")[place.offset : place.offset + place.cells]
    return Cells(index, moments, grid.cell_edge, np.array(grid.exponent, np.int64), normals)


def gather(store: BlockStore, grid: CellGrid) -> None:
    """Merge the summaries of all blocks, march the training views through them, and save what is found.

    Raises:
        DataError: a block is missing or damaged.
    """
    from vvgt_cli.closed_form.closed_form import MARCH_SIZE

    march, fine = grid.coarse_shape(grid.march), grid.coarse_shape(grid.field)
    mass, field, deepest = np.zeros(march[::-1]), np.zeros(fine[::-1], np.float32), 0.0
    for number in range(len(grid.blocks)):
        part = store.load(CELLS, number)
        deepest = max(deepest, float(part["deepest"]))
        for tile, one, other in zip(part["tiles"].tolist(), part["coarse"], part["field"], strict=True):
            _lay(mass, one, tile)
            _lay(field, other, tile)
    wide, box = grid.cell * 2.0**grid.march, BoxFrame(np.array(grid.half), np.array(grid.step))
    extinction = (mass / (wide * box.step).prod()).astype(np.float32)
    seen = march_views(extinction, wide, box, default_views("train", size=MARCH_SIZE))
    store.prepare(COARSE)
    store.save(COARSE, 0, **vars(seen), field=field, deepest=np.array(deepest), tiles=np.array(places_of(store, grid)))


def _lay(grid: np.ndarray, part: np.ndarray, place: list[int]) -> None:
    """Copy the cells of a tile into a grid, cropped to the volume."""
    x, y, z = (n * part.shape[0] for n in place)
    target = grid[z : z + part.shape[0], y : y + part.shape[1], x : x + part.shape[2]]
    target[:] = part[: target.shape[0], : target.shape[1], : target.shape[2]]


@dataclass(frozen=True, kw_only=True)
class TiledPyramid(Pyramid):
    """A pyramid whose cells and scores are on disk; each tile's tree is made when it is needed.

    Attributes:
        store, grid: stored cells, and their grid.
        places: locations of all tiles with extinction, in Morton order.
    """

    store: BlockStore
    grid: CellGrid
    places: list[Place]

    @classmethod
    def load(
        cls, store: BlockStore, grid: CellGrid, size: int, labels: bool, light: Light | None, degree: int
    ) -> TiledPyramid:
        """Read what `gather` saved, for images of ``size`` px; raise DataError if it is missing or damaged."""
        part, half, step = store.load(COARSE, 0), np.array(grid.half), np.array(grid.step)
        edge = grid.cell_edge * 2.0**grid.field
        return cls(
            Visibility(part["mean"], part["largest"], part["edge"]),
            nowhere(edge, half) if part["deepest"] < SURFACE else smoothed(part["field"], edge, half),
            half, step, pixel_width(size), labels, None if light is None else Shading(light, half, step), degree,
            store=store, grid=grid, places=[Place(*row) for row in part["tiles"].tolist()],
        )  # fmt: skip

    @property
    def blocks(self) -> list[int]:
        """Numbers of the blocks with tiles."""
        return sorted({place.block for place in self.places})

    def save(self, number: int) -> None:
        """Save the scores of the tiles of block ``number``, and the rows of their own cells.

        Scores are two float64 per cell, that which splits its parent and its own, tile after tile.
        """
        sizes, moments, largest, shades, which = [], [], [], [], []
        with (
            atomic_write(self.store.path(TREES, number, SCORES), overwrite=True) as temporary,
            open(temporary, "wb") as stream,
        ):
            for row, place in enumerate(self.places):
                tile = self._tile(place) if place.block == number else None
                if tile is None or not len(tile.tree):
                    continue
                tree, scores = tile.tree, Scores.of(tile.tree, split_score(tile.tree))
                stream.write(scores.above.tobytes() + scores.capped.tobytes())
                which.append(row)
                sizes.append((len(tree), int((~scores.inner).sum())))
                moments.append(tree.moments[-1].copy())  # a view would keep the tree
                largest.append(tree.largest[-1])
                root = self.shaded(leaves_of(tree, np.array([len(tree) - 1])), tile)
                shades.append(root.moments[0, COLUMNS:])
        self.store.save(
            TREES, number, which=np.array(which, np.int64), sizes=np.array(sizes, np.int64).reshape(-1, 2),
            moments=np.array(moments), largest=np.array(largest), shades=np.array(shades),
        )  # fmt: skip

    @cached_property
    def _saved(self) -> tuple[list[Place], list[tuple[int, int, int]], tuple[np.ndarray, ...]]:
        """Locations of visible tiles; the size, base and offset of their scores; and columns of their own cells.

        Raises:
            DataError: a block's file is missing or damaged.
        """
        tiles: dict[int, tuple[Any, ...]] = {}
        for number in self.blocks:
            part, offset = self.store.load(TREES, number), 0
            for k, (row, (size, base)) in enumerate(zip(part["which"].tolist(), part["sizes"].tolist(), strict=True)):
                tiles[row] = (size, base, offset), *(part[name][k] for name in ("moments", "largest", "shades"))
                offset += 16 * size
        sizes, *columns = ([tiles[row][k] for row in sorted(tiles)] for k in range(4))
        return [self.places[row] for row in sorted(tiles)], sizes, tuple(map(np.array, columns))

    @property
    def base(self) -> int:
        """Number of base cells that some view sees."""
        return sum(base for _, base, _ in self._saved[1])

    @property
    def _levels(self) -> int | None:
        """Levels above the cells of a tile; None where one tile is all there is, whose tree ends in one cell."""
        return None if len(self.places) == 1 else self.grid.bits

    @cached_property
    def top(self) -> Tree:
        """The tree over the own cells of the tiles that some view sees."""
        places, _, (own, seen, _) = self._saved
        alone = bool(places) and self._levels is None
        edge = self.tile(0).tree.edges[-1] if alone else self.grid.cell_edge * self.grid.tile_cells

        def fill(moments: np.ndarray, largest: np.ndarray) -> None:
            moments[:], largest[:] = own, seen

        return tree_over(np.array([place[:3] for place in places], np.int32).reshape(-1, 3), edge, fill)

    @cached_property
    def _top_scores(self) -> Scores:
        return Scores.of(self.top, split_score(self.top))

    def __len__(self) -> int:
        """Return the number of tiles."""
        return len(self._saved[0])

    def tile(self, row: int) -> Tile:
        """Return a tile; raise DataError if its block is damaged."""
        return self._tile(self._saved[0][row])

    def _tile(self, place: Place) -> Tile:
        cells = read_cells(self.store, self.grid, place, self.shading is not None)
        return Tile.of(cells, self.seen, self.step, self._levels)

    def _scores(self, row: int) -> Scores:
        """Return the scores of a tile's cells, at most those of the cells above; raise DataError for a damaged file."""
        size, base, offset = self._saved[1][row]
        top = self._top_scores
        with self.store.reading(TREES, self._saved[0][row].block, SCORES) as path:
            above, capped = np.fromfile(path, np.float64, 2 * size, offset=offset).reshape(2, size)
        above, capped = np.minimum(above, top.capped[row]), np.minimum(capped, top.capped[row])
        above[-1] = top.above[row]
        return Scores(above, capped, np.arange(size) >= base)

    def scores_over_tiles(self) -> Scores:
        """Return the scores of the cells that hold several tiles."""
        return Scores(*(column[len(self) :] for column in self._top_scores))

    def scores(self) -> Iterator[Scores]:
        """Yield the scores of each tile in turn, then those of `scores_over_tiles`."""
        yield from map(self._scores, range(len(self)))
        yield self.scores_over_tiles()

    def threshold(self, budget: int) -> float:
        """Return the threshold of scores for at most ``budget`` cells."""
        return threshold_for(self.scores, budget)

    def counts(self, threshold: float) -> np.ndarray:
        """Return the number of leaves for a threshold in each tile, and last that over several tiles."""
        return np.array([int(scores.leaves(threshold).sum()) for scores in self.scores()])

    def cuts(self, begin: int, end: int, thresholds: np.ndarray, least: bool = True) -> Iterator[list[Leaves]]:
        """Yield, for each of the tiles from ``begin`` to ``end``, the leaves for each of its ``thresholds`` (tiles, n).

        Under light the means of `Shading.lit` follow their moments. With ``least`` there is always at least the tile's
        own cell.
        """
        for row in range(begin, end):
            tile, scores = self.tile(row), self._scores(row)
            if least:
                scores.above[-1] = np.inf
            chosen = [np.flatnonzero(scores.leaves(threshold)) for threshold in thresholds[row]]
            yield [self.shaded(leaves_of(tile.tree, nodes), tile) for nodes in chosen]

    def leaves_over_tiles(self, threshold: float) -> Leaves | None:
        """Return the leaves for a threshold that stand for several tiles each; None if there are none.

        Under light the means of `Shading.lit` over the tiles, weighted by visibility, follow their moments.
        """
        nodes = np.flatnonzero(self.scores_over_tiles().leaves(threshold)) + len(self)
        if not len(nodes):
            return None
        leaves, moments, shades = leaves_of(self.top, nodes), self.top.moments, self._saved[2][2]
        if self.shading is None:
            return leaves
        seen = np.maximum(moments[:, SEEN], SEEN_LITTLE * moments[:, MASS])
        pairs = zip(*base_rows(self.top, nodes), strict=True)
        means = [np.average(shades[a:b], axis=0, weights=seen[a:b]) for a, b in pairs]
        return replace(leaves, moments=np.concatenate([leaves.moments, means], axis=1))
