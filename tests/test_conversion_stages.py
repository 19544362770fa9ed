"""Parts of the stages of a conversion: which views, how fine, and what viewers leave out."""

from dataclasses import replace

import numpy as np
import pytest

from vvgt_cli.cameras import default_views
from vvgt_cli.closed_form import VbmOptions, initialise
from vvgt_cli.conversion.stages.refinement import refine, without_undrawn
from vvgt_cli.conversion.stages.views import ray_settings, suits_small_views
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.look.readers import minimal
from vvgt_cli.progress import Console
from vvgt_cli.refine import OptimizeOptions
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.score.views import Views, render_check_views
from vvgt_cli.splat import render
from vvgt_cli.volume import Volume


def test_gaussians_are_wide_by_their_middle_axis():
    camera = default_views("check", 1, size=400)[0]
    pixel = np.linalg.norm(camera.position) / camera.fx
    scales = np.log(np.float32([[0.1, 1.0, 5.0]]) * pixel)
    one = lambda size, logit=0.0: Gaussians(  # noqa: E731
        np.zeros((1, 3), np.float32), scales + np.float32(np.log(size)), np.float32([[1, 0, 0, 0]]),
        np.full(1, logit, np.float32), np.zeros((1, 3), np.float32),
    )  # fmt: skip
    assert suits_small_views(one(1.0), 400)
    assert not suits_small_views(one(1.0, 3.0), 400)  # opaque
    assert not suits_small_views(one(0.8), 400)
    assert suits_small_views(one(1.0), 1080)  # its views are no larger
    assert not suits_small_views(one(1.0), 200)


def test_blocks_score_like_the_whole_picture(tmp_path):
    line = np.linspace(-1, 1, 24, dtype=np.float32)
    ball = Volume(1 - np.sqrt(sum(np.square(np.meshgrid(line, line, line)))))
    points = [{"x": x, "rgb": [1, abs(x), 0.2], "opacity": o} for x, o in ((-1, 0), (0.2, 0), (0.5, 0.5), (1, 0.9))]
    scene = Scene.build(ball, minimal.read({"points": points}, "ball"), 1.0, (-0.8, 1.0))
    cameras = default_views("check", 2, size=640)
    judged = render_check_views(scene, cameras, RenderSettings())
    assert judged.images.shape[0] == len(judged.blocks) == 2
    assert judged.images[0].size < 0.55 * 640 * 640 * 4
    for camera, blocks, picked in zip(cameras, judged.blocks, judged.images, strict=True):
        np.testing.assert_allclose(blocks.pick(render_view(scene, camera)), picked, atol=0.1)  # rays at their edges
        assert np.abs(blocks.pick(render_view(scene, camera)) - picked).mean() < 1e-4


def test_gaussians_that_viewers_discard_are_not_written():
    camera = default_views("check", 1, size=1000)[0]
    pixel = np.linalg.norm(camera.position) / camera.fx
    sizes = np.log(np.float32([0.1, 0.5, 2.0, 2.0])[:, None] * pixel * np.float32([1, 0.5, 0.1]))
    logits = np.float32([2.0, 0.0, 0.0, -6.0])
    turn, grey = np.tile(np.float32([1, 0, 0, 0]), (4, 1)), np.full((4, 3), 0.5, np.float32)
    kept = without_undrawn(Gaussians(np.zeros((4, 3), np.float32), sizes, turn, logits, grey), 1000)
    assert len(kept) == 3  # the faint one is gone
    np.testing.assert_allclose(np.exp(kept.log_scales.max(axis=1)) / pixel, [0.5, 0.5, 2.0], rtol=1e-5)
    mass = lambda logit, scales: 1 / (1 + np.exp(-logit)) * np.exp(scales[0] + scales[1])  # noqa: E731
    assert mass(kept.opacity_logits[0], kept.log_scales[0]) == pytest.approx(mass(logits[0], sizes[0]), rel=1e-4)
    assert np.array_equal(kept.opacity_logits[1:], logits[1:3])


@pytest.mark.parametrize(("edge", "samples"), [(0.4, 1), (0.01, None)])
def test_hard_edges_get_adaptive_rays(edge, samples):
    """A ball's surface, over a wide range of values or within a hundredth of it."""
    line = np.linspace(-1, 1, 32, dtype=np.float32)
    z, y, x = np.meshgrid(line, line, line, indexing="ij")
    ball = Volume(1 - np.sqrt(x * x + y * y + z * z))
    node = lambda v, o: {"x": v, "rgb": [1.0, 0.5 + v / 4, 0.2], "opacity": o}  # noqa: E731
    points = [node(-1.0, 0.0), node(0.3, 0.0), node(0.3 + edge, 0.9), node(1.0, 0.9)]
    scene = Scene.build(ball, minimal.read({"points": points}, "edge"), 1.0, (-0.8, 1.0))
    start = initialise(scene, VbmOptions(4000, 128)).gaussians
    for size, rule in ((128, INRIA), (64, INRIA.at(0.5))):
        assert ray_settings(scene, start, size, rule).samples == samples


def test_descent_may_begin_elsewhere_but_never_ends_below_the_start():
    rng = np.random.default_rng(0)
    means, colors = rng.uniform(-0.4, 0.4, (30, 3)), rng.random((30, 3))
    truth = Gaussians(means, np.full((30, 3), -2.0), np.eye(1, 4).repeat(30, 0), np.full(30, 1.0), colors)
    cameras = default_views("train", 4, size=48)
    views = Views(cameras, np.stack([render(truth, camera) for camera in cameras]))
    start = replace(truth, colors=np.clip(colors + 0.05, 0, 1))
    run, options = Run(Console(quiet=True), ConversionReport("convert")), OptimizeOptions(steps=12)
    wrecked = replace(start, colors=1 - colors)
    before = views.psnr(start)
    kept = refine(run, start, views, views, options, (wrecked, before))
    np.testing.assert_allclose(kept.colors, start.colors, atol=1e-6)
    stage = run.report.stages[-1]
    assert stage.kept is False
    assert stage.psnr_before == stage.psnr == pytest.approx(views.psnr(start), abs=1e-6)
    near = replace(start, colors=np.clip(colors + 0.02, 0, 1))
    still = OptimizeOptions(steps=0)
    assert views.psnr(refine(run, start, views, views, still, (near, before))) == pytest.approx(
        views.psnr(near), abs=1e-3
    )
    assert run.report.stages[-1].kept is True
    result = refine(run, start, views, views, options, (near, before))
    assert views.psnr(result) > max(views.psnr(start), views.psnr(near))
    assert run.report.stages[-1].psnr_before == pytest.approx(views.psnr(start), abs=1e-6)
    assert run.report.refinement["psnr_before"] == run.report.stages[-1].psnr_before
