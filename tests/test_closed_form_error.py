"""The pyramid cut by the error of pictures."""

import numpy as np
import pytest

from tests.closed_form_scenes import Ramp, scene_of, score
from tests.test_closed_form_tree import some_tree
from vvgt_cli.cameras import default_views
from vvgt_cli.closed_form import VbmOptions, initialise
from vvgt_cli.closed_form.closed_form import FEW, MAX_FACTOR, MIN_FACTOR, SHARED, UNSEEN, scores_by_error, unseen
from vvgt_cli.closed_form.fit import blending_weights
from vvgt_cli.closed_form.tree import select, split_score
from vvgt_cli.dvr import RenderSettings, render_views
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.volume import shapes

BUDGET = 300


@pytest.fixture(scope="module")
def tree():
    return some_tree()


def test_errors_as_foretold_change_nothing(tree) -> None:
    told = split_score(tree)
    ids = select(tree, BUDGET)
    np.testing.assert_allclose(scores_by_error(tree, ids, 7 * told[ids], told), told, rtol=1e-12)
    assert scores_by_error(tree, ids, np.zeros(len(ids)), told) is told


def test_scores_against_sums_cell_by_cell(tree) -> None:
    told, ids = split_score(tree), select(tree, BUDGET)
    errors = np.random.default_rng(0).exponential(told[ids])
    found = scores_by_error(tree, ids, errors, told)
    above = {}  # every cell on the way from those drawn to the root: its sums
    for cell, error in zip(ids, errors, strict=True):
        at = cell
        while True:
            wrong, foretold = above.get(at, (0.0, 0.0))
            above[at] = wrong + error, foretold + told[cell]
            if at == tree.parent[at]:
                break
            at = tree.parent[at]
    root = len(tree) - 1
    mean, prior = above[root][0] / above[root][1], SHARED * above[root][1] / len(ids)

    def factor(cell: int) -> float:
        if cell == root:
            return 1.0
        outer = factor(tree.parent[cell])
        if cell not in above:
            return outer
        wrong, foretold = above[cell]
        return (wrong / mean + prior * outer) / (foretold + prior)

    for cell in np.random.default_rng(1).choice(len(tree), 200, replace=False):
        assert found[cell] == pytest.approx(told[cell] * np.clip(factor(cell), MIN_FACTOR, MAX_FACTOR), rel=1e-9)


def test_cells_go_where_the_error_is(tree) -> None:
    told, ids = split_score(tree), select(tree, BUDGET)
    left = (tree.index[ids] * tree.edge[ids])[:, 0] < np.median((tree.index[ids] * tree.edge[ids])[:, 0])
    new = select(tree, BUDGET, scores_by_error(tree, ids, told[ids] * np.where(left, 9.0, 1.0), told))
    assert len(new) <= BUDGET

    def share(cells: np.ndarray) -> float:
        place = (tree.index[cells] * tree.edge[cells])[:, 0]
        return float((place < np.median((tree.index[ids] * tree.edge[ids])[:, 0])).mean())

    assert share(new) > share(ids) + 0.05


def half_busy() -> np.ndarray:
    """Values (32, 32, 32) that are smooth in one half, and vary eight times as fast in the other."""
    calm, busy = (shapes.random_field(32, cycles=cycles, seed=1).data for cycles in (1, 8))
    return np.concatenate([calm[..., :16], busy[..., 16:]], axis=-1)


def test_other_views_are_nearer_after_a_second_cut() -> None:
    scene = scene_of(shapes.volume_of(half_busy(), "half busy"), Ramp(k=0.3))
    start = initialise(scene, VbmOptions(max_gaussians=1500, size=200))
    rule = INRIA.at(0.5)
    cameras, others = default_views("train", 12, size=100), default_views("test", 4, size=200)
    found = start.form.cut_by_error(
        start.gaussians, cameras, render_views(scene, cameras, RenderSettings(samples=1)), rule
    )
    assert len(found) <= 1500
    truth = render_views(scene, others, RenderSettings())
    assert score(found, others, truth) > score(start.gaussians, others, truth) + 0.1


def test_the_least_seen_go_first() -> None:
    weights = np.array([5.0, 0.01, 3.0, 4.0, 2.0])
    assert unseen(weights, 10).tolist() == [False, True, False, False, False]
    assert unseen(weights, 2).tolist() == [False, True, True, False, True]
    assert not unseen(np.ones(4), 4).any()
    assert unseen(np.empty(0), 4).shape == (0,)


def test_hidden_cells_are_left_out_and_others_cut_for_them() -> None:
    rough = shapes.random_field(40, cycles=10, seed=2).data
    ball = np.where(shapes.sphere(40, hard=True).data > 0, 0.2 + 0.8 * rough, 0).astype(np.float32)
    scene = scene_of(shapes.volume_of(ball, "rough ball"), Ramp(k=4.0))
    start = initialise(scene, VbmOptions(max_gaussians=3000, size=200))
    rule, cameras = INRIA.at(0.5), default_views("train", 12, size=100)
    found = start.form.cut_by_error(
        start.gaussians, cameras, render_views(scene, cameras, RenderSettings(samples=1)), rule
    )

    def hidden(weights: np.ndarray) -> float:
        return float((weights < UNSEEN * weights.mean()).mean())

    before, after = (blending_weights(gaussians, cameras, rule) for gaussians in (start.gaussians, found))
    assert hidden(before) > 0.03
    assert hidden(after) < 0.2 * hidden(before)
    assert 0.95 * 3000 < len(found) <= 3000


def test_where_nearly_all_is_seen_all_cells_stay(monkeypatch) -> None:
    scene = scene_of(shapes.volume_of(half_busy(), "half busy"), Ramp(k=0.3))
    start = initialise(scene, VbmOptions(max_gaussians=1500, size=200))
    rule, cameras = INRIA.at(0.5), default_views("train", 12, size=100)
    weights = blending_weights(start.gaussians, cameras, rule)
    assert 0 < (weights < UNSEEN * weights.mean()).mean() < FEW
    monkeypatch.setattr("vvgt_cli.closed_form.closed_form.blending_weights", None)  # none is looked for
    found = start.form.cut_by_error(
        start.gaussians, cameras, render_views(scene, cameras, RenderSettings(samples=1)), rule
    )
    assert 1490 < len(found) <= 1500
