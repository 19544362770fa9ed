"""The dyadic pyramid of optical moments (Haar scaling coefficients) and the choice of its cells for a budget."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vvgt_cli.vbm.moments import MOMENTS, Cells, morton
from vvgt_cli.vbm.visibility import Visibility

HIDDEN = 1e-3  # cells that no view sees with more transmittance are dropped
COLUMNS = MOMENTS + 4  # moments of tau, then of tau T: 1, r, g, b
SEEN = MOMENTS  # column of the seen mass


@dataclass(frozen=True)
class Tree:
    """Every cell of every scale that holds extinction some view sees; base cells first, the root last.

    Attributes:
        moments: (n, 17) float64: the 13 of `Cells`, then the same cells' seen mass and seen r, g, b
            (weighted by the mean transmittance T over the views).
        largest: (n,) float64 largest transmittance over the views.
        edge: (n, 3) float64 cell edges, unit-frame lengths.
        first: (n,) int64 first child of each cell; children are contiguous.
        children: (n,) int64 number of children, 0 for base cells.
        parent: (n,) int64, the root its own.
    """

    moments: np.ndarray
    largest: np.ndarray
    edge: np.ndarray
    first: np.ndarray
    children: np.ndarray
    parent: np.ndarray

    def __len__(self) -> int:
        return len(self.largest)


def build_tree(cells: Cells, seen: Visibility, step: np.ndarray) -> Tree:
    """Sum moments upwards, eight (or fewer) cells at a time; ``step`` is the voxel edge in the unit frame (3,)."""
    mean, largest = seen.at((cells.index + 0.5) * (cells.edge / step))
    keep = np.flatnonzero(largest > HIDDEN)
    codes = [morton(cells.index[keep])]
    starts = []
    while len(codes[-1]) > 1:
        above = codes[-1] >> np.uint64(3)
        starts.append(np.flatnonzero(np.concatenate([[True], above[1:] != above[:-1]])))
        codes.append(above[starts[-1]])
    counts = [len(code) for code in codes]
    total = sum(counts)
    moments, top = np.empty((total, COLUMNS)), np.empty(total)
    edge, parent = np.empty((total, 3)), np.empty(total, np.int64)
    first, children = np.zeros(total, np.int64), np.zeros(total, np.int64)
    base = moments[: counts[0]]
    np.take(cells.moments, keep, axis=0, out=base[:, :MOMENTS])
    base[:, SEEN] = base[:, 0] * mean[keep]
    base[:, SEEN + 1 :] = base[:, 10:13] * mean[keep, None]
    top[: counts[0]] = largest[keep]
    edge[: counts[0]] = cells.edge
    offset = 0
    for level, start in enumerate(starts):
        here = slice(offset, offset + counts[level])
        up = slice(here.stop, here.stop + counts[level + 1])
        np.add.reduceat(moments[here], start, axis=0, out=moments[up])
        np.maximum.reduceat(top[here], start, out=top[up])
        edge[up] = cells.edge * 2.0 ** (level + 1)
        first[up] = offset + start
        children[up] = np.diff(np.append(start, counts[level]))
        parent[here] = up.start + np.repeat(np.arange(counts[level + 1]), children[up])
        offset = here.stop
    parent[offset:] = np.arange(offset, total)
    return Tree(moments, top, edge, first, children, parent)


def central(moments: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass (n,), centroid (n, 3) and covariance (n, 3, 3) of rows of moments."""
    mass = moments[:, 0]
    mean = moments[:, 1:4] / mass[:, None]
    second = moments[:, 4:10] / mass[:, None]
    cov = np.empty((len(moments), 3, 3))
    for column, (i, j) in enumerate([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]):
        cov[:, i, j] = cov[:, j, i] = second[:, column] - mean[:, i] * mean[:, j]
    return mass, mean, cov


def split_score(tree: Tree) -> np.ndarray:
    """(n,) what a cell's spread costs the image: saturated mass x visibility x variance."""
    m = tree.moments
    mass = m[:, 0]
    area = np.cbrt(tree.edge.prod(axis=1)) ** 2
    variance = (m[:, 4] + m[:, 7] + m[:, 9]) / mass - (m[:, 1:4] ** 2).sum(axis=1) / mass**2
    seen = np.sqrt(tree.largest * m[:, SEEN] / mass)
    return -np.expm1(-mass / area) * area * seen * np.maximum(variance, 0)


def select(tree: Tree, budget: int, score: np.ndarray | None = None) -> np.ndarray:
    """At most ``budget`` cells that cover the scene: split while the score is above a threshold found by search.

    Returns ids into the tree, ascending. A cell is split only where all above it are.
    """
    if not len(tree):
        return np.empty(0, np.int64)
    score = split_score(tree) if score is None else score
    capped = _cap_by_ancestors(tree, score)
    above = capped[tree.parent]
    above[-1] = np.inf  # the root is there at any threshold
    inner = tree.children > 0
    entries, exits = np.sort(above), np.sort(capped[inner])
    # cells that exist at threshold t minus those split further
    thresholds = np.unique(capped)
    exist = len(entries) - np.searchsorted(entries, thresholds, "right")
    split = len(exits) - np.searchsorted(exits, thresholds, "right")
    fits = np.flatnonzero(exist - split <= budget)
    threshold = thresholds[fits[0]] if len(fits) else np.inf
    return np.flatnonzero((above > threshold) & ((capped <= threshold) | ~inner))


def _cap_by_ancestors(tree: Tree, score: np.ndarray) -> np.ndarray:
    """Each cell's score, lowered to the smallest above it."""
    capped = score.copy()
    end = len(tree) - 1
    level = np.array([end])
    while len(level):
        inner = level[tree.children[level] > 0]
        if not len(inner):
            break
        lo, hi = tree.first[inner[0]], tree.first[inner[-1]] + tree.children[inner[-1]]
        level = np.arange(lo, hi)  # a level is contiguous
        capped[lo:hi] = np.minimum(capped[lo:hi], capped[tree.parent[lo:hi]])
    return capped


def split(tree: Tree, ids: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Replace the cells ``ids[which]`` by their children; ids ascending."""
    chosen = ids[which]
    counts = tree.children[chosen]
    inside = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    kept = np.ones(len(ids), bool)
    kept[which] = False
    return np.sort(np.concatenate([ids[kept], np.repeat(tree.first[chosen], counts) + inside]))
