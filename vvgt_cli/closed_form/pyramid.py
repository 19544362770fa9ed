"""The pyramid: cells of every scale, tile by tile, the choice of cells for a budget, and their Gaussians.

The cells of each tile form a tree that ends in the tile's own cell; these roots are the base of a top tree. A volume
whose cells are in memory is one tile.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from vvgt_cli.closed_form.columns import COLUMNS, MASS, SEEN
from vvgt_cli.closed_form.lit import Shading, centroids, colored
from vvgt_cli.closed_form.moments import Cells
from vvgt_cli.closed_form.shape import ROUND, SurfaceStyle, cell_gaussians
from vvgt_cli.closed_form.sharpen import sharpened
from vvgt_cli.closed_form.surface_offset import Opaque
from vvgt_cli.closed_form.tree import (
    Leaves,
    Scores,
    Tree,
    build_tree,
    leaves_of,
    shown,
    split_score,
    threshold_for,
    tree_over,
)
from vvgt_cli.closed_form.visibility import Visibility
from vvgt_cli.gaussians import Gaussians


class Tile(NamedTuple):
    """The tree of a tile, and the normals (n, 3) at the centroids of its base cells; None without light."""

    tree: Tree
    normals: np.ndarray | None

    @classmethod
    def of(
        cls, cells: Cells, seen: Visibility, step: np.ndarray, levels: int | None = None, shading: Shading | None = None
    ) -> Tile:
        """Build a tile of base cells; arguments as of `build_tree`. Cells without normals get those of ``shading``."""
        normals = None if cells.normals is None else cells.normals[shown(cells, seen, step)]
        tree = build_tree(cells, seen, step, levels)
        if shading is not None and normals is None:
            normals = shading.normals(centroids(tree.moments[: int((tree.children == 0).sum())]))
        return cls(tree, normals)


@dataclass(frozen=True)
class Pyramid(ABC):
    """The cells of a volume, with what their Gaussians need of all of it; subclasses keep the tiles.

    Attributes:
        seen: visibility of cells from the training views.
        opaque: regions where bodies are opaque.
        half, step: (3,) half extents and voxel edges, unit frame.
        pixel: width of a pixel at the centre, unit frame.
        labels: whether all layers are label maps.
        shading: the light, None for none.
        degree: degree of the harmonics of colours under a light that depends on the view.
    """

    seen: Visibility
    opaque: Opaque
    half: np.ndarray
    step: np.ndarray
    pixel: float
    labels: bool = False
    shading: Shading | None = None
    degree: int = 0

    @abstractmethod
    def roots(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return own cells of the tiles that some view sees: places (n, 3), edge (3,), moments, largest of `Tree`."""

    @abstractmethod
    def tile(self, row: int) -> Tile:
        """Return a tile."""

    @abstractmethod
    def scores_of(self, row: int) -> Scores:
        """Return the scores of a tile's cells, as if it were alone."""

    @cached_property
    def top(self) -> Tree:
        """The tree over the tiles' own cells."""
        places, edge, own, seen = self.roots()

        def fill(moments: np.ndarray, largest: np.ndarray) -> None:
            moments[:], largest[:] = own, seen

        return tree_over(places, edge, fill)

    @cached_property
    def _top_scores(self) -> Scores:
        return Scores.of(self.top, split_score(self.top))

    def __len__(self) -> int:
        """Return the number of tiles."""
        return int((self.top.children == 0).sum())

    def _scores(self, row: int) -> Scores:
        """Return the scores of a tile's cells, at most those of the cells above."""
        (above, capped, inner), top = self.scores_of(row), self._top_scores
        above, capped = np.minimum(above, top.capped[row]), np.minimum(capped, top.capped[row])
        above[-1] = top.above[row]
        return Scores(above, capped, inner)

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

    def shaded(self, leaves: Leaves, tile: Tile) -> Leaves:
        """Return leaves of a tile with the means of light, if any, after their moments."""
        if self.shading is None or tile.normals is None:
            return leaves
        means = self.shading.lit(tile.tree, leaves, tile.normals)
        return replace(leaves, moments=np.concatenate([leaves.moments, means], axis=1))

    def gaussians_of(self, leaves: Leaves, style: SurfaceStyle = ROUND) -> Gaussians:
        """Return the Gaussians of shaded leaves, one each."""
        return self.sharpened(leaves, self.blurred(leaves, style))

    def blurred(self, leaves: Leaves, style: SurfaceStyle = ROUND) -> Gaussians:
        """Return the Gaussians of shaded leaves with the colours of their cells."""
        gaussians = cell_gaussians(leaves, float(self.step.min()), self.pixel, self.opaque, style)
        if self.shading is None:
            return gaussians
        return colored(gaussians, self.shading.light, leaves.moments[:, COLUMNS:], self.degree)

    def sharpened(self, leaves: Leaves, gaussians: Gaussians) -> Gaussians:
        """Apply `sharpened`, but not to labels: each is of one colour, and may be written to a file of its own."""
        if self.labels:
            return gaussians
        return sharpened(gaussians, leaves.moments[:, SEEN] / leaves.moments[:, MASS], self.half)
