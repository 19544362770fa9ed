"""Colours of the closed form against the blur of its Gaussians."""

from dataclasses import replace

import numpy as np
import pytest

from vvgt_cli.cameras import default_views
from vvgt_cli.closed_form import VbmOptions, initialise, sharpen
from vvgt_cli.closed_form.sharpen import AMOUNT, BRIGHTEST, WINDOW, curves, sharpened
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.types import concatenate
from vvgt_cli.images.metrics import psnr
from vvgt_cli.look.readers import minimal
from vvgt_cli.splat import render
from vvgt_cli.volume import Volume

BOX = np.array([1.0, 1.0, 1.0])
BLUE, YELLOW = [0.1, 0.3, 0.9], [0.9, 0.8, 0.1]


def cloud(n, seed=0, harmonics=None):
    """Gaussians of many widths, about as far apart as they are wide."""
    rng = np.random.default_rng(seed)
    widths = np.exp(rng.normal(np.log(0.6 * n ** (-1 / 3)), 0.4, (n, 3)))
    quaternions = rng.normal(size=(n, 4))
    return Gaussians(
        rng.random((n, 3)).astype(np.float32), np.log(widths).astype(np.float32),
        (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).astype(np.float32),
        rng.normal(-2, 1, n).astype(np.float32), rng.random((n, 3)).astype(np.float32),
        *([] if harmonics is None else [rng.normal(0, 0.1, (n, harmonics, 3)).astype(np.float32)]),
    )  # fmt: skip


def twin(gaussians, near, seen):
    """Colours in float64, all pairs at once; ``near`` (n, n) says which count."""
    means, widths = gaussians.means.astype(np.float64), np.exp(gaussians.log_scales.astype(np.float64)).mean(axis=1)
    areas = widths**2 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    apart = ((means[:, None] - means) ** 2).sum(axis=-1)
    weights = np.where(near, areas * np.exp(-apart / (2 * (widths[:, None] ** 2 + widths**2))), 0.0)
    mean = lambda w, v: w @ v / w.sum(axis=1, keepdims=True)  # noqa: E731
    colors = gaussians.colors.astype(np.float64)
    hidden = np.maximum(1 - seen[:, None] / mean(weights, seen[:, None]), 0)
    sharp = colors + float(AMOUNT) * (1 - hidden) * (colors - mean(weights, colors))
    return sharp + hidden * (mean(weights * seen, colors) - colors)


@pytest.fixture
def unbounded(monkeypatch):
    monkeypatch.setattr(sharpen, "BRIGHTEST", np.inf)
    monkeypatch.setattr(sharpen, "DARKEST", -np.inf)


@pytest.mark.usefixtures("unbounded")
def test_the_kernel_is_its_twin():
    gaussians, seen = cloud(700), np.random.default_rng(8).random(700) ** 3
    _, places = curves(gaussians.means, BOX)
    near = (np.abs(places[:, :, None] - places[:, None, :]) <= WINDOW).any(axis=0)
    assert 0.01 < near.mean() < 0.2
    np.testing.assert_allclose(sharpened(gaussians, seen, BOX).colors, twin(gaussians, near, seen), atol=2e-6)


@pytest.mark.usefixtures("unbounded")
@pytest.mark.parametrize("kind", ["random", "lattice"])
def test_nearly_all_who_overlap_are_found(kind):
    gaussians = cloud(1728, 1)
    if kind == "lattice":
        places = (np.stack(np.meshgrid(*[np.arange(12)] * 3), axis=-1).reshape(-1, 3) + 0.5) / 12
        gaussians = replace(gaussians, means=places.astype(np.float32))
    alike = np.ones(1728)
    wrong = np.abs(sharpened(gaussians, alike, BOX).colors - twin(gaussians, np.ones((1728, 1728), bool), alike))
    assert np.sqrt((wrong**2).mean()) < 0.065 * AMOUNT  # of colours even in [0, 1]: far ones are left out
    assert np.abs(wrong).max() < 0.3 * AMOUNT


def test_one_colour_stays_and_order_and_scale_do_not_matter():
    plain = replace(cloud(300, 2), colors=np.full((300, 3), 0.3, np.float32))
    np.testing.assert_allclose(sharpened(plain, np.ones(300), BOX).colors, plain.colors, atol=1e-6)
    gaussians = cloud(300, 3)
    rng = np.random.default_rng(4)
    seen, order = rng.random(300), rng.permutation(300)
    found = sharpened(gaussians, seen, BOX).colors
    np.testing.assert_array_equal(sharpened(gaussians.take(order), seen[order], BOX).colors, found[order])
    larger = replace(gaussians, means=64 * gaussians.means, log_scales=gaussians.log_scales + np.float32(np.log(64)))
    np.testing.assert_allclose(sharpened(larger, seen, 64 * BOX).colors, found, atol=1e-5)


def test_what_is_extreme_stays_finite_and_within_its_range():
    gaussians = cloud(400, 5)
    gaussians.means[:50] = gaussians.means[0]  # all at one place
    gaussians.log_scales[20:100] = -400
    gaussians.log_scales[200:210] = 80
    gaussians.opacity_logits[60:200] = -800
    gaussians.colors[210:220] = 3.0  # brighter than the limit before
    seen = np.where(np.arange(400) % 3 == 0, 0.0, 1e-9)
    found = sharpened(gaussians, seen, BOX).colors
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    assert (np.delete(found, range(210, 220), axis=0) <= BRIGHTEST).all()
    assert (found[210:220] <= 3.0).all()
    faint = sharpened(replace(gaussians, opacity_logits=np.full(400, -800, np.float32)), seen, BOX)  # areas of nothing
    assert np.isfinite(faint.colors).all()
    for n in (0, 1):
        assert len(sharpened(gaussians.take(np.arange(n)), seen[:n], BOX)) == n


@pytest.mark.usefixtures("unbounded")
def test_harmonics_are_sharpened_as_colours_are():
    gaussians = cloud(300, 6, harmonics=8)
    second = replace(gaussians, colors=np.ascontiguousarray(gaussians.harmonics[:, 3]))
    found, beside = sharpened(gaussians, np.ones(300), BOX).harmonics, sharpened(second, np.ones(300), BOX).colors
    np.testing.assert_allclose(found[:, 3], beside, atol=1e-6)


def fog(n=40):
    """A fog whose colour, not its density, has structure of a few voxels."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    values = 0.5 + 0.5 * np.sin(9 * x) * np.cos(8 * y) * np.sin(10 * z)
    points = [{"x": 0, "rgb": [0.1, 0.2, 0.9], "opacity": 0.05}, {"x": 1, "rgb": [0.9, 0.8, 0.1], "opacity": 0.05}]
    function = minimal.read({"name": "fog", "opacity_unit_distance": 1.0, "points": points}, "fog")
    return Scene.build(Volume(values.astype(np.float32), (1.0, 1.0, 1.0), name="fog"), function, 1.0, (0.0, 1.0))


def test_what_is_hidden_takes_the_colour_of_what_hides_it():
    behind, front = cloud(400, 9), cloud(400, 10)
    both = replace(behind.take(np.arange(400)), colors=np.tile(np.float32(YELLOW), (400, 1)))
    both = concatenate([both, replace(front, colors=np.tile(np.float32(BLUE), (400, 1)))])
    found = sharpened(both, np.concatenate([np.full(400, 0.01), np.ones(400)]), BOX).colors
    assert np.abs(found[:400] - BLUE).mean() < 0.1 * np.abs(np.subtract(YELLOW, BLUE)).mean()
    alike = sharpened(both, np.ones(800), BOX).colors
    assert np.abs(alike[:400] - YELLOW).mean() < 0.3 * np.abs(np.subtract(YELLOW, BLUE)).mean()


def test_the_closed_form_gains_where_colours_vary(monkeypatch):
    shown, cameras = fog(), default_views("test", 3, size=200)
    views = [render_view(shown, camera, RenderSettings()) for camera in cameras]

    def score():
        made = initialise(shown, VbmOptions(3000, 200)).gaussians
        return np.mean([psnr(view[..., :3], render(made, c)[..., :3]) for c, view in zip(cameras, views, strict=True)])

    with_it = score()
    monkeypatch.setattr("vvgt_cli.closed_form.pyramid.sharpened", lambda gaussians, seen, half: gaussians)
    assert with_it > score() + 1
