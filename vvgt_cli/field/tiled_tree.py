"""The pyramid over all tiles, with only the top level in memory, and the selection of its cells for a budget.

The cells of each tile form a tree that ends in the tile's own cell; these roots are the leaves of a top tree. Scores
are kept in a file, two numbers per cell, so that a threshold is found without the moments.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vvgt_cli.closed_form.columns import MASS, SEEN
from vvgt_cli.closed_form.moments import Cells, morton
from vvgt_cli.closed_form.tree import (
    Leaves,
    Tree,
    build_tree,
    cap_by_ancestors,
    leaves_of,
    pyramid,
    shown,
    split_score,
)
from vvgt_cli.closed_form.visibility import Visibility
from vvgt_cli.dvr.layout import Light
from vvgt_cli.errors import DataError
from vvgt_cli.field.block_store import CELLS, BlockStore
from vvgt_cli.field.cells import NORMALS, read_rows
from vvgt_cli.field.grid import CellGrid

FRACTION_BITS = 9  # mantissa bits of a score that select its bin in the histogram
BINS = 1 << 16
LOWEST = (1023 - 110) << FRACTION_BITS  # exponent 2^-110: smaller scores share the lowest bin
FIELDS = ("moments", "index", "edge", "node")


class Tile(NamedTuple):
    """Location of a tile's cells: place (x, y, z), block, offset within the block's cells, and count."""

    place: tuple[int, int, int]
    block: int
    offset: int
    cells: int


class Scores(NamedTuple):
    """Scores of cells: that which splits the parent, the cell's own, and whether it has children."""

    above: np.ndarray
    capped: np.ndarray
    inner: np.ndarray


@dataclass(frozen=True)
class Coarse:
    """The summaries of all blocks, held in memory.

    Attributes:
        mass: (nz, ny, nx) float64 optical mass, in cells of the visibility march.
        field: (nz, ny, nx) float32 opacity.
        deepest: largest opacity of a base cell.
        tiles: all tiles, in Morton order.
    """

    mass: np.ndarray
    field: np.ndarray
    deepest: float
    tiles: list[Tile]


def gather(store: BlockStore, grid: CellGrid) -> Coarse:
    """Merge the summaries of all blocks.

    Raises:
        DataError: a block is missing or damaged.
    """
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
            tiles.append(Tile(tuple(place), number, offset, count))
            offset += count
    order = np.argsort(morton(np.array([tile.place for tile in tiles], np.int32).reshape(-1, 3)))
    return Coarse(mass, field, deepest, [tiles[k] for k in order])


def _lay(grid: np.ndarray, part: np.ndarray, place: list[int]) -> None:
    """Copy the cells of a tile into a grid, cropped to the volume."""
    x, y, z = (n * part.shape[0] for n in place)
    target = grid[z : z + part.shape[0], y : y + part.shape[1], x : x + part.shape[2]]
    target[:] = part[: target.shape[0], : target.shape[1], : target.shape[2]]


class TiledTree:
    """A pyramid kept tile by tile. Under light, leaves carry the means of `lit.shaded` after their moments.

    Attributes:
        top: the tree over the tiles' own cells, None if nothing is visible.
        tiles: tiles with visible cells, in Morton order, which are the base of ``top``.
        cells: number of cells in all trees, base cells included.
    """

    def __init__(
        self, store: BlockStore, grid: CellGrid, seen: Visibility, coarse: Coarse, scratch: Path,
        light: Light | None = None,
    ) -> None:  # fmt: skip
        """Build each tile's tree in turn and write its scores to ``scratch``."""
        self._store, self._grid, self._seen, self._scratch, self._light = store, grid, seen, scratch, light
        self._levels = None if len(coarse.tiles) == 1 else grid.bits
        self.tiles: list[Tile] = []
        self._sizes: list[tuple[int, int]] = []  # cells and base cells of each tree
        moments, largest = [], []
        self._shades: list[np.ndarray] = []  # of each tile's own cell, if lit
        with open(scratch, "wb") as stream:
            for tile in coarse.tiles:
                tree = self._tree(tile)
                if not len(tree):
                    continue
                capped = cap_by_ancestors(tree, split_score(tree))
                stream.write(capped[tree.parent].tobytes() + capped.tobytes())
                self.tiles.append(tile)
                self._sizes.append((len(tree), int((tree.children == 0).sum())))
                moments.append(tree.moments[-1].copy())  # a view would keep the tree
                largest.append(tree.largest[-1])
                if light is not None:
                    self._shades.append(self._shaded(tile, tree, np.array([len(tree) - 1]))[0])
        self.cells = sum(size for size, _ in self._sizes)
        self.top: Tree | None = None
        if self.tiles:
            self._over(np.array(moments), np.array(largest))

    def _over(self, moments: np.ndarray, largest: np.ndarray) -> None:
        """Build the tree over the tiles' own cells."""

        def fill(rows: np.ndarray, top: np.ndarray) -> None:
            rows[:], top[:] = moments, largest

        places = np.array([tile.place for tile in self.tiles], np.int32)
        grid = self._grid
        edge = self._tree(self.tiles[0]).edge[-1] if self._levels is None else grid.cell_edge * grid.tile_cells
        self.top = pyramid(places, edge, fill)
        self._capped = cap_by_ancestors(self.top, split_score(self.top))
        self._above = self._capped[self.top.parent]
        self._above[-1] = np.inf  # the root appears at any threshold

    def _tree(self, tile: Tile) -> Tree:
        return build_tree(self._cells(tile), self._seen, np.array(self._grid.step), self._levels)

    def _cells(self, tile: Tile) -> Cells:
        moments, local = read_rows(self._store, tile.block, tile.offset, tile.cells)
        index = local + np.array(tile.place, np.int32) * self._grid.tile_cells
        return Cells(index, moments, self._grid.cell_edge, np.array(self._grid.exponent, np.int64))

    def _normals(self, tile: Tile) -> np.ndarray:
        """Return the normals (n, 3) of the base cells of a tile's tree.

        Raises:
            DataError: the file is truncated.
        """
        path = self._store.path(CELLS, tile.block, NORMALS)
        try:
            whole = np.load(path, mmap_mode="r")[tile.offset : tile.offset + tile.cells]
        except (OSError, ValueError) as error:
            raise DataError(f"{path}: damaged ({error}); remove it and its .npz and run the command again") from error
        found: np.ndarray = whole[shown(self._cells(tile), self._seen, np.array(self._grid.step))]
        return found

    def _shaded(self, tile: Tile, tree: Tree, nodes: np.ndarray) -> np.ndarray:
        """Return `lit.shaded` (k, 16 + lights) of rows of a tile's tree."""
        from vvgt_cli.closed_form.lit import base_rows, shaded

        assert self._light is not None
        half, step = np.array(self._grid.half), np.array(self._grid.step)
        return shaded(self._light, half, step, tree.moments, self._normals(tile), *base_rows(tree, nodes))

    def _leaves(self, row: int, tree: Tree, nodes: np.ndarray) -> Leaves:
        """Return rows of the tree of tile ``row``, or of the top tree."""
        found = leaves_of(tree, nodes)
        if self._light is None:
            return found
        more = self._shaded(self.tiles[row], tree, nodes) if row < len(self.tiles) else self._shaded_above(nodes)
        return replace(found, moments=np.concatenate([found.moments, more], axis=1))

    def _shaded_above(self, nodes: np.ndarray) -> np.ndarray:
        """Return `_shaded` of rows of the top tree: means over tiles, weighted by visibility."""
        from vvgt_cli.closed_form.lit import SEEN_LITTLE, base_rows

        assert self.top is not None, "rows come of a top"
        moments, shades = self.top.moments, np.array(self._shades)
        seen = np.maximum(moments[:, SEEN], SEEN_LITTLE * moments[:, MASS])
        pairs = zip(*base_rows(self.top, nodes), strict=True)
        return np.array([np.average(shades[a:b], axis=0, weights=seen[a:b]) for a, b in pairs])

    @property
    def base(self) -> int:
        """Number of base cells that some view sees."""
        return sum(base for _, base in self._sizes)

    def scores(self) -> Iterator[Scores]:
        """Yield the scores of each tile in turn, then those of the inner cells of the top tree."""
        if self.top is None:
            return
        with open(self._scratch, "rb") as stream:
            for row, (size, base) in enumerate(self._sizes):
                above, capped = np.frombuffer(stream.read(16 * size)).reshape(2, size)
                cap = self._capped[row]
                above, capped = np.minimum(above, cap), np.minimum(capped, cap)
                above[-1] = self._above[row]
                yield Scores(above, capped, np.arange(size) >= base)
        over = slice(len(self.tiles), None)
        yield Scores(self._above[over], self._capped[over], np.ones(len(self.top) - len(self.tiles), bool))

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

    def leaves(self, threshold: float) -> Iterator[Leaves]:
        """Yield the leaves for a threshold, tile by tile, those of the top tree last."""
        for row, scores in enumerate(self.scores()):
            which = np.flatnonzero((scores.above > threshold) & ((scores.capped <= threshold) | ~scores.inner))
            if not len(which):
                continue
            if row < len(self.tiles):
                yield self._leaves(row, self._tree(self.tiles[row]), which)
            else:
                yield self._over_tiles(which)

    def leaves_over_tiles(self, threshold: float) -> Leaves | None:
        """Return the leaves for a threshold that stand for several tiles each; None if there are none."""
        assert self.top is not None, "there are tiles"
        above, capped = self._above[len(self.tiles) :], self._capped[len(self.tiles) :]
        which = np.flatnonzero((above > threshold) & (capped <= threshold))
        return self._over_tiles(which) if len(which) else None

    def _over_tiles(self, which: np.ndarray) -> Leaves:
        assert self.top is not None, "scores come of a top"
        return self._leaves(len(self.tiles), self.top, which + len(self.tiles))

    def cuts(self, thresholds: np.ndarray, begin: int = 0, least: bool = True) -> Iterator[list[Leaves]]:
        """Yield, per tile from ``begin`` on, the leaves for each of its ``thresholds`` (tiles, n).

        With ``least`` there is always at least the tile's own cell.
        """
        for row, scores in enumerate(self.scores()):
            if row == len(self.tiles):
                return
            if row < begin:
                continue
            tree, above = self._tree(self.tiles[row]), scores.above.copy()
            if least:
                above[-1] = np.inf
            kept = [(above > value) & ((scores.capped <= value) | ~scores.inner) for value in thresholds[row]]
            yield [self._leaves(row, tree, np.flatnonzero(which)) for which in kept]

    def count(self, threshold: float) -> int:
        """Return the number of leaves for a threshold."""
        return sum(int(((s.above > threshold) & ((s.capped <= threshold) | ~s.inner)).sum()) for s in self.scores())


def batches(leaves: Iterator[Leaves], size: int) -> Iterator[Leaves]:
    """Regroup leaves into batches of at least ``size``."""
    waiting: list[Leaves] = []
    for part in leaves:
        waiting.append(part)
        if sum(map(len, waiting)) >= size:
            yield joined(waiting)
            waiting = []
    if waiting:
        yield joined(waiting)


def joined(batch: Sequence[Leaves]) -> Leaves:
    """Concatenate leaves."""
    return Leaves(*(np.concatenate([getattr(part, field) for part in batch]) for field in FIELDS))


def _bins(scores: np.ndarray) -> np.ndarray:
    """Return the histogram bin of each score; bins ascend with scores."""
    bits = np.ascontiguousarray(scores).view(np.int64) >> (52 - FRACTION_BITS)
    result: np.ndarray = np.clip(bits - LOWEST, 0, BINS - 1)
    return result
