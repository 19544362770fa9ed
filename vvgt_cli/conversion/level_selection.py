"""The selection of a cut of each tile for each level, by measured errors against numbers of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vvgt_cli.gaussians import INRIA, Gaussians, Rule

CUTS = 10
STEP = 4.0  # factor of the score from a cut to the next: a cell's grows as the fourth power of its edge
FEWER = 9  # ratio of Gaussians of a level to the next: three times the edge, on a surface
MAX_LEVELS = 6
LEAST_PRICE, HALVINGS = 1e-12, 60  # price of a Gaussian in squared error, and steps of its bisection
FIELDS = ("counts", "squares", "energies", "pixels")
FEWEST = 4  # mean Gaussians of a node below which no further level is made
SEEN_FROM = ((0.62, 0.54, 0.57), (-0.59, 0.71, -0.38), (0.46, -0.33, -0.82))  # directions along no axis
VIEW_PIXELS = 96  # along an edge of the views by which cuts are compared, more than the cells of a tile
AWAY, MARGIN = 30.0, 1.1  # distance of the camera, and half the field of view, in radii of the node


@dataclass(frozen=True)
class CutErrors:
    """Errors and sizes of the cuts of N nodes; the first cut of each node is the finest.

    Attributes:
        thresholds: (CUTS,) thresholds of scores.
        counts: (N, CUTS) numbers of Gaussians.
        squares: (N, CUTS) squared differences from the finest, RGBA.
        energies: (N,) squared values of the finest.
        pixels: (N,) pixels that the finest covers.
    """

    thresholds: np.ndarray
    counts: np.ndarray
    squares: np.ndarray
    energies: np.ndarray
    pixels: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        """Return (N, CUTS) root mean square errors of a channel over the pixels that a node covers."""
        return np.sqrt(self.squares / np.maximum(4 * self.pixels, 1)[:, None])

    def at_price(self, price: float) -> np.ndarray:
        """Return (N,) cuts with the least sum of squared error and ``price`` per Gaussian."""
        costs = (self.squares + price * self.counts)[:, ::-1]
        return costs.shape[1] - 1 - costs.argmin(axis=1)

    def for_count(self, count: float) -> np.ndarray:
        """Return (N,) cuts of least total squared error with at most ``count`` Gaussians, by one price for all.

        One more Gaussian then lowers the error equally in every node (Shoham and Gersho 1988).
        """
        low, high = LEAST_PRICE, float(self.squares.max(initial=0)) + 1.0  # at the latter the coarsest everywhere
        if self.total(self.at_price(high)) > count or self.total(self.at_price(low)) <= count:
            return self.at_price(high if self.total(self.at_price(high)) > count else low)
        for _ in range(HALVINGS):
            middle = math.sqrt(low * high)
            low, high = (low, middle) if self.total(self.at_price(middle)) <= count else (middle, high)
        return self.at_price(high)

    def total(self, choice: np.ndarray) -> int:
        """Return the number of Gaussians of a choice of cuts."""
        return int(self.counts[np.arange(len(choice)), choice].sum())

    def rms(self, choice: np.ndarray) -> float:
        """Return the root mean square error of a choice of cuts over all nodes."""
        squares = self.squares[np.arange(len(choice)), choice].sum()
        return math.sqrt(squares / max(4 * self.pixels.sum(), 1))

    def levels(self, removed: int = 0) -> list[np.ndarray]:
        """Return the cuts (N,) of each level: the finest, then the best with a ninth of the Gaussians before.

        Args:
            removed: Gaussians that the finest has fewer than the budget, since more would be faint. The next level has
                a ninth of the budget all the same, or the finest again.
        """
        levels = [np.zeros(len(self.counts), np.int64)]
        before = self.total(levels[0]) + removed
        while len(levels) < MAX_LEVELS and before >= FEWEST * len(self.counts):
            further = self.for_count(before / FEWER)
            count = self.total(further)
            if 2 * count > before:
                break
            levels.append(further)
            before = count
        return levels

    def facts(self, row: int, choice: list[int]) -> dict[str, Any]:
        """Return relative squared errors of a node's levels, as splat-transform's `errors`, and RMS errors."""
        energy = max(float(self.energies[row]), 1e-30)
        relative = [float(self.squares[row, index] / energy) for index in choice]
        return {"errors": relative, "rms": [float(self.errors[row, index]) for index in choice]}


def errors_of(nodes: Sequence[Sequence[Gaussians]], rule: str | Rule) -> dict[str, np.ndarray]:
    """Return the fields of `CutErrors` of nodes, each with its cuts, the finest first, drawn by ``rule``."""
    squares, energies, pixels = zip(*(level_errors(cuts, rule) for cuts in nodes), strict=True)
    counts = [[len(gaussians) for gaussians in cuts] for cuts in nodes]
    return dict(zip(FIELDS, map(np.array, (counts, squares, energies, pixels)), strict=True))


def level_errors(cuts: Sequence[Gaussians], rule: str | Rule = INRIA) -> tuple[np.ndarray, float, int]:
    """Measure the RGBA error of each cut of a node, coarser ones later, against the first, drawn by ``rule``.

    Returns:
        (n,) squared differences summed over the pixels of all views, never less than those of a finer cut; the
        squared values of the finest; the number of pixels that it covers.
    """
    from vvgt_cli.cameras.sets import look_at
    from vvgt_cli.splat import render

    finest = cuts[0]
    low, high = finest.means.min(axis=0).astype(np.float64), finest.means.max(axis=0).astype(np.float64)
    middle, widest = (low + high) / 2, float(np.exp(finest.log_scales.max()))
    radius = float(np.linalg.norm(high - low)) / 2 + widest
    field = float(np.degrees(2 * np.arctan(MARGIN / AWAY)))
    squares, covered, differences = 0.0, 0, np.zeros(len(cuts))
    for direction in SEEN_FROM:
        eye = middle + AWAY * radius * np.array(direction) / np.linalg.norm(direction)
        camera = look_at(eye, target=tuple(middle), width=VIEW_PIXELS, height=VIEW_PIXELS, fov=field)
        drawn = [render(cut, camera, rule).astype(np.float64) for cut in cuts]
        covered += int((drawn[0][..., 3] > 1 / 255).sum())
        squares += float((drawn[0] ** 2).sum())
        differences += [float(((picture - drawn[0]) ** 2).sum()) for picture in drawn]
    return np.maximum.accumulate(differences), squares, covered
