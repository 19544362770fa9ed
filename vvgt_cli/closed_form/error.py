"""A pyramid cut where pictures of the closed form are wrong: the budget goes where the error is."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vvgt_cli.closed_form.tree import Tree

LEAST, MOST = 0.25, 30.0  # times the mean that an error counts at a score: what is flat keeps cells for other views
UNSEEN = 0.08  # of the mean blending weight in views: Gaussians below are hidden (0.1: fogs lose, 0.05: less gain)
SHARED = 1.0  # mean scores that the cells above count for: an error of few pixels says little


def scores_by_error(tree: Tree, ids: np.ndarray, errors: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Scale scores of splits by the ratio of the pictures' errors to those that the scores predicted.

    Args:
        tree: the pyramid.
        ids: (k,) cells that were drawn, one Gaussian each: a cut of the tree.
        errors: (k,) >= 0, what the pictures have of each, in any unit.
        score: (n,) of every cell, by `tree.split_score`.

    Returns:
        (n,) new scores for `tree.select`. A cell's factor is the sum of errors over that of scores of the cells drawn
        within it, drawn towards its parent's; cells below one that was drawn have its factor. Errors in proportion to
        the scores change nothing.
    """
    wrong, predicted = np.zeros(len(tree)), np.zeros(len(tree))
    wrong[ids], predicted[ids] = errors, score[ids]
    levels = list(_levels(tree))
    for level in levels[:0:-1]:
        parents = tree.parent[level]
        for sums in (wrong, predicted):
            sums[parents[0] : parents[-1] + 1] += np.bincount(parents - parents[0], sums[level])
    if not (wrong[-1] > 0 and predicted[-1] > 0):
        return score
    factor, mean = np.ones(len(tree)), wrong[-1] / predicted[-1]
    prior = SHARED * predicted[-1] / len(ids)
    for level in levels[1:]:
        above = factor[tree.parent[level]]
        factor[level] = np.where(
            predicted[level] > 0, (wrong[level] / mean + prior * above) / (predicted[level] + prior), above
        )
    result: np.ndarray = score * np.clip(factor, LEAST, MOST)
    return result


def unseen(weights: np.ndarray, most: int) -> np.ndarray:
    """Return (n,) bool: whose blending ``weights`` (n,) are below `UNSEEN`, or not among the ``most`` largest."""
    found: np.ndarray = weights < UNSEEN * weights.mean() if len(weights) else np.zeros(0, bool)
    found[np.argsort(weights, kind="stable")[: max(len(weights) - most, 0)]] = True
    return found


def _levels(tree: Tree) -> Iterator[np.ndarray]:
    """Yield the rows of each level, which lie together, from the root down."""
    level = np.array([len(tree) - 1])
    while True:
        yield level
        inner = level[tree.children[level] > 0]
        if not len(inner):
            return
        level = np.arange(tree.first[inner[0]], tree.first[inner[-1]] + tree.children[inner[-1]])
