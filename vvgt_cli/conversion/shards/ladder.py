"""Which cut of each node a level takes: what ever coarser cuts cost is measured, and weighed against Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.conversion.shards.apart import errors_apart

if TYPE_CHECKING:
    from vvgt_cli.conversion.shards.cut import Cut
    from vvgt_cli.field.block_store import BlockStore

RUNGS = 10
STEP = 4.0  # times the score from a rung to the next: a cell's grows as the fourth power of its edge
FEWER = 9  # times fewer Gaussians from a level to the next: three times the edge, on a surface
MOST_LEVELS = 6
LEAST_PRICE, HALVINGS = 1e-12, 60  # of a Gaussian, in squared error; steps of its bisection
FIELDS = ("counts", "squares", "energies", "pixels")
FEWEST = 4  # Gaussians a node, on average, below which no further level is made


@dataclass(frozen=True)
class Ladder:
    """What cuts of N nodes cost; the first of each node is the finest.

    Attributes:
        thresholds: (RUNGS,) of scores.
        counts: (N, RUNGS) Gaussians.
        squares: (N, RUNGS) squared differences from the finest, RGBA.
        energies: (N,) squares of the finest.
        pixels: (N,) that it covers.
    """

    thresholds: np.ndarray
    counts: np.ndarray
    squares: np.ndarray
    energies: np.ndarray
    pixels: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        """(N, RUNGS) root mean square of a channel over the pixels that a node covers."""
        found: np.ndarray = np.sqrt(self.squares / np.maximum(4 * self.pixels, 1)[:, None])
        return found

    def at_price(self, price: float) -> np.ndarray:
        """(N,) the rung of each node whose squared error and ``price`` a Gaussian add up to the least."""
        costs = (self.squares + price * self.counts)[:, ::-1]
        found: np.ndarray = costs.shape[1] - 1 - costs.argmin(axis=1)
        return found

    def for_count(self, count: float) -> np.ndarray:
        """(N,) rungs of the least squared error in all that one price leaves, with at most ``count`` Gaussians.

        One more Gaussian then lowers the error by as much in every node (Shoham and Gersho 1988).
        """
        low, high = LEAST_PRICE, float(self.squares.max(initial=0)) + 1.0  # at the latter the coarsest everywhere
        if self.total(self.at_price(high)) > count or self.total(self.at_price(low)) <= count:
            return self.at_price(high if self.total(self.at_price(high)) > count else low)
        for _ in range(HALVINGS):
            middle = math.sqrt(low * high)
            low, high = (low, middle) if self.total(self.at_price(middle)) <= count else (middle, high)
        return self.at_price(high)

    def total(self, rungs: np.ndarray) -> int:
        """Gaussians of a choice."""
        return int(self.counts[np.arange(len(rungs)), rungs].sum())

    def rms(self, rungs: np.ndarray) -> float:
        """Root mean square error of a choice over all nodes."""
        squares = self.squares[np.arange(len(rungs)), rungs].sum()
        return math.sqrt(squares / max(4 * self.pixels.sum(), 1))

    def levels(self) -> list[np.ndarray]:
        """Rungs (N,) of each level: the finest, and the best with a ninth of the Gaussians of the level before."""
        found = [np.zeros(len(self.counts), np.int64)]
        before = self.total(found[0])
        while len(found) < MOST_LEVELS and before >= FEWEST * len(self.counts):
            further = self.for_count(before / FEWER)
            count = self.total(further)
            if 2 * count > before:
                break
            found.append(further)
            before = count
        return found

    def facts(self, row: int, rungs: list[int]) -> dict[str, Any]:
        """Of a node's levels: the squared error of the squares, as splat-transform's `errors`; and our `errors`."""
        energy = max(float(self.energies[row]), 1e-30)
        relative = [float(self.squares[row, rung] / energy) for rung in rungs]
        return {"errors": relative, "rms": [float(self.errors[row, rung]) for rung in rungs]}


def measured(cut: Cut, store: BlockStore, kind: str) -> Ladder:
    """Make and draw `RUNGS` cuts of every node; what an interrupted run has left in ``store`` is taken as it is.

    Raises:
        DataError: a part is damaged.
    """
    tiled_tree = cut.tiled_tree
    finest = tiled_tree.threshold(cut.plan.budget)
    second = max(tiled_tree.threshold(max(tiled_tree.count(finest) // 2, 1)), np.finfo(float).tiny)
    values = np.array([finest, *(second * STEP ** np.arange(RUNGS - 1))])
    values = np.minimum(values, np.finfo(float).max)
    found: list[dict[str, Any]] = []
    store.prepare(kind)
    while not store.missing(kind, [done := sum(len(some["pixels"]) for some in found)]):
        found.append(store.load(kind, done))
    for nodes in cut.nodes(np.tile(values, (len(tiled_tree.tiles), 1)), done):
        squares, energies, pixels = zip(*(errors_apart(made) for made, _ in nodes), strict=True)
        counts = [[len(gaussians) for gaussians in made] for made, _ in nodes]
        arrays = map(np.array, (counts, squares, energies, pixels))
        some: dict[str, Any] = dict(zip(FIELDS, arrays, strict=True))
        store.save(kind, done, **some)
        found.append(some)
        done += len(nodes)
    return Ladder(values, **{name: np.concatenate([some[name] for some in found]) for name in FIELDS})
