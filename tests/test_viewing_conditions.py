"""What a score is a score of: blocks or the whole, the rule, the field of view."""

import numpy as np
import pytest

from tests.closed_form_scenes import Tent, scene_of
from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.blocks import Blocks
from vvgt_cli.closed_form import VbmOptions, initialise
from vvgt_cli.dvr import RenderSettings, render_view
from vvgt_cli.images.metrics import psnr, score_view, ssim, texture
from vvgt_cli.score.viewing import (
    ViewingCondition,
    condition_pictures,
    condition_views,
    score_conditions,
    score_texture,
    screens,
    texture_note,
    viewing_conditions,
    zoomed,
)
from vvgt_cli.score.views import score_drawn_view, score_test_views
from vvgt_cli.splat import render
from vvgt_cli.volume import read_volume

ONE_RAY = RenderSettings(samples=1)


@pytest.fixture(scope="module")
def pair():
    scene = scene_of(read_volume("example:blob:12"), Tent())
    return scene, initialise(scene, VbmOptions(60, 32)).gaussians


def test_a_condition_close_up_is_the_same_place_with_a_narrower_field():
    camera = default_views("test", size=100)[4]
    near = zoomed(camera, 10.0)
    assert np.array_equal(near.position, camera.position)
    assert np.array_equal(near.rotation, camera.rotation)
    assert np.degrees(2 * np.arctan(50 / near.fy)) == pytest.approx(10)
    assert near.fx == near.fy
    assert zoomed(camera, 40.0).fy == pytest.approx(camera.fy)


def test_conditions_are_scored_by_their_rule_size_and_field_worst_first(pair):
    scene, gaussians = pair
    rules, views = ("inria", "playcanvas"), (4, 9)
    pictures = condition_pictures([(24, 40.0), (40, 10.0)], views)
    found = score_conditions(gaussians, condition_views(scene, pictures, ONE_RAY), rules)
    assert [condition.psnr for condition in found] == sorted(condition.psnr for condition in found)
    assert len(found) == 4
    for condition in found:
        cameras = [zoomed(default_views("test", size=condition.size)[i], condition.field_of_view) for i in views]
        pictures = [(render_view(scene, c, ONE_RAY), render(gaussians, c, condition.rule)) for c in cameras]
        expected = np.mean([psnr(theirs[..., :3], np.clip(ours[..., :3], 0, 1)) for theirs, ours in pictures])
        assert condition.psnr == pytest.approx(expected, abs=1e-6)
    assert ViewingCondition("inria", 400, 10.0, 30.0).name() == "inria 400 px close up"
    assert screens(1080) == [(1080, 40), (2160, 40)]
    assert screens(2160) == [(2160, 40), (4320, 40)]
    assert screens(2159) == [(2159, 40), (2160, 40)]
    assert viewing_conditions(1080) == [(400, 40), (800, 40), (1080, 40), (2160, 40), (1080, 10)]


def test_texture_is_measured_in_close_views(pair):
    _, gaussians = pair
    scene = scene_of(read_volume("example:blob:12"), Tent(width=0.45, top=0.9999))  # opaque inside
    ticks = []
    found = score_texture(scene, gaussians, 96, "playcanvas", ONE_RAY, lambda *done: ticks.append(done))
    cameras = [zoomed(default_views("test", size=96)[i], 14.0) for i in (0, 4, 9)]
    pictures = [(render_view(scene, c, ONE_RAY), render(gaussians, c, "playcanvas")) for c in cameras]
    assert found == texture(pictures)
    assert found.blocks > 0
    assert ticks == [(1, 3), (2, 3), (3, 3)]
    assert f"{found.ours:.2f} levels" in texture_note(found)
    assert texture_note(texture([])) == "nothing in it is opaque and smooth"


def test_errors_are_of_the_blocks_and_perception_is_of_the_whole():
    rng = np.random.default_rng(0)
    reference, ours = (rng.random((48, 64, 4)).astype(np.float32) for _ in range(2))
    blocks = Blocks(64, 48, np.array([1, 6]))
    seen, alone = score_drawn_view(reference, ours, blocks), score_drawn_view(reference, ours, blocks, whole=False)
    mask = blocks.mask()
    assert mask.sum() == 2 * 256
    assert seen.psnr == alone.psnr == pytest.approx(psnr(reference[..., :3], ours[..., :3], mask))
    assert abs(seen.psnr - psnr(reference[..., :3], ours[..., :3])) > 1e-3
    assert seen.ssim == pytest.approx(ssim(reference[..., :3], ours[..., :3]))
    assert seen.flip == score_view(reference, ours).flip
    assert (alone.ssim, alone.flip) == (None, None)
    assert score_drawn_view(reference, ours, None) == score_view(reference, ours)


def test_scores_are_by_the_rule_of_the_views_asked_for(pair):
    scene, gaussians = pair
    by = {}
    for rule in ("inria", "playcanvas"):
        scores = score_test_views(scene, gaussians, 32, ONE_RAY, rule=rule, every=False)
        cameras = [default_views("test", size=32)[i] for i in (0, 4, 9)]
        expected = [psnr(render_view(scene, c, ONE_RAY)[..., :3], render(gaussians, c, rule)[..., :3]) for c in cameras]
        assert [view.psnr for view in scores.per_view] == pytest.approx(expected)
        by[rule] = scores.psnr
    assert by["inria"] != by["playcanvas"]
