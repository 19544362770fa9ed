"""Nothing that is not finite, whatever the scene and the rates: 100 steps on every change, 10,000 with --long."""

from dataclasses import replace

import numpy as np
import pytest

from tests.random_clouds import extreme_cloud, random_cloud
from vvgt_cli.cameras import default_views
from vvgt_cli.closed_form import VbmOptions, initialise
from vvgt_cli.dvr import RenderSettings, Scene, render_views
from vvgt_cli.look import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.refine import METHODS, OptimizeOptions, optimize
from vvgt_cli.refine.states import Fields, OwnAxes
from vvgt_cli.refine.steps import adam
from vvgt_cli.splat import render
from vvgt_cli.volume import read_volume, statistics

FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "colors")
STEPS = [pytest.param(100, id="100"), pytest.param(10_000, id="10000", marks=pytest.mark.long)]
SIZE = 32


@pytest.fixture(scope="module")
def stiff():
    """A step function of opacity 1 over an optical depth of 1e6: (start, cameras, views)."""
    volume = read_volume("example:blob:16")
    numbers = statistics(volume)
    x = [0.0, 0.4, 0.4, 1.0]
    tf = TransferFunction("step", PiecewiseOpacity(x, [0, 0, 1, 1]), ColorMap(x, np.float64([*np.eye(3), [1, 1, 0]])))
    scene = Scene.build(volume, tf, 11.5e-6, (numbers.lo, numbers.hi))
    cameras = default_views("train", 6, size=SIZE)
    views = render_views(scene, cameras, RenderSettings())
    assert views[..., 3].max() == pytest.approx(1, abs=2e-3)
    return initialise(scene, VbmOptions(150, SIZE)).gaussians, cameras, views


def assert_sound(gaussians, cameras):
    for field in FIELDS:
        assert np.isfinite(getattr(gaussians, field)).all(), field
    for camera in cameras:
        assert np.isfinite(render(gaussians, camera)).all()


@pytest.mark.parametrize("count", STEPS)
@pytest.mark.parametrize("rates", [0.01, 1, 100])
@pytest.mark.parametrize("method", METHODS)
def test_stiff_scenes_stay_finite(stiff, method, rates, count, monkeypatch):
    start, cameras, views = stiff
    monkeypatch.setattr(OwnAxes, "RATES", OwnAxes.RATES * rates)
    monkeypatch.setattr(Fields, "RATES", tuple(rates * rate for rate in Fields.RATES))
    options = OptimizeOptions.of(method, steps=count, max_gaussians=300)
    result, record = optimize(start, cameras, views, options)
    assert record.steps == count
    assert_sound(result, cameras)


@pytest.mark.parametrize("count", STEPS)
@pytest.mark.parametrize(
    ("kind", "method"), [*(("extreme", m) for m in METHODS), ("needles", "axes"), ("alike", "axes")]
)
def test_extreme_gaussians_stay_finite(stiff, kind, method, count, monkeypatch):
    _, cameras, views = stiff
    start = extreme_cloud() if kind == "extreme" else random_cloud(700)
    if kind == "needles":
        start = replace(start, log_scales=np.log(np.tile([0.8, 1e-4, 1e-4], (700, 1))))
    elif kind == "alike":
        start = start.take(np.zeros(700, np.int64))
    monkeypatch.setattr(OwnAxes, "RATES", OwnAxes.RATES * 100)
    result, _ = optimize(start, cameras, views, OptimizeOptions.of(method, steps=count, max_gaussians=700))
    assert_sound(result, cameras)


@pytest.mark.parametrize(("count", "size"), [(1, SIZE), (10, SIZE), (20, 1)])
def test_few_gaussians_and_views_of_one_pixel_stay_finite(stiff, count, size):
    cameras, views = [camera.resized(size / SIZE) for camera in stiff[1]], np.full((6, size, size, 4), 0.5, np.float32)
    result, _ = optimize(random_cloud(count), cameras, views, OptimizeOptions(steps=40))
    assert len(result) == count
    assert_sound(result, cameras)


@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
def test_the_kernel_of_adam_is_adam_in_float64(size):
    rng = np.random.default_rng(0)
    values = rng.normal(size=500).astype(np.float32)
    exact = values.astype(np.float64)
    first, second, m, v = np.zeros_like(values), np.zeros_like(values), np.zeros(500), np.zeros(500)
    for n in range(1, 31):
        slopes = (rng.normal(size=500) * size).astype(np.float32)
        adam(values, slopes, 1e-3, 0.9, 0.999, n, first, second)
        m, v = 0.9 * m + 0.1 * slopes, 0.999 * v + 0.001 * slopes.astype(np.float64) ** 2
        exact -= 1e-3 * (m / (1 - 0.9**n)) / (np.sqrt(v / (1 - 0.999**n)) + 1e-15)
    np.testing.assert_allclose(values, exact, atol=1e-5)


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
