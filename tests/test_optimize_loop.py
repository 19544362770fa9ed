"""Refinement as a whole: it gets nearer, never returns less than it was given, stops when told, repeats to the byte."""

from dataclasses import replace

import numpy as np
import pytest
from random_clouds import random_cloud

from tests.refused import refused
from vvgt_cli.cameras import default_views
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.images.metrics import psnr
from vvgt_cli.network.prepare import halved
from vvgt_cli.refine import OptimizeOptions, OptimizeRecord, optimize
from vvgt_cli.refine.checkpoint import FALLEN, Checks
from vvgt_cli.refine.loop import spread_views
from vvgt_cli.refine.shared import NONE
from vvgt_cli.refine.states import Fields, OwnAxes
from vvgt_cli.splat import render
from vvgt_cli.splat.reference import covariances

NO_FLOORS = np.full(13, 1e-15, np.float32)
FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "colors")
CAMERAS, CHECKS = default_views("train", 6, size=48), default_views("check", 2, size=48)


def truth(count=40):
    return random_cloud(count, 0, 0.12, 0.4, (0.5, 1))


def shaken(g, size=0.05):
    rng = np.random.default_rng(1)
    means, scales, logits, colors = (
        array + size * factor * rng.normal(size=array.shape)
        for array, factor in ((g.means, 0.5), (g.log_scales, 4), (g.opacity_logits, 6), (g.colors, 2))
    )
    return Gaussians(means, scales, g.quaternions, logits, colors)


def views(g, cameras):
    return np.stack([render(g, camera) for camera in cameras])


def score(g, cameras, images):
    return float(np.mean([psnr(i[..., :3], render(g, c)[..., :3]) for c, i in zip(cameras, images, strict=True)]))


@pytest.fixture(scope="module")
def scene():
    g = truth()
    return shaken(g), views(g, CAMERAS), (CHECKS, views(g, CHECKS))


@pytest.mark.parametrize(
    ("options", "gain"),
    [
        (OptimizeOptions(steps=60), 4.0),
        (OptimizeOptions(steps=60, l1=1.0, l2=0.0), 3.0),
        (OptimizeOptions(steps=60, ssim=0.2), 3.0),
        (OptimizeOptions(steps=60, method="adam"), 2.0),
    ],
)
def test_views_that_were_not_trained_on_come_nearer(scene, options, gain):
    start, images, check = scene
    result, record = optimize(start, CAMERAS, images, options, check)
    assert score(result, *check) > score(start, *check) + gain
    assert record.psnr_after == pytest.approx(score(result, *check), abs=0.02)
    assert record.psnr_before == pytest.approx(score(start, *check), abs=0.02)
    assert score(result, CAMERAS, images) > score(start, CAMERAS, images) + gain


@pytest.mark.parametrize("method", ["axes", "adam"])
def test_views_of_half_the_size_want_a_quarter_of_the_dilation(method):
    wide = truth(300)
    thin = Gaussians(wide.means, wide.log_scales - 1.2, wide.quaternions, wide.opacity_logits + 1, wide.colors)
    images, check = views(thin, CAMERAS), (CHECKS, views(thin, CHECKS))
    cameras, small, rule = halved(CAMERAS, images)
    start, ends = shaken(thin, 0.03), {}
    for given in (rule, INRIA):
        options = OptimizeOptions(steps=60, method=method, rule=given)
        ends[given] = score(optimize(start, cameras, small, options)[0], *check)
    assert ends[rule] > score(start, *check) + 1
    assert ends[rule] > ends[INRIA] + 1


def test_alpha_is_fitted_where_colour_says_nothing(scene):
    start, images, _ = scene
    dark = Gaussians(start.means, start.log_scales, start.quaternions, start.opacity_logits, np.zeros((len(start), 3)))
    black = images * np.float32([0, 0, 0, 1])
    result, _ = optimize(dark, CAMERAS, black, OptimizeOptions(steps=60))
    errors = [np.mean([np.mean((render(g, c) - i)[..., 3] ** 2) for c, i in zip(CAMERAS, images, strict=True)])
              for g in (dark, result)]  # fmt: skip
    assert errors[1] < errors[0]


@pytest.mark.parametrize("degree", [None, 1])
def test_colours_are_negative_only_where_harmonics_may_lighten_them(degree):
    start = truth()
    start = replace(start, harmonics=None if degree is None else np.zeros((len(start), 3, 3), np.float32))
    state = OwnAxes(start, CAMERAS)
    for _ in range(20):  # towards a picture darker than black
        image = render(state.gaussians(), CAMERAS[0])
        state.error = 0.05
        state.descend(CAMERAS[0], state.project(CAMERAS[0]), image, np.full_like(image, 1e-3), 0.0, 20.0)
    assert (state.arrays[3].min() < 0) == (degree is not None)


@pytest.mark.parametrize("method", ["axes", "adam"])
def test_nothing_worse_than_the_input_is_returned(scene, method):
    start, images, check = scene
    misled = np.zeros_like(images)
    result, record = optimize(start, CAMERAS, misled, OptimizeOptions(steps=60, method=method, check_every=5), check)
    assert (record.reason, record.kept) == ("no gain", 0)
    assert 0 < record.steps < 60
    assert result is start
    assert record.psnr_after == record.psnr_before == pytest.approx(score(start, *check), abs=0.02)


def test_a_run_that_ends_worse_than_it_was_returns_its_best(scene):
    """Views of the right shapes in a darker colour: at first they lead nearer to the check views, then away."""
    start, images, check = scene
    darker = images * np.float32([0.7, 0.7, 0.7, 1])
    options = OptimizeOptions(steps=80, method="adam", check_every=5, patience=100)
    result, record = optimize(start, CAMERAS, darker, options, check)
    looks = {step: db for step, _, db in record.checks}
    best = max(looks, key=looks.get)
    assert record.steps == 80
    assert 0 < record.kept == best < 80
    assert looks[best] > max(looks[0], looks[80]) + 0.1
    assert score(result, *check) == pytest.approx(looks[best], abs=0.02)
    assert record.psnr_after == looks[best]


@pytest.mark.parametrize("kind", [OwnAxes, Fields])
def test_the_best_state_is_returned_not_the_last(scene, kind):
    start, _, check = scene
    state, record = kind(start, CAMERAS), OptimizeRecord()
    assert not Checks(state, None, record).measure(0.0)
    judge = Checks(state, check, record)
    judge.measure(0.0)
    best, last = shaken(truth(), 0.02), shaken(truth(), 0.025)
    for record.steps, g in ((5, best), (10, last)):
        state.arrays = kind(g, CAMERAS).arrays
        assert not judge.measure(1.0)
    looks = [db for *_, db in record.checks]
    assert looks[1] - FALLEN < looks[2] < looks[1] - 0.5
    assert looks[0] < looks[2]
    result = judge.result(start)
    assert record.kept == 5
    assert score(result, *check) == pytest.approx(looks[1], abs=0.1)
    np.testing.assert_allclose(result.means, best.means, atol=1e-6)


def exact_steps(state, frames, rates, clip):
    """(K, 3) means and (K, 3, 3) factors after Adam's first step, whose directions are signs: float64, by matrices."""
    means, factors = (state.arrays[i].astype(np.float64) for i in range(2))
    size = np.square(factors).sum(axis=1)
    p = np.sqrt(np.minimum(1 + state.spread / size, 9))  # (K, 3): how much further an axis may go
    sign = np.sign(frames)
    e = np.zeros((len(means), 3, 3))
    for column, (i, j) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)], start=3):
        bound = np.minimum(p[:, i] * p[:, j], 4) * rates[1 if i == j else 2]
        e[:, i, j] = e[:, j, i] = np.clip(sign[:, column] * bound, -clip, clip)
    means -= np.einsum("kij,kj->ki", factors, np.clip(sign[:, :3] * rates[0] * p, -0.5, 0.5))
    return means, factors @ (np.eye(3) - e + e @ e / 2)


def test_a_step_is_the_exponential_of_e_to_second_order():
    from vvgt_cli.refine import steps

    state, rng = OwnAxes(truth(200), CAMERAS), np.random.default_rng(2)
    frames = rng.normal(size=(200, 9)).astype(np.float32)
    rates = np.array([0.05, 0.2, 0.15, 0.03, 0.008])  # E^2 / 2 is a tenth of E
    expected = exact_steps(state, frames, rates, 0.3)
    means, factors, logits, colors = state.arrays
    slopes = np.zeros((13, 200), np.float32)
    slopes[:9] = frames.T
    steps.own_axes(
        slopes, rates, np.array([0.5, 1.0, 0.3]), state.spread, *state.BETAS, 1,
        means, factors, logits, colors, state.darkest, state.first, state.second, NO_FLOORS, *NONE,
    )  # fmt: skip
    np.testing.assert_allclose(means, expected[0], atol=1e-6)
    np.testing.assert_allclose(factors, expected[1], atol=1e-6)


def test_views_in_a_row_are_far_apart_and_each_is_seen_once_a_round():
    cameras = default_views("train", 96, size=32)
    places = np.array([camera.position for camera in cameras])
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    order = spread_views(cameras, 0)
    found = [next(order) for _ in range(4 * 96)]
    for start in range(0, len(found), 96):
        assert sorted(found[start : start + 96]) == list(range(96))

    def nearest(views):
        """The smallest angle within eight views in a row, on average, radians."""
        angles = np.arccos(np.clip(places[views] @ places[views].T, -1, 1)) + 9 * np.eye(len(views))
        return np.mean([angles[k : k + 8, k : k + 8].min() for k in range(len(views) - 7)])

    rng = np.random.default_rng(0)
    assert nearest(found) > 1.6 * nearest(np.concatenate([rng.permutation(96) for _ in range(4)]))
    other = spread_views(cameras, 1)
    assert [next(other) for _ in range(8)] != found[:8]
    again = spread_views(cameras, 0)
    assert [next(again) for _ in range(len(found))] == found


def test_the_same_run_gives_the_same_bytes(scene):
    start, images, check = scene
    runs = [optimize(start, CAMERAS, images, OptimizeOptions(steps=10), check)[0] for _ in range(2)]
    for field in FIELDS:
        assert getattr(runs[0], field).tobytes() == getattr(runs[1], field).tobytes()


def test_a_fall_is_taken_back_and_rates_halved(scene, monkeypatch):
    start, images, check = scene
    monkeypatch.setattr(OwnAxes, "RATES", OwnAxes.RATES * 100)
    result, record = optimize(start, CAMERAS, images, OptimizeOptions(steps=200, check_every=5, patience=50), check)
    looks = [db for _, _, db in record.checks]
    assert min(looks) < looks[0] - 3
    assert score(result, *check) > looks[0] + 3
    assert score(result, *check) == pytest.approx(max(looks), abs=0.02)


def test_factors_and_back_keep_the_covariance():
    g = truth(200)
    np.testing.assert_allclose(covariances(OwnAxes(g, CAMERAS).gaussians()), covariances(g), atol=1e-6)
    flat = Gaussians(
        g.means, np.where([True, True, False], g.log_scales, -11), g.quaternions, g.opacity_logits, g.colors
    )
    np.testing.assert_allclose(covariances(OwnAxes(flat, CAMERAS).gaussians()), covariances(flat), atol=1e-6)


def test_no_gaussians_stay_none(scene):
    _, images, check = scene
    assert len(optimize(truth(0), CAMERAS, images, OptimizeOptions(steps=2), check)[0]) == 0


def test_wrong_views_and_options_are_refused(scene):
    start, images, check = scene
    refused(DataError, "5 training images for 6 cameras", optimize, start, CAMERAS, images[:5])
    refused(DataError, "check view", optimize, start, CAMERAS, images, check=(CHECKS, check[1][:, :40]))
    ones = [np.ones(image.shape[:2], np.float32) for image in images]
    few = (*check[:2], None, [weight[:, :40] for weight in ones[: len(CHECKS)]])
    refused(DataError, "training views: weights", optimize, start, CAMERAS, images, weights=ones[:5])
    optimize(start, CAMERAS, images, OptimizeOptions(steps=1), weights=np.stack(ones))
    refused(DataError, "check views: weights", optimize, start, CAMERAS, images, check=few)
    for wrong in (
        {"method": "sgd"},
        {"steps": -1},
        {"l2": 0.0},
        {"alpha": -1.0},
        {"check_every": 0},
        {"time_budget": -1},
    ):
        with pytest.raises(UsageError):
            OptimizeOptions(**wrong)
