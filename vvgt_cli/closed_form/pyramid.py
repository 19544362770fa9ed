"""`Pyramid` turns cells into Gaussians; subclasses keep the cells in memory or on disk, as trees of tiles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vvgt_cli.closed_form.columns import COLUMNS, MASS, SEEN
from vvgt_cli.closed_form.lit import Shading, centroids, colored
from vvgt_cli.closed_form.moments import Cells
from vvgt_cli.closed_form.shape import ROUND, SurfaceStyle, cell_gaussians
from vvgt_cli.closed_form.sharpen import sharpened
from vvgt_cli.closed_form.surface_offset import Opaque
from vvgt_cli.closed_form.tree import Leaves, Tree, build_tree, shown
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
class Pyramid:
    """Cells of a volume with the data of the whole volume that every Gaussian needs; subclasses keep the cells.

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
