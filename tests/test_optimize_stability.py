"""Nothing that is not finite, whatever the scene and the rates: 100 steps on every change, 10,000 with --long."""

from __future__ import annotations

import numpy as np
import pytest

from vvgt_cli.cameras import default_views
from vvgt_cli.closed_form import VbmOptions, initialise
from vvgt_cli.dvr import RenderSettings, Scene, render_views
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.look import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.refine import OptimizeOptions, optimize
from vvgt_cli.refine.states import Fields, OwnAxes
from vvgt_cli.splat import render
from vvgt_cli.synth import open_volume
from vvgt_cli.volume import statistics

FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "colors")
STEPS = [pytest.param(100, id="100"), pytest.param(10_000, id="10000", marks=pytest.mark.long)]
SIZE = 32


@pytest.fixture(scope="module")
def stiff():
    """A step function of opacity 1 over an optical depth of 1e6: (start, cameras, views)."""
    volume = open_volume("example:blob:16")
    numbers = statistics(volume)
    x = [0.0, 0.4, 0.4, 1.0]
    tf = TransferFunction("step", PiecewiseOpacity(x, [0, 0, 1, 1]), ColorMap(x, np.float64([*np.eye(3), [1, 1, 0]])))
    scene = Scene.build(volume, tf, 11.5e-6, (numbers.lo, numbers.hi))
    cameras = default_views("train", 6, size=SIZE)
    views = render_views(scene, cameras, RenderSettings())
    assert views[..., 3].max() == pytest.approx(1, abs=2e-3)
    return initialise(scene, VbmOptions(150, SIZE)).gaussians, cameras, views


def extremes():
    """Needles, discs, points and giants, clear and opaque, beside and behind the cameras."""
    rng = np.random.default_rng(0)
    return Gaussians(
        rng.normal(size=(80, 3)) * 10.0 ** rng.uniform(-2, 1, (80, 1)),
        rng.uniform(-25, 4, (80, 3)),
        rng.normal(size=(80, 4)),
        rng.uniform(-60, 60, 80),
        rng.uniform(0, 40, (80, 3)),
    )


def assert_sound(gaussians, cameras):
    for field in FIELDS:
        assert np.isfinite(getattr(gaussians, field)).all(), field
    for camera in cameras:
        assert np.isfinite(render(gaussians, camera)).all()


@pytest.mark.parametrize("count", STEPS)
@pytest.mark.parametrize("rates", [1, 100])
@pytest.mark.parametrize("method", ["frame", "adam", "3dgs"])
def test_stiff_scenes_stay_finite(stiff, method, rates, count, monkeypatch):
    start, cameras, views = stiff
    monkeypatch.setattr(OwnAxes, "RATES", OwnAxes.RATES * rates)
    monkeypatch.setattr(Fields, "RATES", tuple(rates * rate for rate in Fields.RATES))
    options = OptimizeOptions.of(method, steps=count, max_gaussians=300)
    result, record = optimize(start, cameras, views, options)
    assert record.steps == count
    assert_sound(result, cameras)


@pytest.mark.parametrize("count", STEPS)
@pytest.mark.parametrize("method", ["frame", "adam"])
def test_extreme_gaussians_stay_finite(stiff, method, count, monkeypatch):
    _, cameras, views = stiff
    monkeypatch.setattr(OwnAxes, "RATES", OwnAxes.RATES * 100)
    result, _ = optimize(extremes(), cameras, views, OptimizeOptions(steps=count, method=method))
    assert_sound(result, cameras)


@pytest.mark.parametrize("count", STEPS)
def test_what_decides_never_gets_worse(stiff, count, monkeypatch):
    """Rates 100 times too large, and check views: the run ends by itself, with no less than it began with."""
    start, cameras, views = stiff
    monkeypatch.setattr(OwnAxes, "RATES", OwnAxes.RATES * 100)
    judges = default_views("check", 2, size=SIZE)
    check = judges, np.stack([render(start, camera) for camera in judges])
    result, record = optimize(start, cameras, views, OptimizeOptions(steps=count, check_every=5), check)
    assert record.psnr_after == record.psnr_before == 150
    assert result is start
