"""The pyramid over all tiles, with only the top level in memory, and the selection of its cells for a budget.

The cells of each tile form a tree that ends in the tile's own cell; these roots are the leaves of a top tree. Scores
are kept in a file a block, two numbers per cell, so that a threshold is found without the moments.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from vvgt_cli.closed_form.columns import MASS, SEEN
from vvgt_cli.closed_form.moments import Cells, morton
from vvgt_cli.closed_form.tree import Leaves, Tree, build_tree, cap_by_ancestors, leaves_of, pyramid, shown, split_score
from vvgt_cli.closed_form.visibility import Visibility
from vvgt_cli.dvr.layout import Light
from vvgt_cli.errors import DataError
from vvgt_cli.field.block_store import CELLS, COARSE, TREES, BlockStore
from vvgt_cli.field.cells import NORMALS, read_rows
from vvgt_cli.field.grid import CellGrid
from vvgt_cli.files import atomic_write

FRACTION_BITS = 9  # mantissa bits of a score that select its bin in the histogram
BINS = 1 << 16
LOWEST = (1023 - 110) << FRACTION_BITS  # exponent 2^-110: smaller scores share the lowest bin
FIELDS = ("moments", "index", "edge", "node")
SCORES = ".scores"


class Tile(NamedTuple):
    """Location of a tile's cells: place (x, y, z), block, offset within the block's cells, and count."""

    place: tuple[int, int, int]
    block: int
    offset: int
    cells: int


class TileScores(NamedTuple):
    """Scores of cells: that which splits the parent, the cell's own, and whether it has children."""

    above: np.ndarray
    capped: np.ndarray
    inner: np.ndarray

    def leaves(self, threshold: float) -> np.ndarray:
        """Return which cells (n,) are leaves for a threshold."""
        found: np.ndarray = (self.above > threshold) & ((self.capped <= threshold) | ~self.inner)
        return found


@dataclass(frozen=True)
class Coarse:
    """The summaries of all blocks, and what they show of the visibility of cells.

    Attributes:
        seen: visibility by the march through the cells' mean extinction.
        field: (nz, ny, nx) float32 opacity.
        deepest: largest opacity of a base cell.
        tiles: all tiles, in Morton order.
    """

    seen: Visibility
    field: np.ndarray
    deepest: float
    tiles: list[Tile]

    @classmethod
    def gathered(cls, store: BlockStore, grid: CellGrid) -> Coarse:
        """Merge the summaries of all blocks, march the training views through them, and save what is found.

        Raises:
            DataError: a block is missing or damaged.
        """
        from vvgt_cli.cameras import default_views
        from vvgt_cli.closed_form.closed_form import MARCH_SIZE
        from vvgt_cli.closed_form.visibility import march_views
        from vvgt_cli.dvr.render import BoxFrame

        march, fine = grid.coarse_shape(grid.march), grid.coarse_shape(grid.field)
        mass, field, deepest = np.zeros(march[::-1]), np.zeros(fine[::-1], np.float32), 0.0
        tiles = []
        for number in range(len(grid.blocks)):
            part = store.load(CELLS, number)
            deepest = max(deepest, float(part["deepest"]))
            offset = 0
            for place, count, one, other in zip(
                part["tiles"].tolist(), part["counts"].tolist(), part["coarse"], part["field"], strict=True
            ):
                _lay(mass, one, place)
                _lay(field, other, place)
                tiles.append((*place, number, offset, count))
                offset += count
        rows = np.array(tiles, np.int64).reshape(-1, 6)
        rows = rows[np.argsort(morton(rows[:, :3].astype(np.int32)))]
        wide, box = grid.cell * 2.0**grid.march, BoxFrame(np.array(grid.half), np.array(grid.step))
        extinction = (mass / (wide * box.step).prod()).astype(np.float32)
        seen = march_views(extinction, wide, box, default_views("train", size=MARCH_SIZE))
        store.prepare(COARSE)
        store.save(
            COARSE, 0, mean=seen.mean, largest=seen.largest, edge=seen.edge, field=field, deepest=np.array(deepest),
            tiles=rows,
        )  # fmt: skip
        return cls.load(store)

    @classmethod
    def load(cls, store: BlockStore) -> Coarse:
        """Read what `gathered` saved; raise DataError if the file is missing or damaged."""
        part = store.load(COARSE, 0)
        tiles = [Tile((x, y, z), block, offset, cells) for x, y, z, block, offset, cells in part["tiles"].tolist()]
        seen = Visibility(part["mean"], part["largest"], part["edge"])
        return cls(seen, part["field"], float(part["deepest"]), tiles)


def _lay(grid: np.ndarray, part: np.ndarray, place: list[int]) -> None:
    """Copy the cells of a tile into a grid, cropped to the volume."""
    x, y, z = (n * part.shape[0] for n in place)
    target = grid[z : z + part.shape[0], y : y + part.shape[1], x : x + part.shape[2]]
    target[:] = part[: target.shape[0], : target.shape[1], : target.shape[2]]


@dataclass(frozen=True)
class TileTrees:
    """The trees of all tiles, each made when it is needed.

    Attributes:
        store, grid: stored cells, and their grid.
        coarse: summaries of the blocks.
        light: lighting, None for none.
    """

    store: BlockStore
    grid: CellGrid
    coarse: Coarse
    light: Light | None = None

    @property
    def levels(self) -> int | None:
        """Levels above the cells of a tile; None where one tile is all there is, whose tree ends in one cell."""
        return None if len(self.coarse.tiles) == 1 else self.grid.bits

    def tree(self, tile: Tile) -> Tree:
        """Return the tree of a tile; raise DataError if its block is damaged."""
        return build_tree(self._cells(tile), self.coarse.seen, np.array(self.grid.step), self.levels)

    def shaded(self, tile: Tile, tree: Tree, nodes: np.ndarray) -> np.ndarray:
        """Return `lit.shaded` (k, 16 + lights) of rows of a tile's tree."""
        from vvgt_cli.closed_form.lit import base_rows, shaded

        assert self.light is not None
        half, step = np.array(self.grid.half), np.array(self.grid.step)
        return shaded(self.light, half, step, tree.moments, self._normals(tile), *base_rows(tree, nodes))

    def save(self, number: int) -> None:
        """Save the scores of the trees of block ``number``, and the rows of their own cells.

        Scores are two float64 per cell, that which splits its parent and its own, tree after tree.
        """
        sizes, moments, largest, shades, which = [], [], [], [], []
        with (
            atomic_write(self.store.path(TREES, number, SCORES), overwrite=True) as temporary,
            open(temporary, "wb") as stream,
        ):
            for row, tile in enumerate(self.coarse.tiles):
                tree = self.tree(tile) if tile.block == number else None
                if tree is None or not len(tree):
                    continue
                capped = cap_by_ancestors(tree, split_score(tree))
                stream.write(capped[tree.parent].tobytes() + capped.tobytes())
                which.append(row)
                sizes.append((len(tree), int((tree.children == 0).sum())))
                moments.append(tree.moments[-1].copy())  # a view would keep the tree
                largest.append(tree.largest[-1])
                lit = self.light is not None
                shades.append(self.shaded(tile, tree, np.array([len(tree) - 1]))[0] if lit else np.empty(0))
        self.store.save(
            TREES, number, which=np.array(which, np.int64), sizes=np.array(sizes, np.int64).reshape(-1, 2),
            moments=np.array(moments), largest=np.array(largest), shades=np.array(shades),
        )  # fmt: skip

    def _cells(self, tile: Tile) -> Cells:
        moments, local = read_rows(self.store, tile.block, tile.offset, tile.cells)
        index = local + np.array(tile.place, np.int32) * self.grid.tile_cells
        return Cells(index, moments, self.grid.cell_edge, np.array(self.grid.exponent, np.int64))

    def _normals(self, tile: Tile) -> np.ndarray:
        """Return the normals (n, 3) of the base cells of a tile's tree; raise DataError if the file is truncated."""
        path = self.store.path(CELLS, tile.block, NORMALS)
        try:
            whole = np.load(path, mmap_mode="r")[tile.offset : tile.offset + tile.cells]
        except (OSError, ValueError) as error:
            raise DataError(f"{path}: damaged ({error}); remove it and its .npz and run the command again") from error
        found: np.ndarray = whole[shown(self._cells(tile), self.coarse.seen, np.array(self.grid.step))]
        return found


class TiledTree:
    """A pyramid kept tile by tile. Under light, leaves carry the means of `lit.shaded` after their moments.

    Attributes:
        top: the tree over the tiles' own cells, None if nothing is visible.
        tiles: tiles with visible cells, in Morton order, which are the base of ``top``.
    """

    def __init__(self, trees: TileTrees) -> None:
        """Read what `TileTrees.save` left of each block, and build the tree over the tiles' own cells.

        Raises:
            DataError: a block's file is missing or damaged.
        """
        self._trees = trees
        found: dict[int, tuple[Any, ...]] = {}
        for number in sorted({tile.block for tile in trees.coarse.tiles}):
            part, offset = trees.store.load(TREES, number), 0
            for k, (row, (size, base)) in enumerate(zip(part["which"].tolist(), part["sizes"].tolist(), strict=True)):
                found[row] = (size, base, offset), *(part[name][k] for name in ("moments", "largest", "shades"))
                offset += 16 * size
        self.tiles = [trees.coarse.tiles[row] for row in sorted(found)]
        sizes, *columns = ([found[row][k] for row in sorted(found)] for k in range(4))
        self._sizes: list[tuple[int, int, int]] = sizes
        self.top = self._over(*map(np.array, columns)) if found else None

    def _over(self, moments: np.ndarray, largest: np.ndarray, shades: np.ndarray) -> Tree:
        """Return the tree over the tiles' own cells."""

        def fill(rows: np.ndarray, top: np.ndarray) -> None:
            rows[:], top[:] = moments, largest

        places = np.array([tile.place for tile in self.tiles], np.int32)
        grid, single = self._trees.grid, self._trees.levels is None
        edge = self._trees.tree(self.tiles[0]).edge[-1] if single else grid.cell_edge * grid.tile_cells
        top, self._shades = pyramid(places, edge, fill), shades
        self._capped = cap_by_ancestors(top, split_score(top))
        self._above = self._capped[top.parent]
        self._above[-1] = np.inf  # the root appears at any threshold
        return top

    def _leaves(self, row: int, tree: Tree, nodes: np.ndarray) -> Leaves:
        """Return rows of the tree of tile ``row``, or of the top tree."""
        found = leaves_of(tree, nodes)
        if self._trees.light is None:
            return found
        inside = row < len(self.tiles)
        more = self._trees.shaded(self.tiles[row], tree, nodes) if inside else self._shaded_above(nodes)
        return replace(found, moments=np.concatenate([found.moments, more], axis=1))

    def _shaded_above(self, nodes: np.ndarray) -> np.ndarray:
        """Return `lit.shaded` of rows of the top tree: means over tiles, weighted by visibility."""
        from vvgt_cli.closed_form.lit import SEEN_LITTLE, base_rows

        assert self.top is not None, "rows come of a top"
        moments = self.top.moments
        seen = np.maximum(moments[:, SEEN], SEEN_LITTLE * moments[:, MASS])
        pairs = zip(*base_rows(self.top, nodes), strict=True)
        return np.array([np.average(self._shades[a:b], axis=0, weights=seen[a:b]) for a, b in pairs])

    @property
    def base(self) -> int:
        """Number of base cells that some view sees."""
        return sum(base for _, base, _ in self._sizes)

    def _scores_of(self, row: int) -> TileScores:
        """Return the scores of the tree of tile ``row``."""
        size, base, offset = self._sizes[row]
        path = self._trees.store.path(TREES, self.tiles[row].block, SCORES)
        try:
            above, capped = np.fromfile(path, np.float64, 2 * size, offset=offset).reshape(2, size)
        except (OSError, ValueError) as error:
            raise DataError(f"{path}: damaged ({error}); remove it and its .npz and run the command again") from error
        cap = self._capped[row]
        above, capped = np.minimum(above, cap), np.minimum(capped, cap)
        above[-1] = self._above[row]
        return TileScores(above, capped, np.arange(size) >= base)

    def scores(self) -> Iterator[TileScores]:
        """Yield the scores of each tile in turn, then those of the inner cells of the top tree."""
        if self.top is None:
            return
        for row in range(len(self.tiles)):
            yield self._scores_of(row)
        over = slice(len(self.tiles), None)
        yield TileScores(self._above[over], self._capped[over], np.ones(len(self.top) - len(self.tiles), bool))

    def threshold(self, budget: int) -> float:
        """Return the score above which `vvgt_cli.closed_form.tree.select` would split cells for ``budget`` leaves."""
        if self.base <= budget:
            return -np.inf
        counts = np.zeros(BINS, np.int64)  # cells that appear, less those that are split
        for scores in self.scores():
            counts += np.bincount(_bins(scores.above), minlength=BINS)
            counts -= np.bincount(_bins(scores.capped[scores.inner]), minlength=BINS)
        left = np.cumsum(counts[::-1])[::-1]  # leaves if all cells from a bin on are split
        first = int(np.argmax(left <= budget)) if (left <= budget).any() else BINS - 1
        entries, exits = [], []
        for scores in self.scores():
            entries.append(scores.above[_bins(scores.above) == first - 1])
            own = scores.capped[scores.inner]
            exits.append(own[_bins(own) == first - 1])
        entry, exit_ = np.sort(np.concatenate(entries)), np.sort(np.concatenate(exits))
        there = int(left[first]) if first < BINS else 1
        for value in np.unique(exit_):  # ascending: the first that fits leaves the most cells
            more = len(entry) - np.searchsorted(entry, value, "right")
            less = len(exit_) - np.searchsorted(exit_, value, "right")
            if there + more - less <= budget:
                return float(value)
        return float(exit_[-1]) if len(exit_) else np.inf

    def cuts(self, begin: int, end: int, thresholds: np.ndarray, least: bool = True) -> Iterator[list[Leaves]]:
        """Yield, for each of the tiles from ``begin`` to ``end``, the leaves for each of its ``thresholds`` (tiles, n).

        With ``least`` there is always at least the tile's own cell.
        """
        for row in range(begin, end):
            tree, scores = self._trees.tree(self.tiles[row]), self._scores_of(row)
            if least:
                scores.above[-1] = np.inf
            kept = [scores.leaves(value) for value in thresholds[row]]
            yield [self._leaves(row, tree, np.flatnonzero(which)) for which in kept]

    def leaves_over_tiles(self, threshold: float) -> Leaves | None:
        """Return the leaves for a threshold that stand for several tiles each; None if there are none."""
        assert self.top is not None, "there are tiles"
        above, capped = self._above[len(self.tiles) :], self._capped[len(self.tiles) :]
        which = np.flatnonzero((above > threshold) & (capped <= threshold))
        return self._leaves(len(self.tiles), self.top, which + len(self.tiles)) if len(which) else None

    def counts(self, threshold: float) -> np.ndarray:
        """Return the number of leaves for a threshold in each tile, and last that over several tiles."""
        return np.array([int(scores.leaves(threshold).sum()) for scores in self.scores()])


def joined(batch: Sequence[Leaves]) -> Leaves:
    """Concatenate leaves."""
    return Leaves(*(np.concatenate([getattr(part, field) for part in batch]) for field in FIELDS))


def _bins(scores: np.ndarray) -> np.ndarray:
    """Return the histogram bin of each score; bins ascend with scores."""
    bits = np.ascontiguousarray(scores).view(np.int64) >> (52 - FRACTION_BITS)
    result: np.ndarray = np.clip(bits - LOWEST, 0, BINS - 1)
    return result
