"""The tree of optical moments of cells (Haar scaling coefficients) and the choice of its cells for a budget."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from vvgt_cli.closed_form.cell_kernels import score_splits, sum_children, take_base
from vvgt_cli.closed_form.columns import BLUE, COLOR, COLUMNS, FIRST, GREEN, MASS, RED, SECOND
from vvgt_cli.closed_form.moments import CHILDREN, Cells, cell_moments, morton
from vvgt_cli.closed_form.visibility import Visibility
from vvgt_cli.dvr.scene import Scene

LEAST_SPREAD = 0.01  # of the range of values, added to that in a cell: noise and places tell little apart
PLAIN = 0.005  # beside the variance of colours: outlines, and what light makes of one colour, show too
EMPTY = 0.5  # how far what is empty is from any label, of the range of their codes
FRACTION_BITS = 9  # mantissa bits of a score that select its bin in the histogram
BINS = 1 << 16
LOWEST = (1023 - 110) << FRACTION_BITS  # exponent 2^-110: smaller scores share the lowest bin
HIDDEN = 1e-3  # cells that no view sees with more transmittance are dropped


@dataclass(frozen=True)
class Tree:
    """Every cell of every scale that holds extinction some view sees; base cells first, the root last.

    Attributes:
        moments: (n, 18) float64 by `columns`: the 13 of `Cells`, then the same cells' seen mass, colour and its square.
        largest: (n,) float64 largest transmittance over the views.
        index: (n, 3) int32 cell indices (x, y, z) from the box's corner, in cells of the row's own size.
        level: (n,) int8 of each cell, 0 for base cells, ascending.
        edges: (levels, 3) float64 edges of the cells of a level, unit-frame lengths.
        first: (n,) int32 first child of each cell; children are contiguous.
        children: (n,) int8 number of children, 0 for base cells.
        parent: (n,) int32, the root its own.
    """

    moments: np.ndarray
    largest: np.ndarray
    index: np.ndarray
    level: np.ndarray
    edges: np.ndarray
    first: np.ndarray
    children: np.ndarray
    parent: np.ndarray

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self.largest)

    @property
    def edge(self) -> np.ndarray:
        """(n, 3) float64 cell edges, unit-frame lengths."""
        return self.edges[self.level]

    @property
    def levels(self) -> list[slice]:
        """The rows of each level, from the base cells up."""
        ends = np.searchsorted(self.level, np.arange(len(self.edges) + 1, dtype=self.level.dtype))
        return [slice(begin, end) for begin, end in pairwise(ends.tolist())]


def build_tree(cells: Cells, seen: Visibility, step: np.ndarray, levels: int | None = None) -> Tree:
    """Sum moments upwards, eight (or fewer) cells at a time; ``step`` is the voxel edge in the unit frame (3,).

    To the first cell that holds all of them, or so many ``levels``.
    """
    through = seen.at(cells.index, cells.edge / step)
    keep = np.flatnonzero(through[:, 1] > HIDDEN)
    return tree_over(
        cells.index[keep],
        cells.edge,
        lambda moments, top: take_base(cells.moments, keep, through, moments, top),
        levels,
    )


def shown(cells: Cells, seen: Visibility, step: np.ndarray) -> np.ndarray:
    """Return rows (n,) int64 of the cells that some view sees: the base of their tree."""
    return np.flatnonzero(seen.at(cells.index, cells.edge / step)[:, 1] > HIDDEN)


def tree_over(
    base: np.ndarray, base_edge: np.ndarray, fill: Callable[[np.ndarray, np.ndarray], None], levels: int | None = None
) -> Tree:
    """Build the tree over cells ``base`` (n, 3) in Morton order, of edges ``base_edge`` (3,).

    ``fill`` is given their moments (n, 18) and largest transmittance (n,) to write.
    """
    codes = [morton(base)]
    starts: list[np.ndarray] = []
    while len(codes[-1]) > 1 if levels is None else len(codes[-1]) > 0 and len(starts) < levels:
        above = codes[-1] >> np.uint64(3)
        starts.append(np.flatnonzero(np.concatenate([[True], above[1:] != above[:-1]])))
        codes.append(above[starts[-1]])
    counts = [len(code) for code in codes]
    total = sum(counts)
    moments, top = np.empty((total, COLUMNS)), np.empty(total)
    index, parent = np.empty((total, 3), np.int32), np.empty(total, np.int32)
    first, children = np.zeros(total, np.int32), np.zeros(total, np.int8)
    fill(moments[: counts[0]], top[: counts[0]])
    index[: counts[0]] = base
    offset = 0
    for level, start in enumerate(starts):
        here = slice(offset, offset + counts[level])
        up = slice(here.stop, here.stop + counts[level + 1])
        sum_children(moments[here], top[here], start, moments[up], top[up])
        index[up] = index[here][start] >> 1
        first[up] = offset + start
        children[up] = np.diff(np.append(start, counts[level]))
        parent[here] = up.start + np.repeat(np.arange(counts[level + 1]), children[up])
        offset = here.stop
    parent[offset:] = np.arange(offset, total)
    height = np.arange(len(counts))
    edges = base_edge * 2.0 ** height[:, None]
    return Tree(moments, top, index, np.repeat(height.astype(np.int8), counts), edges, first, children, parent)


def central(moments: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mass (n,), centroid (n, 3) and covariance (n, 3, 3) of rows of moments."""
    mass = moments[:, MASS]
    mean = moments[:, FIRST] / mass[:, None]
    second = moments[:, SECOND] / mass[:, None]
    cov = np.empty((len(moments), 3, 3))
    for column, (i, j) in enumerate([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]):
        cov[:, i, j] = cov[:, j, i] = second[:, column] - mean[:, i] * mean[:, j]
    return mass, mean, cov


def split_score(tree: Tree, plain: float = PLAIN) -> np.ndarray:
    """Score a cell's spread (n,): saturated mass x visibility x variance x (that of colours + plain).

    The variance of the colours is that of its base cells, by what is seen of them; ``plain``: infinite where colours do
    not count.
    """
    score = np.empty(len(tree))
    for edge, rows in zip(tree.edges, tree.levels, strict=True):
        score_splits(tree.moments[rows], tree.largest[rows], edge, plain, score[rows])
    return score


def value_score(tree: Tree, filled: bool = False) -> np.ndarray:
    """Score as `split_score`, but by the variance of values, not of colours: any function may separate what differs.

    The scene's red is the value, as a share of its range, and its green the square of that. ``filled``: all that is
    visible has the same extinction, what is empty counts as another value, and blue is how much a part counts.
    """
    mass = np.maximum(tree.moments[:, MASS], np.finfo(np.float64).tiny)
    mean, spread = tree.moments[:, RED] / mass, split_score(tree, np.inf)
    result: np.ndarray
    variance = np.maximum(tree.moments[:, GREEN] / mass - mean**2, 0)
    if filled:
        volume = np.prod(tree.edges, axis=1)[tree.level]
        share = tree.moments[:, MASS] / volume
        share = np.minimum(share / max(share.max(initial=0.0), np.finfo(np.float64).tiny), 1)
        weight = tree.moments[:, BLUE] / mass
        result = spread * weight * (share * (variance + (1 - share) * EMPTY**2) + LEAST_SPREAD**2)
        return result
    result = spread * (variance + LEAST_SPREAD**2)
    return result


class Scores(NamedTuple):
    """Scores of cells: that which splits the parent, the cell's own, and whether it has children."""

    above: np.ndarray
    capped: np.ndarray
    inner: np.ndarray

    @classmethod
    def of(cls, tree: Tree, score: np.ndarray) -> Scores:
        """Return scores (n,) of a tree's cells, so that a cell is split only where all above it are."""
        capped = cap_by_ancestors(tree, score)
        above = capped[tree.parent]
        above[-1:] = np.inf  # the root appears at any threshold
        return cls(above, capped, tree.children > 0)

    def leaves(self, threshold: float) -> np.ndarray:
        """Return which cells (n,) are leaves where all with a score above the threshold are split."""
        return (self.above > threshold) & ((self.capped <= threshold) | ~self.inner)


def select(tree: Tree, budget: int, score: np.ndarray | None = None) -> np.ndarray:
    """Choose at most ``budget`` cells that cover the scene, by `split_score` or another ``score`` (n,).

    Returns ids into the tree, ascending.
    """
    if not len(tree) or budget < 1:
        return np.empty(0, np.int64)
    scores = Scores.of(tree, split_score(tree) if score is None else score)
    return np.flatnonzero(scores.leaves(threshold_for(lambda: [scores], budget)))


def threshold_for(scores: Callable[[], Iterable[Scores]], budget: int) -> float:
    """Return the least threshold that leaves at most ``budget`` cells; ``scores`` yields parts of a tree, twice."""
    counts = np.zeros(BINS + 1, np.int64)  # cells that appear, less those that are split
    for part in scores():
        counts += np.bincount(_bins(part.above), minlength=BINS + 1)
        counts -= np.bincount(_bins(part.capped[part.inner]), minlength=BINS + 1)
    left = np.cumsum(counts[::-1])[::-1]  # leaves if all cells from a bin on are split
    first = int(np.argmax(left <= budget))
    if first == 0:
        return -np.inf  # even all base cells fit
    appear, split_up = [], []
    for part in scores():
        own = part.capped[part.inner]
        appear.append(part.above[_bins(part.above) == first - 1])
        split_up.append(own[_bins(own) == first - 1])
    entries, exits = np.sort(np.concatenate(appear)), np.sort(np.concatenate(split_up))
    values = np.unique(exits)
    more = len(entries) - np.searchsorted(entries, values, "right")
    less = len(exits) - np.searchsorted(exits, values, "right")
    fits = np.append(left[first] + more - less <= budget, True)
    return float(np.append(values, np.inf)[np.argmax(fits)])


def _bins(scores: np.ndarray) -> np.ndarray:
    """Return the histogram bin of each score; bins ascend with scores."""
    bits = np.ascontiguousarray(scores).view(np.int64) >> (52 - FRACTION_BITS)
    return np.clip(bits - LOWEST, 0, BINS - 1)


def cap_by_ancestors(tree: Tree, score: np.ndarray) -> np.ndarray:
    """Lower each cell's score to the smallest above it."""
    capped = score.copy()
    for level in tree.levels[-2::-1]:
        capped[level] = np.minimum(capped[level], capped[tree.parent[level]])
    return capped


@dataclass(frozen=True)
class Leaves:
    """Cells that become Gaussians, one each: rows of a tree, or cells below its base.

    Attributes:
        moments: (k, 18), as in `Tree`.
        index: (k, 3) int32, as in `Tree`.
        edge: (k, 3) float64, as in `Tree`.
        node: (k,) int64 row of the tree, -1 below its base.
    """

    moments: np.ndarray
    index: np.ndarray
    edge: np.ndarray
    node: np.ndarray

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self.node)

    def take(self, which: np.ndarray) -> Leaves:
        """Return the rows ``which`` (indices or bool)."""
        return Leaves(self.moments[which], self.index[which], self.edge[which], self.node[which])

    @classmethod
    def joined(cls, parts: Sequence[Leaves]) -> Leaves:
        """Concatenate leaves."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))


def leaves_of(tree: Tree, ids: np.ndarray) -> Leaves:
    """Return the rows ``ids`` of a tree."""
    return Leaves(tree.moments[ids], tree.index[ids], tree.edges[tree.level[ids]], ids)


def spread_of(leaves: Leaves) -> np.ndarray:
    """Return opacity x area of cells, and that x the variance of what is in each, both summed (2,)."""
    mass, _, covariance = central(leaves.moments)
    area = leaves.edge.prod(axis=1) ** (2 / 3)
    weight = -np.expm1(-mass / area) * area
    return np.array([weight.sum(), (weight * np.trace(covariance, axis1=1, axis2=2)).sum()])


def split(tree: Tree, leaves: Leaves, order: np.ndarray, room: int, scene: Scene | None, seen: Visibility) -> Leaves:
    """Replace leaves by their children, in the given order, until ``room`` more leaves are there.

    Children come from the tree, or are integrated below its base from a volume that is there. Leaves without visible
    children stay.
    """
    order = order[: max(room, 0)]  # every split but that of an only child's parent adds one or more
    inside = (leaves.node[order] >= 0) & (tree.children[np.maximum(leaves.node[order], 0)] > 0)
    counts = np.zeros(len(order), np.int64)
    counts[inside] = tree.children[leaves.node[order[inside]]]
    below = np.flatnonzero(~inside)
    if len(below) and scene is not None:
        # integrate no more than can be used: most have at least three visible children
        below = below[: np.searchsorted(np.cumsum(np.where(inside, counts - 1, 2)), room, "right") + 1]
        parent, grown = _children_below(leaves.take(order[below]), scene, seen)
        counts[below] = np.bincount(parent, minlength=len(below))
    else:
        below = below[:0]
    splits = np.flatnonzero(counts > 0)
    splits = splits[: np.searchsorted(np.cumsum(counts[splits] - 1), room, "right")]
    parts = []
    if len(below):
        parts.append(grown.take(np.flatnonzero(np.isin(below[parent], splits))))
    nodes = leaves.node[order[splits[inside[splits]]]]
    many = tree.children[nodes]
    offsets = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many)
    parts.append(leaves_of(tree, np.repeat(tree.first[nodes], many) + offsets))
    kept = np.ones(len(leaves), bool)
    kept[order[splits]] = False
    parts.insert(0, leaves.take(np.flatnonzero(kept)))
    return Leaves.joined(parts)


def _children_below(leaves: Leaves, scene: Scene, seen: Visibility) -> tuple[np.ndarray, Leaves]:
    """Return visible children of cells at or below a tree's base: their parents (n,), ascending, and themselves."""
    step = np.asarray(scene.step)
    parents, children = [], []
    for edge in np.unique(leaves.edge, axis=0):
        chosen = np.flatnonzero((leaves.edge == edge).all(axis=1))
        moments = cell_moments(scene, leaves.index[chosen] * (edge / step), edge / step)  # (n, 8, 13)
        index = 2 * leaves.index[chosen][:, None, :] + CHILDREN  # (n, 8, 3)
        through = seen.at(index.reshape(-1, 3), edge / 2 / step).reshape(-1, 8, 2)
        keep = (moments[..., MASS] > 0) & (through[..., 1] > HIDDEN)
        own, mean = moments[keep], through[keep, 0, None]
        square = (own[:, COLOR] ** 2).sum(axis=1, keepdims=True) / np.maximum(own[:, [MASS]], np.finfo(np.float64).tiny)
        rows = np.concatenate([own, own[:, [MASS, RED, GREEN, BLUE]] * mean, square * mean], axis=1)
        parents.append(np.repeat(chosen, keep.sum(axis=1)))
        children.append(
            Leaves(rows, index[keep], np.broadcast_to(edge / 2, (len(rows), 3)), np.full(len(rows), -1, np.int64))
        )
    parent = np.concatenate(parents)
    order = np.argsort(parent, kind="stable")
    return parent[order], Leaves.joined(children).take(order)
