"""Curves, windows, pooling and neighbours against plain Python; what the network is given, against the cameras."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.random_clouds import extreme_cloud, random_cloud
from tests.refused import refused
from vvgt_cli.cameras import default_views, farthest_cameras
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.network import NAMED, NetworkConfig
from vvgt_cli.network import tables as tb
from vvgt_cli.network.config import SLOPES
from vvgt_cli.network.prepare import filter_matrix, pack, prepare, resize, unpack
from vvgt_cli.network.tables import hilbert, interleave

SMALL = NAMED["small"]


def scene(count: int, seed: int = 0, spread: float = 1.0) -> Gaussians:
    rng = np.random.default_rng(seed)
    means = rng.uniform(-spread, spread, (count, 3))
    return Gaussians(
        means, rng.normal(-4, 0.3, (count, 3)), rng.normal(size=(count, 4)), rng.normal(size=count),
        rng.random((count, 3)),
    )  # fmt: skip


@pytest.mark.parametrize("bits", [1, 2, 3, 4])
def test_hilbert_visits_every_cell_once_and_never_jumps(bits):
    side = 1 << bits
    cells = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    codes = hilbert(cells, bits)
    assert sorted(codes) == list(range(side**3))
    assert (np.abs(np.diff(cells[np.argsort(codes)], axis=0)).sum(axis=1) == 1).all()


def test_a_part_is_ordered_as_the_whole():
    """One centre beyond the unit frame widens the grid, of all parts."""
    means = np.random.default_rng(0).uniform(-1, 1, (2000, 3)).astype(np.float32)
    means[0] = 1.5
    means = means[tb.canonical_order(means)]
    codes = tb.interleave(tb.quantise(means[:1000], tb.bound(means)))
    assert (np.diff(codes.astype(np.int64)) >= 0).all()
    assert tb.bound(means[:1000]) < tb.bound(means) == 1.5


@given(st.integers(1, 300), st.integers(0, 5), st.sampled_from([1, 3, 16]))
def test_every_pool_at_least_halves_and_keeps_mean_positions(count, seed, coarse):
    means = scene(count, seed).means
    means = np.round(means * coarse).astype(np.float32) / coarse  # many share a place
    means = means[tb.canonical_order(means)]
    stage = tb.StagePoints(tb.quantise(means, tb.bound(means)), tb.BITS, means, np.ones(count, np.int64))
    whole = np.arange(count)
    for _ in range(4):
        after, parents = tb.pool(stage)
        assert len(after.cells) <= max(len(stage.cells) // 2, 1)
        assert np.array_equal(np.unique(parents), np.arange(len(after.cells)))
        assert np.array_equal(stage.cells >> stage.bits - after.bits, after.cells[parents])
        whole = parents[whole]
        for cell in range(len(after.cells)):
            assert np.allclose(after.positions[cell], means[whole == cell].mean(axis=0), atol=1e-5)
        assert after.counts.sum() == count
        stage = after


def test_neighbours_are_the_cells_around():
    cells = np.unique(np.random.default_rng(2).integers(0, 8, (150, 3)), axis=0)
    cells = cells[np.argsort(interleave(cells))]
    stage = tb.StagePoints(cells, 3, np.zeros((len(cells), 3), np.float32), np.ones(len(cells), np.int64))
    where = {tuple(cell): i for i, cell in enumerate(cells)}
    expected = [[where.get(tuple(cell + offset), len(cells)) for offset in tb.OFFSETS] for cell in cells]
    assert np.array_equal(tb.neighbours(stage), expected)


@given(st.integers(1, 400), st.integers(1, 64))
def test_each_point_reads_its_own_slot_of_one_window(count, size):
    order = np.random.default_rng(count).permutation(count)
    members, slots = tb.windows(order, size)
    assert members.shape[1] == min(size, count)
    assert np.array_equal(members.reshape(-1)[slots], np.arange(count))
    place = np.argsort(order)
    assert (np.ptp(place[members], axis=1) == members.shape[1] - 1).all()  # neighbours along the order


def test_the_order_of_the_input_does_not_matter_ties_included():
    rows = pack(scene(200))
    rows[50:100, :3] = rows[0, :3]  # one place, other parameters
    rows[150:160] = rows[149]  # exact duplicates
    order = np.random.default_rng(3).permutation(200)
    assert np.array_equal(rows[tb.canonical_order(rows)], rows[order][tb.canonical_order(rows[order])])


def test_packing_keeps_the_gaussian_and_one_sign_of_the_quaternion():
    gaussians = scene(50)
    flipped = replace(gaussians, quaternions=-3 * gaussians.quaternions)
    assert np.allclose(pack(gaussians), pack(flipped), atol=1e-7)
    back = unpack(pack(gaussians))
    cosine = np.abs((back.quaternions * gaussians.quaternions).sum(axis=1))
    assert np.allclose(cosine, np.linalg.norm(gaussians.quaternions, axis=1), rtol=1e-6)
    assert np.array_equal(back.means, gaussians.means)


def test_far_apart_views_are_chosen_whatever_their_order():
    cameras = default_views("train")
    chosen = farthest_cameras(cameras, 6)
    assert len(set(chosen)) == 6
    assert farthest_cameras(cameras, 30) == list(range(24))
    order = np.random.default_rng(0).permutation(24)
    assert sorted(order[farthest_cameras([cameras[i] for i in order], 6)]) == chosen
    eyes = np.array([camera.position for camera in cameras])[chosen]
    gaps = np.linalg.norm(eyes[:, None] - eyes[None], axis=2) + 10 * np.eye(6)
    assert gaps.min() > 2  # on a sphere of radius 3


def test_scene_arrays_hold_what_the_switches_ask_for():
    config = replace(SMALL, image=replace(SMALL.image, size=28), rendering=True,
                     geometry=replace(SMALL.geometry, gradients=True))  # fmt: skip
    gaussians, cameras = scene(40, spread=0.5), default_views("train", 2, size=32)
    images = np.zeros((2, 32, 32, 4), np.float32)
    prepared = prepare(gaussians, cameras, images, config)
    assert prepared.views["images"].shape == (2, 8, 28, 28)
    assert prepared.views["images"][:, 4:].max() > 0.01  # the rendering
    assert prepared.gradients.shape == (40, SLOPES)
    flipped = replace(gaussians, quaternions=-2 * gaussians.quaternions)
    assert np.allclose(prepare(flipped, cameras, images, config).gradients, prepared.gradients, atol=1e-4)
    # black targets: a brighter colour raises the error, in every view that sees it
    assert (prepared.gradients[:, 10:13] >= 0).all()
    assert prepared.gradients[:, 10:13].max() > 0.9
    assert np.abs(prepared.gradients[:, :13]).max() <= 1 + 1e-6
    assert np.array_equal(prepared.restore(prepared.rows).means, gaussians.means)


ONE_PLACE = replace(random_cloud(500), means=np.zeros((500, 3)))


@pytest.mark.parametrize(
    ("gaussians", "size"),
    [(random_cloud(1), 32), (random_cloud(3000), 32), (extreme_cloud(), 32), (ONE_PLACE, 32), (random_cloud(50), 1)],
    ids=["one", "3000", "extreme", "in one place", "views of one pixel"],
)
def test_an_output_that_changes_nothing_gives_the_gaussians_back_in_their_order(gaussians, size):
    cameras = default_views("train", 2, size=size)
    prepared = prepare(gaussians, cameras, np.random.default_rng(0).random((2, size, size, 4), np.float32), SMALL)
    for name, array in prepared.arrays().items():
        assert array.dtype.kind != "f" or np.isfinite(array).all(), name
    np.testing.assert_allclose(pack(prepared.restore(prepared.rows)), pack(gaussians), atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["image"].pop("width"), "width"),
        (lambda d: d.update(extra=1), "extra"),
        (lambda d: d["geometry"].update(window="x"), "window|<"),
        (lambda d: d["geometry"].update(widths=[32]), "widths"),
        (lambda d: d["image"].update(size=100), "patch"),
        (lambda d: d["image"].update(taps=[9]), "taps"),
    ],
)
def test_a_config_that_makes_no_network_is_refused(change, message):
    values = asdict(SMALL)
    change(values)
    refused(DataError, message, NetworkConfig.from_dict, values)


@pytest.mark.parametrize(("old", "new"), [(10, 10), (32, 14), (7, 28), (400, 224)])
def test_resizing_keeps_constants_and_ramps(old, new):
    weights = filter_matrix(old, new)
    assert np.allclose(weights.sum(axis=1), 1, atol=1e-6)
    ramp = weights @ ((np.arange(old) + 0.5) / old).astype(np.float32)
    inner = slice(1 + new // old, -1 - new // old)  # the edge is clamped
    assert np.allclose(ramp[inner], ((np.arange(new) + 0.5) / new)[inner], atol=0.02)
    assert np.allclose(resize(np.ones((old, old + 3, 4), np.float32), new), 1, atol=1e-5)
