"""3DGS' density control: limits hold, pictures stay close, what a Gaussian has learned goes with it."""

import numpy as np
import pytest

from tests.random_clouds import random_cloud
from vvgt_cli.cameras import default_views
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.refine import OptimizeOptions, optimize
from vvgt_cli.refine.states import DENSE, FAINTEST, SHRINK, SLOPE, Densified, densify
from vvgt_cli.splat import render

EXTENT = 3.3
CAMERAS = default_views("train", 6, size=48)


def cloud(count=60, sigma=0.02, seed=0):
    return random_cloud(count, seed, sigma, 0.1, (-0.5, 0.9))


def views(g):
    return np.stack([render(g, camera) for camera in CAMERAS])


@pytest.mark.parametrize("sigma", [0.02, 0.1])
def test_small_ones_are_cloned_and_large_ones_split_where_the_slope_is_steep(sigma):
    g = cloud(sigma=sigma)
    score = np.where(np.arange(60) % 3 == 0, 2 * SLOPE, 0.5 * SLOPE)
    denser, origin = densify(g, score, 1000, EXTENT, np.random.default_rng(0))
    assert len(denser) == 80
    steep = np.arange(0, 60, 3)
    rest = np.setdiff1d(np.arange(60), steep)
    np.testing.assert_array_equal(denser.means[rest], g.means[rest])
    if sigma < DENSE * EXTENT:
        np.testing.assert_array_equal(denser.means[60:], g.means[steep])
        both = 1 - (1 - denser.opacity[steep]) * (1 - denser.opacity[60:])
        np.testing.assert_allclose(both, g.opacity[steep], rtol=1e-5)
        assert (origin[:60] == np.arange(60)).all()
    else:
        np.testing.assert_allclose(denser.log_scales[60:], g.log_scales[steep] - np.log(SHRINK), rtol=1e-6)
        np.testing.assert_array_equal(denser.log_scales[steep], denser.log_scales[60:])
        assert (origin[steep] == -1).all()
        away = (denser.means[60:] - g.means[steep]) / np.exp(g.log_scales[steep]).max(axis=1, keepdims=True)
        assert 0.2 < np.sqrt((away**2).mean()) < 1.5
    assert (origin[60:] == -1).all()


def test_the_limit_holds_and_the_steepest_come_first():
    g, rng = cloud(), np.random.default_rng(0)
    score = rng.permutation(60) * SLOPE + SLOPE / 2
    denser, _ = densify(g, score, 65, EXTENT, rng)
    assert len(denser) == 65
    steepest = np.sort(np.argsort(-score)[:5])
    np.testing.assert_array_equal(np.sort(denser.colors[60:], axis=0), np.sort(g.colors[steepest], axis=0))
    assert len(densify(g, score, 40, EXTENT, rng)[0]) == 40


def test_faint_ones_go_but_never_all():
    g = cloud()
    logits = np.where(np.arange(60) < 20, np.log(FAINTEST) - 1, g.opacity_logits)
    faint = Gaussians(g.means, g.log_scales, g.quaternions, logits, g.colors)
    kept, origin = densify(faint, np.zeros(60), 1000, EXTENT, np.random.default_rng(0))
    np.testing.assert_array_equal(origin, np.arange(20, 60))
    np.testing.assert_array_equal(kept.colors, g.colors[20:])
    dark = Gaussians(g.means, g.log_scales, g.quaternions, np.full(60, -9.0) - np.arange(60), g.colors)
    assert densify(dark, np.zeros(60), 1000, EXTENT, np.random.default_rng(0))[1].tolist() == [0]


def test_a_run_grows_to_its_limit_and_gets_nearer():
    truth = cloud(120, sigma=0.08, seed=2)
    start = cloud(30, sigma=0.1, seed=3)
    check = CAMERAS[:2], views(truth)[:2]
    options = OptimizeOptions.of("3dgs", steps=150, max_gaussians=50)
    result, record = optimize(start, CAMERAS, views(truth), options, check)
    assert 30 < len(result) <= 50
    assert record.psnr_after > record.psnr_before + 2
    assert record.steps == 150  # looks without gain do not end it
    alone, _ = optimize(start, CAMERAS, views(truth), OptimizeOptions.of("3dgs", steps=30), check)
    assert len(alone) <= 30


def test_opacities_are_reset_where_there_is_time_to_recover():
    g, options = cloud(sigma=0.1), OptimizeOptions.of("3dgs", steps=4000)
    state = Densified(g, CAMERAS, options)
    target = views(g)
    state.taken = 400
    state.step(CAMERAS[0], target[0], 0.1, 1.0)
    assert state.gaussians().opacity.max() < 0.0101
    short = Densified(g, CAMERAS, options)
    short.taken = 20
    short.step(CAMERAS[0], target[0], 0.1, 1.0)
    assert short.gaussians().opacity.max() > 0.3
