"""Blocks of pixels that stand for a picture."""

import numpy as np
import pytest

from tests.random_clouds import random_cloud
from vvgt_cli.cameras.blocks import BLOCK, ENOUGH, spread_blocks
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.errors import UsageError
from vvgt_cli.look.readers import minimal
from vvgt_cli.splat import render
from vvgt_cli.volume import Volume


@pytest.mark.parametrize("size", [(1080, 1080), (2160, 2160), (1920, 1080), (801, 643)])
def test_blocks_are_as_many_in_every_view_lie_inside_and_leave_no_line_out(size):
    width, height = size
    found = [spread_blocks(width, height, shift) for shift in range(30)]
    assert len({blocks.numbers.size for blocks in found}) == 1
    assert 0.6 * ENOUGH < found[0].numbers.size < 1.5 * ENOUGH
    for blocks in found:
        assert np.all(np.diff(blocks.numbers) > 0)
        mask = blocks.mask()
        assert mask.shape == (height, width)
        assert mask.sum() == blocks.numbers.size * BLOCK**2  # none reaches beyond an edge
    tiles = found[0].mask()[::BLOCK, ::BLOCK][: height // BLOCK, : width // BLOCK]
    assert tiles.any(axis=0).all()
    assert tiles.any(axis=1).all()
    every = round((width // BLOCK) * (height // BLOCK) / ENOUGH)
    together = np.any([blocks.mask() for blocks in found[:every]], axis=0)
    assert together[: height // BLOCK * BLOCK, : width // BLOCK * BLOCK].mean() > 0.99


def test_small_pictures_are_taken_whole():
    assert spread_blocks(400, 400) is None
    assert spread_blocks(16, 16) is None
    assert spread_blocks(1, 1) is None


@pytest.mark.parametrize(("width", "height"), [(800, 640), (810, 650)])
def test_what_is_picked_is_what_is_there(width, height):
    blocks = spread_blocks(width, height, 3)
    rows, columns = np.indices((height, width))
    picked = blocks.pick(np.stack([rows, columns], axis=-1))
    assert picked.shape == (blocks.numbers.size * BLOCK, BLOCK, 2)
    assert len({tuple(pixel) for pixel in picked.reshape(-1, 2)}) == blocks.mask().sum()
    assert blocks.mask()[picked[..., 0], picked[..., 1]].all()


def test_splats_on_blocks_are_the_whole_pictures_and_nothing_elsewhere():
    camera, gaussians = look_at((2.0, -1.7, 1.1), width=600, height=600), random_cloud(500, 3)
    blocks = spread_blocks(600, 600, 1)
    whole, part = render(gaussians, camera), render(gaussians, camera, blocks=blocks)
    assert np.array_equal(whole[blocks.mask()], part[blocks.mask()])
    assert not part[~blocks.mask()].any()
    assert part.any()


def ripples():
    values = (np.indices((20, 20, 20)).sum(axis=0) % 7 / 6).astype(np.float32)
    points = [{"x": x, "rgb": [x, 0.5, 1 - x], "opacity": 0.6 * x * x} for x in (0.0, 0.5, 1.0)]
    return Scene.build(Volume(values), minimal.read({"points": points}, "ripples"), 1.0, (0.0, 1.0))


def test_rays_over_a_screens_pixel_see_what_the_screen_does():
    scene, small, large = ripples(), look_at((3.0, 0.2, 0.4), width=24, height=24), RenderSettings(samples=2)
    few = render_view(scene, small, RenderSettings(samples=2, footprint=1 / 3))
    many = render_view(scene, small.resized(3), large)[1::3, 1::3]  # its pixels in the middle of ours
    np.testing.assert_allclose(few, many, atol=1e-5)
    assert np.abs(render_view(scene, small, large) - many).max() > 0.01
    with pytest.raises(UsageError, match="footprint"):
        RenderSettings(footprint=0)


def test_the_volume_on_blocks_is_the_whole_picture_but_for_rays_at_their_edges():
    scene, camera = ripples(), look_at((3.0, 0.2, 0.4), width=640, height=640)
    blocks = spread_blocks(640, 640)
    for settings, off in ((RenderSettings(samples=1), 0.0), (RenderSettings(), 2e-3)):
        whole, part = render_view(scene, camera, settings), render_view(scene, camera, settings, blocks)
        assert np.abs(whole - part)[blocks.mask()].mean() <= off
        assert not part[~blocks.mask()].any()
