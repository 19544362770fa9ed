"""The selection of a cut of each node for each level, by measured errors against numbers of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.conversion.stages.closed_form import FAINT_LOGIT
from vvgt_cli.field.digests import digest
from vvgt_cli.gaussians.rules import INRIA, Rule

if TYPE_CHECKING:
    from vvgt_cli.conversion.shards.cut import Cut, Regions
    from vvgt_cli.field.blocked import Pass
    from vvgt_cli.gaussians import Gaussians


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
        found: np.ndarray = np.sqrt(self.squares / np.maximum(4 * self.pixels, 1)[:, None])
        return found

    def at_price(self, price: float) -> np.ndarray:
        """Return (N,) cuts with the least sum of squared error and ``price`` per Gaussian."""
        costs = (self.squares + price * self.counts)[:, ::-1]
        found: np.ndarray = costs.shape[1] - 1 - costs.argmin(axis=1)
        return found

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
        found = [np.zeros(len(self.counts), np.int64)]
        before = self.total(found[0]) + removed
        while len(found) < MAX_LEVELS and before >= FEWEST * len(self.counts):
            further = self.for_count(before / FEWER)
            count = self.total(further)
            if 2 * count > before:
                break
            found.append(further)
            before = count
        return found

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


@dataclass(frozen=True)
class ErrorRegions:
    """The task of drawing the cuts of every node of a region.

    Attributes:
        cut: pyramid to cut.
        regions: division of its tiles.
        values: thresholds of the cuts, the finest first.
    """

    cut: Cut
    regions: Regions
    values: np.ndarray

    @property
    def kind(self) -> str:
        """Kind of the results."""
        return f"errors-{digest(self.cut.key, self.values)[:16]}"

    def __len__(self) -> int:
        """Return the number of regions."""
        return len(self.regions.ends)

    def __call__(self, number: int) -> None:
        """Save the errors of the nodes of region ``number``."""
        thresholds = np.broadcast_to(self.values, (len(self.cut.pyramid), CUTS))
        nodes = self.cut.nodes(*self.regions.rows(number), thresholds)
        found = errors_of([node.levels for node in nodes], self.cut.plan.ply.rule or INRIA)
        faint = sum(int((node.levels[0].opacity_logits < FAINT_LOGIT).sum()) for node in nodes)
        self.cut.store.save(self.kind, number, ".npz", faint=np.array(faint), **found)


def measure_cuts(run_pass: Pass, cut: Cut, budget: int) -> tuple[CutErrors, int]:
    """Make and draw `CUTS` cuts of every node, or reuse an interrupted run's.

    Args:
        run_pass: runs the pass over the regions.
        cut: pyramid to cut.
        budget: largest number of Gaussians of the finest cut.

    Returns:
        The errors; and how many Gaussians of the finest cut are faint (`FAINT_LOGIT`).

    Raises:
        DataError: a block is damaged.
    """
    tree, store = cut.pyramid, cut.store
    finest = tree.threshold(budget)
    second = max(tree.threshold(max(int(tree.counts(finest).sum()) // 2, 1)), np.finfo(float).tiny)
    values = np.array([finest, *(second * STEP ** np.arange(CUTS - 1))])
    task = ErrorRegions(cut, cut.regions(finest), np.minimum(values, np.finfo(float).max))
    run_pass(task, "errors")
    parts = [store.load(task.kind, number) for number in range(len(task))]
    found = CutErrors(task.values, **{name: np.concatenate([part[name] for part in parts]) for name in FIELDS})
    return found, sum(int(part["faint"]) for part in parts)


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
