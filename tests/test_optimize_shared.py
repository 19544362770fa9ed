"""Steps in common: what is known of Gaussians, the regression on it, and the kernel against a twin in float64."""

from dataclasses import replace

import numpy as np
import pytest

from tests.random_clouds import random_cloud
from vvgt_cli.cameras import default_views
from vvgt_cli.images.metrics import psnr
from vvgt_cli.refine import OptimizeOptions, optimize, shared, steps
from vvgt_cli.refine.states import OwnAxes
from vvgt_cli.splat import render

CAMERAS = default_views("train", 6, size=64)
MANY = 2_100  # not a multiple of LANES


def many(count=MANY):
    return random_cloud(count, 4, 0.03, 0.4, (-1, 1))


def parts(g):
    """Means, factors, logits and colours, axes as the file has them."""
    return [array.copy() for array in unshared(g).arrays[:4]]


def unshared(g):
    """The state as the file has it, axes as they are."""
    few, shared.LEAST = shared.LEAST, len(g) + 1
    try:
        return OwnAxes(g, CAMERAS)
    finally:
        shared.LEAST = few


def features(found):
    """(K, FEATURES) of `SharedSteps`."""
    return found.features.transpose(0, 2, 1).reshape(-1, steps.FEATURES).astype(np.float64)


def test_axes_are_put_in_order_and_the_covariance_stays():
    means, factors, logits, colors = parts(many())
    before = factors.astype(np.float64)
    known = shared.aligned(means, factors, logits, colors)
    after = factors.astype(np.float64)
    np.testing.assert_allclose(after @ after.transpose(0, 2, 1), before @ before.transpose(0, 2, 1), atol=1e-9)
    lengths = np.linalg.norm(after, axis=1)
    assert (np.diff(lengths, axis=1) >= -1e-9).all()
    assert known.shape == (MANY, 17)
    assert np.abs(known.mean(axis=0)).max() < 0.1
    assert np.abs(known).max() <= shared.FARTHEST


def test_axes_point_to_where_neighbours_lie():
    """A dense ball beside each of a few: its axes have a positive part that way."""
    rng = np.random.default_rng(0)
    lone = np.array([[-0.5, 0.1, 0.2], [0.4, -0.3, 0.5], [0.1, 0.6, -0.4]])
    way = np.array([0.6, 0.64, 0.48]) * 0.06
    near = (lone[:, None] + way + rng.normal(0, 0.002, (3, 30, 3))).reshape(-1, 3)
    means = np.concatenate([lone, near]).astype(np.float32)
    factors = np.tile(np.diag([0.04, 0.05, 0.06]).astype(np.float32), (len(means), 1, 1))
    factors[1] *= -1
    shared.aligned(means, factors, np.zeros(len(means), np.float32), np.zeros((len(means), 3), np.float32))
    assert (np.einsum("kij,i->kj", factors[:3].astype(np.float64), way) > 0).all()


@pytest.mark.parametrize("count", [MANY, 30_011])
def test_what_is_linear_in_the_features_is_foretold(count):
    """Directions that are a fixed sum of features, with noise three times as large, come back without the noise."""
    g = many(count)
    found = shared.SharedSteps(shared.aligned(*parts(g)))
    phi = features(found)[:count] / shared.ONE
    rng = np.random.default_rng(1)
    truth = rng.normal(size=(steps.FEATURES, 13)) / 8
    exact = phi @ truth
    noisy = (exact + 3 * exact.std() * rng.normal(size=exact.shape)).astype(np.float32)
    weights = found.weights(np.ascontiguousarray(shared.sampled(noisy).T)) / 7
    foretold = phi * shared.ONE @ weights.T
    kept = [0, 1, 2, 3, 4, 5, 9, 10, 11, 12]
    off = np.square(foretold - exact[:, kept]).mean(axis=0) / exact[:, kept].var(axis=0)
    samples = found.solver.shape[1]
    assert off.max() < 3 * 9 * steps.FEATURES / samples
    assert samples <= 2 * shared.SAMPLE
    assert (found.features < shared.MAX_FEATURE).mean() > 0.99  # 8 bits are enough


def test_a_step_with_shares_and_floors_is_that_of_the_twin():
    """Opacity, colours and places after two steps, float64: Adam's directions with floors, and the features' shares."""
    state, rng = OwnAxes(many(), CAMERAS), np.random.default_rng(2)
    assert state.shared is not None
    means, factors, logits, colors = state.arrays
    exact = [array.astype(np.float64) for array in (means, logits, colors)]
    phi = features(state.shared)[:MANY]
    weights = (rng.normal(size=(steps.KNOWN, steps.FEATURES)) / 200).astype(np.float32)
    floors = np.linspace(0.05, 0.5, 13).astype(np.float32)
    rates, clips = np.array([0.05, 0.0, 0.0, 0.03, 0.008]), np.array([0.5, 1.0, 0.3])
    m = v = np.zeros((13, MANY))
    length = np.square(factors.astype(np.float64)).sum(axis=1)
    reach = np.sqrt(np.minimum(1 + state.spread / length, 9))
    for n in (1, 2):
        slopes = rng.normal(size=(13, MANY)).astype(np.float32)
        steps.own_axes(
            slopes, rates, clips, state.spread, 0.6, 0.999, n, means, factors, logits, colors, 0.0,
            state.first, state.second, floors, state.shared.features, weights,
        )  # fmt: skip
        m, v = 0.6 * m + 0.4 * slopes, 0.999 * v + 0.001 * slopes.astype(np.float64) ** 2
        u = m / (1 - 0.6**n) / (np.sqrt(v / (1 - 0.999**n)) + floors[:, None])
        u[[0, 1, 2, 3, 4, 5, 9, 10, 11, 12]] += (phi @ weights.T.astype(np.float64)).T
        exact[0] -= np.einsum("kij,kj->ki", factors.astype(np.float64), np.clip(0.05 * reach * u[:3].T, -0.5, 0.5))
        exact[1] -= np.clip(0.03 * u[9], -1, 1)
        exact[2] = np.maximum(exact[2] - 0.008 * u[10:].T, 0)
    for found, wanted in zip((means, logits, colors), exact, strict=True):
        np.testing.assert_allclose(found, wanted, atol=2e-5)


def systematic():
    """Gaussians that made views, and the same with an error that follows from what is known of each."""
    truth = many()
    wider = truth.log_scales + 0.25 * np.tanh(truth.opacity_logits)[:, None]
    start = replace(truth, log_scales=wider, opacity_logits=truth.opacity_logits - 0.6)
    return truth, start


def test_errors_in_common_are_undone_in_fewer_steps(monkeypatch):
    truth, start = systematic()
    cameras = default_views("train", 12, size=64)
    images = np.stack([render(truth, camera) for camera in cameras])
    unseen = default_views("check", 3, size=64)
    ends = []
    for least in (shared.LEAST, MANY + 1):
        monkeypatch.setattr(shared, "LEAST", least)
        result, _ = optimize(start, cameras, images, OptimizeOptions(steps=24))
        ends.append(np.mean([psnr(render(truth, c)[..., :3], render(result, c)[..., :3]) for c in unseen]))
    assert ends[0] > ends[1] + 0.5


@pytest.mark.parametrize("count", [MANY, 30_011])
def test_what_slopes_tell_of_all_is_that_of_the_twin(count):
    """At step 3, float64: what is added to divisors, and the regression of Adam's directions, ridge and all."""
    state, rng = OwnAxes(many(count), CAMERAS), np.random.default_rng(3)
    assert state.shared is not None
    size = np.exp(rng.normal(0, 2, count))
    size[7] = 1e8  # which counts as a hundred times the median
    m = v = np.zeros((13, count))
    for n in (1, 2, 3):
        slopes = (rng.normal(size=(13, count)) * size).astype(np.float32)
        state.first[:], state.second[:], state.taken = m, v, n
        factor = state.shared.factor
        floors, _, weights = state.common(slopes)
        m, v = 0.6 * m + 0.4 * slopes, 0.999 * v + 0.001 * slopes.astype(np.float64) ** 2
    sizes = shared.sampled(np.sqrt(v / (1 - 0.999**3)).T).T
    middle = np.median(sizes[:, :: max(sizes.shape[1] // 512, 1)], axis=1, keepdims=True)
    exact = 0.1 * np.minimum(sizes, 100 * middle).mean(axis=1)
    np.testing.assert_allclose(floors, exact, rtol=1e-4)
    assert (floors < 10 * middle[:, 0]).all()
    u = shared.sampled(m.T / (1 - 0.6**3)).T / (sizes + exact[:, None])
    phi = shared.sampled(features(state.shared)[:count]).T
    square = phi @ phi.T
    wanted = factor * np.linalg.solve(
        square + 1e-3 * np.diag(np.diag(square)), phi @ u[[0, 1, 2, 3, 4, 5, 9, 10, 11, 12]].T
    )
    np.testing.assert_allclose(weights, wanted.T, atol=2e-4 * np.abs(wanted).max())


def test_the_factor_grows_while_what_is_foretold_agrees_and_falls_where_it_turns():
    """By the running cosine, float64, within bounds; where nothing is foretold it stays."""
    g = many()
    rng = np.random.default_rng(5)
    way, noise = rng.normal(size=(2, 13, MANY)).astype(np.float32)
    ends = {}
    for name, turn, own in (("agrees", 1, 0.0), ("turns", -1, 0.0), ("half", 1, 0.7)):
        found = shared.SharedSteps(shared.aligned(*parts(g)))
        factors, plain = [found.factor], []
        for n in range(60):
            weights = found.weights(turn**n * (way + own * n * noise))
            plain.append(weights.astype(np.float64) / factors[-1])
            factors.append(found.factor)
        mean, wanted = 0.52, 7.0
        for before, now, factor in zip(plain[:-1], plain[1:], factors[2:], strict=True):
            cosine = (before * now).sum() / np.sqrt((before**2).sum() * (now**2).sum())
            mean = 0.8 * mean + 0.2 * cosine
            wanted = min(max(wanted * np.exp(0.3 * (mean - 0.52)), 2.0), 14.0)
            assert factor == pytest.approx(wanted, rel=1e-5)
        ends[name] = found.factor
    assert ends["agrees"] == 14
    assert ends["turns"] == 2
    still = shared.SharedSteps(shared.aligned(*parts(g)))
    assert not still.weights(np.zeros((13, MANY), np.float32)).any()
    assert still.factor == 7
    still.before[:] = np.inf  # sums beyond float32
    still.weights(way)
    assert still.factor == 7


@pytest.mark.parametrize("kind", ["alike", "in one place", "wide and narrow", "infinite", "1e25", "1e10"])
def test_steps_stay_finite_where_gaussians_are_extreme(kind):
    g = many()
    if kind == "alike":
        g = g.take(np.zeros(MANY, np.int64))
    elif kind == "in one place":
        g = replace(g, means=np.zeros_like(g.means))
    elif kind == "wide and narrow":
        g = replace(g, log_scales=np.where(np.arange(3 * MANY).reshape(-1, 3) % 7 == 0, -16, 2).astype(np.float32))
    state = OwnAxes(g, CAMERAS)
    rows = np.random.default_rng(0).normal(size=(13, MANY)).astype(np.float32)
    if kind in ("infinite", "1e25", "1e10"):
        rows[:, 5] = np.inf if kind == "infinite" else float(kind)
    before = [array.copy() for array in state.arrays]
    for step in (1, 2):
        state.taken = step
        common = state.common(rows)
        assert all(np.isfinite(part).all() for part in common)
        assert np.abs(common[2]).max() < 1
        steps.own_axes(
            rows, state.RATES, state.CLIPS, state.spread, *state.BETAS, step, *state.arrays, 0.0,
            state.first, state.second, *common,
        )  # fmt: skip
    rest = np.arange(MANY) != 5
    assert all(np.isfinite(array[rest]).all() for array in state.arrays)
    moved = np.abs(state.arrays[2] - before[2])[rest]
    assert 0.01 < np.median(moved) < 0.5  # one Gaussian neither stops all others nor drives them
