"""Cuts of a tiled pyramid by a threshold, as Gaussians in batches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vvgt_cli.cameras.sets import pixel_width
from vvgt_cli.closed_form.columns import COLUMNS
from vvgt_cli.conversion.shards.plan import Plan
from vvgt_cli.gaussians.ply import as_stored

if TYPE_CHECKING:
    from vvgt_cli.closed_form.surface_offset import Opaque
    from vvgt_cli.closed_form.tree import Leaves
    from vvgt_cli.dvr.layout import Light
    from vvgt_cli.field.tiled_tree import TiledTree
    from vvgt_cli.gaussians import Gaussians

BATCH = 1 << 16  # Gaussians in a batch


class Node(NamedTuple):
    """The Gaussians of a tile.

    Attributes:
        levels: Gaussians of each level, box frame.
        spreads: `spread_of` the cells of each level.
        normals: (n, 3) normals of the first level's; None without a light.
    """

    levels: list[Gaussians]
    spreads: list[np.ndarray]
    normals: np.ndarray | None


@dataclass(frozen=True)
class Cut:
    """A pyramid with opaque regions, light and the plan that it is cut for."""

    tiled_tree: TiledTree
    opaque: Opaque
    plan: Plan
    light: Light | None = None

    def gaussians(self, threshold: float) -> Iterator[tuple[Gaussians, np.ndarray | None]]:
        """Yield batches of a threshold's Gaussians, box frame, and of normals (n, 3), None without a light."""
        from vvgt_cli.field.tiled_tree import batches

        for leaves in batches(self.tiled_tree.leaves(threshold), BATCH):
            yield self.make(leaves), self._normals(leaves)

    def nodes(self, thresholds: np.ndarray, begin: int = 0, least: bool = True) -> Iterator[list[Node]]:
        """Yield groups of nodes from ``begin`` on, with a level for each of their ``thresholds`` (tiles, n).

        Tiles are made in groups, since the colours of neighbours depend on each other. So ``begin`` is 0, or where a
        group of an earlier call ended. With ``least`` a level of a tile has at least the tile's own cell.
        """
        from vvgt_cli.closed_form.tree import spread_of
        from vvgt_cli.field.tiled_tree import joined

        waiting: list[list[Leaves]] = []
        for row, leaves in enumerate(self.tiled_tree.cuts(thresholds, begin, least), begin):
            waiting.append(leaves)
            if sum(len(node[0]) for node in waiting) < BATCH and row + 1 < len(self.tiled_tree.tiles):
                continue
            sizes = np.array([[len(leaves) for leaves in node] for node in waiting])
            whole = [self.make(joined([node[k] for node in waiting])) for k in range(sizes.shape[1])]
            made = []
            for node, size, end in zip(waiting, sizes, np.cumsum(sizes, axis=0), strict=True):
                gaussians = [each.take(np.arange(e - n, e)) for each, n, e in zip(whole, size, end, strict=True)]
                made.append(Node(gaussians, [spread_of(leaves) for leaves in node], self._normals(node[0])))
            yield made
            waiting = []

    def make(self, leaves: Leaves) -> Gaussians:
        """Make the Gaussians of cells, one each, in their order."""
        from vvgt_cli.closed_form.columns import MASS, SEEN
        from vvgt_cli.closed_form.lit import colored
        from vvgt_cli.closed_form.shape import ROUND, cell_gaussians
        from vvgt_cli.closed_form.sharpen import sharpened

        lit = self._lit(leaves)
        made = cell_gaussians(leaves, min(self.plan.grid.step), pixel_width(self.plan.size), self.opaque, ROUND)
        if lit is not None and self.light is not None:
            made = colored(made, self.light, lit, self.plan.degree)
        if not self.plan.labels:
            made = sharpened(made, leaves.moments[:, SEEN] / leaves.moments[:, MASS], self.opaque.half)
        return as_stored(made)

    def over_tiles(self, threshold: float) -> Iterator[tuple[Gaussians, np.ndarray | None]]:
        """Yield what `gaussians` yields of cells that stand for several tiles each."""
        leaves = self.tiled_tree.leaves_over_tiles(threshold)
        if leaves is not None:
            yield self.make(leaves), self._normals(leaves)

    def _normals(self, leaves: Leaves) -> np.ndarray | None:
        """Return the normals (n, 3) of cells; None without a light."""
        from vvgt_cli.closed_form.lit import MEAN, directions

        lit = self._lit(leaves)
        return None if lit is None else directions(lit[:, MEAN])

    def _lit(self, leaves: Leaves) -> np.ndarray | None:
        """Return the columns of light that the pyramid appends to moments; None without a light."""
        return None if self.light is None else leaves.moments[:, COLUMNS:]
