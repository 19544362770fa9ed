"""Visibility, the pyramid of moments and its cuts."""

import itertools
import math

import numpy as np
import pytest

from tests.closed_form_scenes import Above, Ramp, Tent, scene_of
from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.closed_form import visibility as visibility_module
from vvgt_cli.closed_form.columns import COLOR, COLUMNS, SEEN
from vvgt_cli.closed_form.moments import base_cells, morton
from vvgt_cli.closed_form.tree import PLAIN, Leaves, Tree, build_tree, central, leaves_of, select, split, split_score
from vvgt_cli.closed_form.visibility import Visibility, march, visibility
from vvgt_cli.dvr import Scene
from vvgt_cli.volume import Volume, shapes

FAR = 200.0  # rays of a camera this far away are parallel to 0.3 degrees


def far_view(axis: int, sign: float = 1.0):
    eye = np.zeros(3)
    eye[axis] = sign * FAR
    return look_at(eye, width=128, height=128, fov=math.degrees(2 * math.atan(1 / FAR)))


def some_tree(size=(20, 13, 17), tf=None, level: int = 0, seed: int = 1) -> Tree:
    scene = scene_of(shapes.random_field(size, cycles=4, seed=seed), tf or Tent())
    cells = base_cells(scene, np.full(3, level))
    return build_tree(cells, visibility(scene, cells, default_views("train", 6, size=48)), scene.step)


@pytest.fixture(scope="module")
def tree() -> Tree:
    return some_tree()


def test_morton_interleaves_and_orders() -> None:
    rng = np.random.default_rng(0)
    index = rng.integers(0, 1 << 21, (500, 3))
    index[:3] = [[0, 0, 0], [(1 << 21) - 1] * 3, [1, 2, 4]]
    expected = [sum((int(row[a]) >> b & 1) << (3 * b + a) for a in range(3) for b in range(21)) for row in index]
    assert morton(index).tolist() == expected
    np.testing.assert_array_equal(morton(index >> 1), morton(index) >> np.uint64(3))


def test_pyramid_is_one_tree(tree: Tree) -> None:
    count = len(tree)
    root = count - 1
    assert tree.parent[root] == root
    assert (tree.parent[:root] > np.arange(root)).all()
    assert (tree.children <= 8).all()
    assert tree.children.sum() == root  # every cell but the root is somebody's child, once
    inner = np.flatnonzero(tree.children)
    for cell in inner:
        np.testing.assert_array_equal(tree.parent[tree.first[cell] : tree.first[cell] + tree.children[cell]], cell)
    base = np.flatnonzero(tree.children == 0)
    np.testing.assert_array_equal(base, np.arange(len(base)))
    assert base[-1] < inner[0]
    np.testing.assert_allclose(tree.edge[inner], 2 * tree.edge[tree.first[inner]])


def test_moments_add_up(tree: Tree) -> None:
    """Parent = sum of children; so every level holds all the mass."""
    sums = np.zeros((len(tree), COLUMNS))
    np.add.at(sums, tree.parent[:-1], tree.moments[:-1])
    inner = tree.children > 0
    np.testing.assert_allclose(sums[inner], tree.moments[inner], rtol=1e-9, atol=1e-12)
    largest = np.zeros(len(tree))
    np.maximum.at(largest, tree.parent[:-1], tree.largest[:-1])
    np.testing.assert_array_equal(largest[inner], tree.largest[inner])
    np.testing.assert_allclose(tree.moments[~inner].sum(axis=0), tree.moments[-1], rtol=1e-9, atol=1e-12)


def test_central_moments(tree: Tree) -> None:
    mass, mean, cov = central(tree.moments)
    assert (mass > 0).all()
    assert np.linalg.eigvalsh(cov).min() > -1e-12
    base = tree.children == 0
    spread = np.sqrt(np.stack([cov[base, a, a] for a in range(3)], 1))
    assert (spread <= tree.edge[base] / 2 + 1e-9).all()  # no more than mass at the walls
    rebuilt = cov + mean[:, :, None] * mean[:, None, :]
    np.testing.assert_allclose(rebuilt[:, 0, 2], tree.moments[:, 6] / mass, atol=1e-12)
    assert (tree.moments[:, SEEN] <= mass * (1 + 1e-6)).all()
    assert (tree.moments[:, SEEN] >= 0).all()


def test_split_scores_are_their_twins(tree: Tree) -> None:
    mass, _, cov = central(tree.moments)
    area = np.cbrt(tree.edge.prod(axis=1)) ** 2
    seen = np.sqrt(tree.largest * tree.moments[:, SEEN] / mass)
    spread = -np.expm1(-mass / area) * area * seen * np.trace(cov, axis1=1, axis2=2)
    shades, shown = np.zeros((len(tree), 4)), np.zeros(len(tree))
    at = np.flatnonzero(tree.children == 0)  # base cells, then what each is in, up to the root
    colors, weights = tree.moments[at, COLOR] / mass[at, None], tree.moments[at, SEEN]
    parts = np.concatenate([colors, (colors**2).sum(axis=1)[:, None]], axis=1) * weights[:, None]
    for _ in range(len(tree.edges)):
        np.add.at(shades, at, parts)
        np.add.at(shown, at, weights)
        if (tree.parent[at] == at).all():
            break
        at = tree.parent[at]
    means = shades / shown[:, None]
    variance = means[:, 3] - (means[:, :3] ** 2).sum(axis=1)
    assert variance.max() > 2 * PLAIN
    np.testing.assert_allclose(split_score(tree, np.inf), spread, rtol=1e-9, atol=1e-12 * spread.max())
    expected = spread * (variance + PLAIN)
    scores = split_score(tree)
    assert (scores >= 0).all()
    assert scores.max() > 0
    np.testing.assert_allclose(scores, expected, rtol=1e-9, atol=1e-12 * expected.max())


def cover(tree: Tree, ids: np.ndarray) -> np.ndarray:
    """How many of ``ids`` are each base cell or above it."""
    chosen = np.zeros(len(tree), int)
    chosen[ids] = 1
    at = np.flatnonzero(tree.children == 0)
    count = chosen[at]
    while (tree.parent[at] != at).any():
        moved = tree.parent[at] != at
        at = tree.parent[at]
        count = count + chosen[at] * moved
    return count


@pytest.mark.parametrize("tf", [Tent(), Ramp(0.5), Above(1.0, 0.6)], ids=lambda tf: tf.name)
def test_select_covers_once_within_any_budget(tf) -> None:
    tree = some_tree(tf=tf)
    cells = int((tree.children == 0).sum())
    before = 0
    for budget in (1, 2, 7, 8, 9, 10, 64, 100, 333, 1000, cells, 10 * cells):
        ids = select(tree, budget)
        assert before <= len(ids) <= budget
        assert (np.diff(ids) > 0).all()
        assert (cover(tree, ids) == 1).all()
        before = len(ids)
    assert select(tree, 1).tolist() == [len(tree) - 1]
    assert before > 0.9 * cells


def test_select_splits_where_the_score_is_large(tree: Tree) -> None:
    """No cell is kept whole whose score, and those of all above it, are larger than a split cell's."""
    score = split_score(tree)
    ids = select(tree, 400)
    present = np.zeros(len(tree), bool)
    present[ids] = True
    split_cells = np.zeros(len(tree), bool)
    at = ids
    while len(at):
        at = np.unique(tree.parent[at[tree.parent[at] != at]])
        split_cells[at] = True
    assert not (present & split_cells).any()
    kept = ids[tree.children[ids] > 0]
    assert len(kept) > 50
    for k in kept:
        chain, at = [score[k]], k
        while tree.parent[at] != at:
            at = tree.parent[at]
            chain.append(score[at])
        assert min(chain) <= score[split_cells].min() + 1e-15


def boxes_cover(leaves: Leaves, tree: Tree) -> np.ndarray:
    """(base cells, k) whether the base cell lies in the leaf or the leaf in the base cell."""
    base = np.flatnonzero(tree.children == 0)
    lo, hi = tree.index[base] * tree.edge[base], (tree.index[base] + 1) * tree.edge[base]
    leaf_lo, leaf_hi = leaves.index * leaves.edge, (leaves.index + 1) * leaves.edge
    overlap = np.minimum(hi[:, None], leaf_hi) - np.maximum(lo[:, None], leaf_lo)
    return (overlap > 1e-9).all(axis=2)


@pytest.fixture(scope="module")
def coarse() -> tuple[Scene, Visibility, Tree]:
    """Base cells of two voxels, so that there is something below."""
    scene = scene_of(shapes.random_field((20, 13, 17), cycles=4, seed=1), Tent())
    cells = base_cells(scene, np.full(3, 1))
    seen = visibility(scene, base_cells(scene, np.zeros(3, np.int64)), default_views("train", 6, size=48))
    return scene, seen, build_tree(cells, seen, scene.step)


def test_split_within_the_tree(coarse) -> None:
    scene, seen, tree = coarse
    ids = select(tree, 60)
    leaves = leaves_of(tree, ids)
    order = np.flatnonzero(tree.children[ids] > 1)
    assert len(order) > 20
    for room in (0, 1, 7, 8, 50, 150):
        after = split(tree, leaves, order, room, scene, seen)
        assert len(after) <= len(leaves) + room
        assert len(after) > len(leaves) + room - 8
        assert (after.node >= 0).all()
        assert (cover(tree, after.node) == 1).all()
        for field in ("moments", "index", "edge"):
            np.testing.assert_array_equal(getattr(after, field), getattr(tree, field)[after.node])
    first = split(tree, leaves, order, 8, scene, seen)
    assert ids[order[0]] not in first.node  # the first in the order is split first


def test_split_below_the_base(coarse) -> None:
    """Cells finer than the pyramid's: those that a finer pyramid has, with moments that sum to their parent's."""
    scene, seen, tree = coarse
    fine = build_tree(base_cells(scene, np.zeros(3, np.int64)), seen, scene.step)
    ids = np.flatnonzero(tree.children == 0)
    leaves = leaves_of(tree, ids)
    order = np.random.default_rng(0).permutation(len(ids))
    for room in (0, 1, 6, 100, 700):
        after = split(tree, leaves, order, room, scene, seen)
        assert len(after) <= len(leaves) + room
        assert len(after) > len(leaves) + room - 8
        assert boxes_cover(after, tree).any(axis=1).all()
        # nothing twice: what is kept whole and what lies below something split are disjoint
        assert boxes_cover(after.take(np.flatnonzero(after.node >= 0)), tree).sum(axis=1).max() == 1
        assert after.moments[:, 0].sum() == pytest.approx(leaves.moments[:, 0].sum(), rel=0.01)
    below = after.take(np.flatnonzero(after.node < 0))
    base = np.flatnonzero(fine.children == 0)
    rows = {tuple(fine.index[i]): fine.moments[i] for i in base}
    np.testing.assert_allclose(below.edge, np.broadcast_to(scene.step, below.edge.shape))
    for index, moments in zip(below.index, below.moments, strict=True):
        np.testing.assert_allclose(moments, rows[tuple(index)], rtol=1e-9, atol=1e-12)
    # and once more, below what is below
    again = split(tree, below, np.arange(len(below)), 60, scene, seen)
    assert len(below) < len(again) <= len(below) + 60
    assert again.edge.min() == pytest.approx(scene.step.min() / 2)


def test_empty_and_single_cell() -> None:
    empty = some_tree(tf=Above(1.0, 2.0))
    assert len(empty) == 0
    assert len(select(empty, 10)) == 0
    assert len(leaves_of(empty, np.empty(0, np.int64))) == 0
    scene = scene_of(Volume(np.ones((1, 1, 1), np.float32)), Ramp(), 1.0)
    cells = base_cells(scene, np.zeros(3, np.int64))
    one = build_tree(cells, visibility(scene, cells, [far_view(0)]), scene.step)
    assert len(one) == 1
    assert select(one, 5).tolist() == select(one, 1).tolist() == [0]
    assert len(select(one, 0)) == 0


def test_hidden_cells_are_dropped() -> None:
    """Nothing behind an opaque wall is in the tree of a camera before the wall; all of it is in one's behind it."""
    data = np.zeros((24, 24, 24), np.float32)
    data[:, :, 16:19] = 1  # the wall, across x
    data[6:18, 6:18, 2:10] = 0.9  # behind it for a camera at +x
    scene = scene_of(Volume(data), Above(1.0))
    cells = base_cells(scene, np.zeros(3, np.int64))
    front = build_tree(cells, visibility(scene, cells, [far_view(0)]), scene.step)
    back = build_tree(cells, visibility(scene, cells, [far_view(0, -1.0)]), scene.step)
    for tree, hidden in ((front, False), (back, True)):
        base = tree.children == 0
        x = tree.moments[base, 1] / tree.moments[base, 0]
        assert (x < 0).any() == hidden
        assert (x > 0.25).any()
    # the camera at +x sees the wall's near side at full transmittance
    assert front.largest.max() == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("both", [False, True])
def test_slab_transmittance(both: bool) -> None:
    """Homogeneous matter seen along z: layer [a, b] is seen with (exp(-k a) - exp(-k b)) / (k (b - a))."""
    n, k = 12, 1.5
    scene = scene_of(shapes.volume_of(np.ones((n, 48, 48)), "constant"), Ramp(k), 1.0)
    step = scene.step[2]
    cameras = [far_view(2), far_view(2, -1.0)] if both else [far_view(2)]
    seen = visibility(scene, base_cells(scene, np.zeros(3, np.int64)), cameras)
    depth = np.arange(n, -1, -1) * step  # from the top face (+z) down to each layer boundary
    edges = np.exp(-k * depth)
    expected = (edges[1:] - edges[:-1]) / (k * step)
    if both:
        expected = (expected + expected[::-1]) / 2
    middle = seen.mean[:, 16:32, 16:32]
    np.testing.assert_allclose(middle, np.broadcast_to(expected[:, None, None], middle.shape), rtol=1e-3)
    if not both:
        np.testing.assert_allclose(seen.largest[:, 24, 24], edges[1:], rtol=1e-3)


@pytest.mark.parametrize("tf", [Ramp(0.3), Tent(), Above(1.0)], ids=lambda tf: tf.name)
def test_visibility_is_a_transmittance(tf) -> None:
    scene = scene_of(shapes.random_field((30, 21, 26), cycles=4), tf)
    seen = visibility(scene, base_cells(scene, np.zeros(3, np.int64)), default_views("train", 6, size=64))
    for field in (seen.mean, seen.largest):
        assert field.dtype == np.float32
        assert field.shape == scene.values.shape
        assert field.min() >= 0
        assert field.max() <= 1
    assert (seen.mean <= seen.largest + 1e-6).all()
    assert seen.largest.max() > 0.99


def test_visibility_repeats_and_coarsens(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(shapes.random_field((30, 21, 26), cycles=4), Tent())
    cells, cameras = base_cells(scene, np.zeros(3, np.int64)), default_views("train", 6, size=64)
    first, second = visibility(scene, cells, cameras), visibility(scene, cells, cameras)
    assert first.mean.tobytes() == second.mean.tobytes()
    assert first.largest.tobytes() == second.largest.tobytes()
    monkeypatch.setattr(visibility_module, "MAX_CELLS", 3000)
    coarse = visibility(scene, cells, cameras)
    wider = visibility(scene, base_cells(scene, np.ones(3, np.int64)), cameras)
    assert (coarse.edge.tolist(), coarse.mean.shape) == ([2, 2, 2], (13, 11, 15))
    np.testing.assert_allclose(coarse.mean, wider.mean, rtol=5e-3, atol=1e-6)  # wider ones may take one point
    assert abs(coarse.mean.mean() - first.mean[first.largest > 0].mean()) < 0.1


def march_twin(extinction: np.ndarray, p: np.ndarray, d: np.ndarray) -> np.ndarray:
    """What one ray p + t d (cells; t in lengths) adds to each cell, in float64: the crossings of all planes, sorted."""
    shape = extinction.shape[::-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        planes = np.concatenate([(np.arange(n + 1) - p[a]) / d[a] for a, n in enumerate(shape)])
    planes = np.unique(planes[np.isfinite(planes) & (planes > 0)])
    sums, trans = np.zeros((*extinction.shape, 3)), 1.0
    for t0, t1 in itertools.pairwise(planes):
        cell = np.floor(p + (t0 + t1) / 2 * d).astype(int)
        if (cell < 0).any() or (cell >= shape).any():
            continue
        depth = extinction[tuple(cell[::-1])] * (t1 - t0)
        after = trans * np.exp(-depth)
        at = sums[tuple(cell[::-1])]
        if depth > 0:
            at += (depth, trans - after, 0)
            at[2] = max(at[2], trans)
        trans = after
    return sums


def test_rays_against_their_twin() -> None:
    rng = np.random.default_rng(3)
    extinction = (rng.random((5, 7, 6)) * (rng.random((5, 7, 6)) < 0.7) * 2).astype(np.float32)
    edge = np.array([1.0, 2.0, 0.5])
    for number in range(30):
        eye = rng.normal(size=3)
        eye *= 30 / np.linalg.norm(eye)
        basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        middle = np.array(extinction.shape[::-1]) / 2 * edge
        aim = middle - eye + rng.normal(size=3)  # one pixel, whose ray is the camera's third axis
        basis[2] = aim / np.linalg.norm(aim) if number else [0, 0, 1]
        eye = eye if number else middle - [0.3, 0.2, 30]
        sums = np.zeros((1, *extinction.shape, 3), np.float32)
        march(extinction, eye[None] - 0.5, basis[None], np.array([[1.0, 1.0, 0.5, 0.5]]), 1, edge, sums)
        expected = march_twin(extinction, eye / edge, basis[2] / edge)
        assert expected.sum() > 0
        np.testing.assert_allclose(sums[0], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("dims", [(512, 512, 1), (1024, 700, 1), (3, 256, 256), (96, 96, 96)])
def test_no_cell_is_lost_between_the_rays(dims: tuple[int, int, int]) -> None:
    """A faint volume is seen everywhere by the default views, however fine its voxels are."""
    scene = scene_of(shapes.volume_of(np.ones(dims[::-1]), "constant"), Ramp(0.05), 1.0)
    cells = base_cells(scene, np.zeros(3, np.int64))
    seen = visibility(scene, cells, default_views("train", size=200))
    assert (seen.largest > 0.5).mean() > 0.995


def test_detail_energy_reaches_up(tree: Tree) -> None:
    """A symmetric body, whose coarse cells are all alike, is still split down to its details."""
    from vvgt_cli.closed_form.wavelet import detail_energy

    energy = detail_energy(tree)
    assert (energy[tree.children == 0] == 0).all()
    assert (energy[tree.parent] >= energy).all()
    scene = scene_of(shapes.blob(16, 0.3), Ramp(0.3))
    cells = base_cells(scene, np.zeros(3, np.int64))
    blob = build_tree(cells, visibility(scene, cells, default_views("train", 6, size=48)), scene.step)
    assert len(select(blob, 500, detail_energy(blob))) > 200
