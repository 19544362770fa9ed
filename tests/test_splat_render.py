"""The splatter against its float64 twin, the adjointness of `blend` and `gather`, and the corners of both."""

import math

import numpy as np
import pytest

from tests.random_clouds import extreme_cloud, random_cloud
from tests.splat_twin import gather_reference
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.constants import MIN_ALPHA
from vvgt_cli.gaussians.rules import INRIA, RULES
from vvgt_cli.splat import blend, gather, project, render, render_reference
from vvgt_cli.splat.render import depth_order

EYE = (2.0, -1.7, 1.1)
# Where alpha crosses 1/255, or T 1e-4, float32 may decide otherwise than float64: such a pixel is off by a 1/255 at
# most, or by the last splat's weight, T alpha <= 0.0099.
JUMP, TIGHT = 0.01, 3e-5


def camera(width=64, height=64, eye=EYE, fov=40.0):
    return look_at(eye, width=width, height=height, fov=fov)


def cloud(count, seed=0, scale=0.05, logit=0.0, box=0.6):
    return random_cloud(count, seed, scale, 0.3, (logit, 2.0), box, (-0.3, 1.2))


def assert_close(image, reference, tight=TIGHT):
    error = np.abs(image - reference)
    assert error.max() <= JUMP
    assert (error > tight).mean() <= 2e-3


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("size", [(64, 64), (1, 1), (17, 49), (80, 15)])
def test_random_clouds_match_the_twin(seed, size):
    g, c = cloud(300, seed), camera(*size)
    assert_close(render(g, c), render_reference(g, c))


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
@pytest.mark.parametrize("scale", [0.05, 0.012])
def test_every_rule_matches_the_twin(rule, scale):
    g, c = cloud(300, 12, scale=scale, logit=1.0), camera()
    image = render(g, c, rule)
    assert_close(image, render_reference(g, c, rule))
    assert image[..., 3].max() <= 1
    assert np.array_equal(image, render(g, c, rule.name))


def test_rules_differ_as_they_say():
    one = Gaussians(np.zeros((1, 3)), np.full((1, 3), np.log(0.06)), [[1, 0, 0, 0]], [0.0], [[1, 1, 1]])
    c = camera(257, 257)
    mass = {name: float(render(one, c, name)[..., 3].sum(dtype=np.float64)) for name in RULES}
    pixel = np.linalg.norm(c.position) / c.fx
    area = 2 * np.pi * (0.06 / pixel) ** 2 * 0.5  # of the whole Gaussian: opacity one half
    shifted = (1 - np.exp(-4) * (1 + 4)) / (1 - np.exp(-4))  # of exp(-p) - exp(-4), p < 4
    wide = 1 + 0.3 / (0.06 / pixel) ** 2
    assert mass["inria"] == pytest.approx(area * wide * (1 - 2 / 255), rel=3e-3)
    assert mass["compensated"] == pytest.approx(area * (1 - 2 / 255), rel=3e-3)
    assert mass["spark"] == pytest.approx(area * (1 - np.exp(-4)), rel=3e-3)
    assert mass["playcanvas"] == pytest.approx(area * (1 + (wide - 1) / 4) * shifted, rel=1e-2)  # and cut below 1/255
    assert mass["viser"] == pytest.approx(area * wide * (1 - 0.01 / 0.5), rel=3e-3)
    assert mass["three"] == pytest.approx(area * (1 - np.exp(-2)), rel=3e-3)
    assert mass["babylon"] == pytest.approx(area * (1 + (wide - 1) / 4) * (1 - np.exp(-4)), rel=3e-3)
    square = math.erf(2) ** 2  # of the mass, to two standard deviations of exp(-2 x^2) on both sides
    assert mass["cesium"] == pytest.approx(area * (1 + (wide - 1) / 16) * square, rel=3e-3)


def test_small_splats_are_left_out_where_viewers_do():
    c = camera(101, 101)
    pixel = np.linalg.norm(c.position) / c.fx
    for sigma, seen in ((0.2, False), (0.25, True)):  # px; 0.125 - 0.075 px^2 between them
        g = Gaussians(np.zeros((1, 3)), np.full((1, 3), np.log(sigma * pixel)), [[1, 0, 0, 0]], [3.0], [[1, 1, 1]])
        assert render(g, c, "playcanvas").any() == seen
        assert render(g, c, "inria").any()
        few = c.resized(1 / 101)  # one pixel, of the same middle
        assert render(g, few, RULES["playcanvas"].at(1 / 101)).any() == seen


def test_a_rule_at_a_ratio_shows_what_the_whole_size_does_at_fewer_points():
    g, c = cloud(60, 11, scale=0.03), camera(63, 63)
    large = render(g, c.resized(3))[1::3, 1::3]  # the same points
    for rule in RULES.values():
        np.testing.assert_allclose(render(g, c, rule.at(1 / 3)), render(g, c.resized(3), rule)[1::3, 1::3], atol=JUMP)
    assert np.abs(render(g, c) - large).mean() > 1e-3


def test_gaussians_in_one_place_match_the_twin():
    g, c = cloud(100, 6, 0.1, box=0.0), camera(48, 48)
    assert_close(render(g, c), render_reference(g, c), tight=1e-3)


@pytest.mark.parametrize("axes", [(0.8, 1e-4, 1e-4), (0.8, 0.8, 1e-4), (1e-6, 1e-6, 1e-6), (3.0, 3.0, 3.0)])
def test_needles_pancakes_points_and_giants_match_the_twin(axes):
    g = cloud(60, 1)
    g = Gaussians(g.means, np.log(np.tile(axes, (60, 1))), g.quaternions, g.opacity_logits, g.colors)
    c = camera()
    assert_close(render(g, c), render_reference(g, c), tight=1e-3)  # float32 cancels in the exponent of a long needle


def test_an_eye_inside_the_cloud_sees_what_is_ahead():
    g, c = cloud(400, 2, scale=0.02), camera(eye=(0.1, 0.05, 0.0), fov=90.0)
    image = render(g, c)
    assert_close(image, render_reference(g, c))
    behind = (g.means @ c.rotation.T + c.translation)[:, 2] <= 0.01
    assert 50 < behind.sum() < 350
    assert np.array_equal(image, render(g.take(np.flatnonzero(~behind)), c))


def test_alpha_is_clamped_at_99_percent():
    g = Gaussians(np.zeros((1, 3)), np.full((1, 3), np.log(0.5)), [[1, 0, 0, 0]], [30.0], [[1, 0.5, -1]])
    np.testing.assert_allclose(render(g, camera(33, 33))[16, 16], [0.99, 0.495, 0, 0.99], atol=1e-6)


def test_a_splat_below_one_255th_is_not_drawn():
    for alpha, seen in ((MIN_ALPHA * 0.99, False), (MIN_ALPHA * 1.01, True)):
        logit = np.log(alpha / (1 - alpha))
        g = Gaussians(np.zeros((1, 3)), np.full((1, 3), np.log(0.5)), [[1, 0, 0, 0]], [logit], [[1, 1, 1]])
        assert render(g, camera(33, 33)).any() == seen


@pytest.mark.parametrize("logit", [-3.0, 6.0])
def test_thousands_of_layers_end_pixels_as_the_twin_does(logit):
    g, c = cloud(3000, 3, scale=0.3, logit=logit, box=0.2), camera(20, 20)
    image = render(g, c)
    assert_close(image, render_reference(g, c))
    assert image[..., 3].min() >= 0
    assert image[..., 3].max() <= 1 - 1e-4 + 1e-6


def test_the_norm_of_a_quaternion_does_not_matter():
    g, c = cloud(200, 4), camera()
    factors = np.geomspace(1e-12, 1e12, 200)[:, None]
    scaled = Gaussians(g.means, g.log_scales, g.quaternions * factors, g.opacity_logits, g.colors)
    np.testing.assert_allclose(render(scaled, c), render(g, c), atol=JUMP)
    assert_close(render(scaled, c), render(g, c))


def test_no_gaussians_and_one():
    assert not render(cloud(0), camera()).any()
    gather(project(cloud(0), camera()), np.ones((4, 64, 64), np.float32), np.zeros((0, 5)))
    g = cloud(1, 5, scale=0.2, box=0.1, logit=3.0)
    assert render(g, camera()).max() > 0.1
    assert_close(render(g, camera()), render_reference(g, camera()))


def test_the_order_in_the_file_does_not_matter():
    g, c = cloud(500, 6), camera()
    assert np.array_equal(render(g, c), render(g.take(np.random.default_rng(0).permutation(500)), c))


def test_unusable_gaussians_are_left_out():
    g, c = cloud(4, 8, scale=0.2, box=0.1, logit=3.0), camera()
    log_scales = g.log_scales.copy()
    log_scales[1] = 400.0  # the covariance overflows
    odd = Gaussians(g.means, log_scales, g.quaternions, g.opacity_logits, g.colors)
    assert np.array_equal(render(odd, c), render(g.take(np.array([0, 2, 3])), c))
    log_scales[1] = 40.0  # it does not, but its inverse is 0 in float32: alpha is the same in every pixel
    assert np.isfinite(render(Gaussians(g.means, log_scales, g.quaternions, g.opacity_logits, g.colors), c)).all()


def test_blend_is_linear_in_colours_and_does_not_clamp():
    g, c = cloud(300, 9), camera()
    p = project(g, c)
    rng = np.random.default_rng(0)
    a, b = (rng.normal(size=(300, 3)).astype(np.float32) for _ in range(2))
    both = blend(p, 2 * a - 3 * b, c.height, c.width)[..., :3]
    parts = 2 * blend(p, a, c.height, c.width)[..., :3] - 3 * blend(p, b, c.height, c.width)[..., :3]
    assert both.min() < -0.5
    np.testing.assert_allclose(both, parts, atol=2e-5)


@pytest.mark.parametrize("size", [(64, 64), (33, 18)])
def test_gather_matches_the_twin_and_is_the_adjoint_of_blend(size):
    g, c = cloud(400, 10), camera(*size)
    p = project(g, c)
    rng = np.random.default_rng(0)
    field = rng.normal(size=(4, c.height, c.width)).astype(np.float32)
    out = np.ones((400, 5))  # added to, not overwritten
    gather(p, field, out)
    reference = gather_reference(g, c, field.astype(np.float64))
    np.testing.assert_allclose(out - 1, reference, atol=5 * JUMP)
    assert (np.abs(out - 1 - reference) > 3e-3).mean() < 0.01
    colors = rng.normal(size=(400, 3)).astype(np.float32)
    image = blend(p, colors, c.height, c.width).astype(np.float64)
    left = (image[..., :3] * field[:3].transpose(1, 2, 0)).sum()
    right = (colors * (out[:, 1:4] - 1)).sum()
    scale = np.abs(image[..., :3] * field[:3].transpose(1, 2, 0)).sum()
    assert abs(left - right) < 1e-6 * scale  # the same float32 weights in both
    np.testing.assert_allclose(image[..., 3].sum(), (out[:, 0] - 1).sum(), rtol=1e-5)


def test_a_million_white_gaussians_are_as_bright_as_they_are_opaque():
    g, c = cloud(1_000_000, 8, 0.004), camera(128, 128)
    white = Gaussians(g.means, g.log_scales, g.quaternions, g.opacity_logits, np.ones_like(g.colors))
    image = render(white, c)
    assert image[..., 3].max() <= 1 - 1e-4 + 1e-6
    np.testing.assert_allclose(image[..., :3], np.repeat(image[..., 3:], 3, axis=-1), atol=1e-6)


def test_extreme_gaussians_stay_finite_and_a_wide_picture_has_the_middle_of_a_narrow_one():
    image = render(extreme_cloud(), camera(48, 48))
    assert np.isfinite(image).all()
    assert image.min() >= 0
    assert (image[..., :3] <= 40 * image[..., 3:] + 1e-4).all()  # the brightest colour
    g = cloud(300, 9)
    wide, narrow = render(g, camera(4096, 16)), render(g, camera(16, 16))
    np.testing.assert_allclose(wide[:, 2040:2056], narrow, atol=1e-3)  # float32 at pixel 2048
    assert np.isfinite(wide).all()


def test_depths_sort_stably():
    rng = np.random.default_rng(0)
    depth = np.float32(rng.choice([0, 1e-30, 0.5, 1, 1.0000001, 3e38], 2000) * rng.integers(1, 3, 2000) / 2)
    np.testing.assert_array_equal(depth_order(depth), np.argsort(depth, kind="stable"))
    anywhere = rng.integers(0, np.float32(np.inf).view(np.uint32) + 1, 5000).astype(np.uint32).view(np.float32)
    np.testing.assert_array_equal(depth_order(anywhere), np.argsort(anywhere, kind="stable"))
    assert depth_order(depth[:0]).shape == (0,)


def test_a_quarter_of_the_dilation_shows_twice_the_size_averaged():
    g, c = cloud(60, 11, scale=0.05), camera()
    large = render(g, c.resized(2)).reshape(c.height, 2, c.width, 2, 4).mean(axis=(1, 3))
    near = render(g, c, INRIA.at(0.5))
    assert np.abs(near - large).mean() < 0.25 * np.abs(render(g, c) - large).mean()
