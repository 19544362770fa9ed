"""Gradients: the float64 twin against central differences, the kernels against the twin, and the corners of both."""

from dataclasses import replace

import numpy as np
import pytest

from tests.random_clouds import extreme_cloud, random_cloud
from tests.splat_twin import image_gradients, render_backward_reference, space_gradients
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.constants import MAX_ALPHA
from vvgt_cli.gaussians.frames import rotations
from vvgt_cli.gaussians.rules import INRIA, RULES
from vvgt_cli.splat import project, render, render_backward, render_reference
from vvgt_cli.splat.reference import covariances, layers
from vvgt_cli.splat.render import own_axes_backward, pair_sums, project_factors

FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "colors")
EYE = (2.0, -1.7, 1.1)


def camera(width=24, height=20, eye=EYE, fov=40.0):
    return look_at(eye, width=width, height=height, fov=fov)


def cloud(count, seed=0, scale=0.1, spread=0.4, logit=0.0, box=0.6):
    g = random_cloud(count, seed, scale, spread, (logit, 2.0), box, (-0.3, 1.2))
    return replace(g, quaternions=g.quaternions * 10 ** np.random.default_rng(seed).uniform(-2, 2, (count, 1)))


def moved(g, steps, sign):
    return Gaussians(*(np.float32(getattr(g, f) + np.float64(sign) * steps.get(f, 0)) for f in FIELDS))


def drawn(g, c, rule=INRIA):
    """Order, and which pixels of each Gaussian are drawn or clamped: where this changes there is no derivative."""
    found = list(layers(g, c, rule))
    return [k for k, _, _ in found], np.array([(a > 0) + 1 * (a == MAX_ALPHA) for _, a, _ in found])


def direction(rng, g, seed, size=2e-4):
    """Random steps: in one field where the seed says so, else in all; of quaternions relative to their norm."""
    steps = {f: size * rng.normal(size=getattr(g, f).shape) for f in FIELDS}
    steps["quaternions"] *= np.linalg.norm(g.quaternions, axis=1, keepdims=True)
    steps["colors"][np.abs(g.colors) < 0.01] = 0  # no derivative at the clamp
    return steps if seed % 6 == 5 else {FIELDS[seed % 6]: steps[FIELDS[seed % 6]]}


@pytest.mark.parametrize("rule", ["inria", "compensated", "playcanvas"])
@pytest.mark.parametrize("block", range(6))
def test_the_twin_agrees_with_central_differences_in_hundreds_of_scenes(block, rule):
    checked, rule = 0, RULES[rule]
    for seed in range(block, 180, 6):
        rng = np.random.default_rng(seed)
        axes = rng.choice([0.15, 0.3, 1.0])
        eye = np.array(EYE) * rng.choice([0.2, 0.5, 1.0])  # some scenes lie around the eye
        g, c = cloud(6, seed, scale=0.2 * axes, spread=axes, logit=rng.choice([-2.0, 0.0, 3.0])), camera(12, 10, eye)
        steps = direction(rng, g, block)
        low, high = moved(g, steps, -1), moved(g, steps, 1)
        (order, mask), (order_low, mask_low), (order_high, mask_high) = (drawn(x, c, rule) for x in (g, low, high))
        if not order == order_low == order_high:
            continue
        grad = rng.normal(size=(c.height, c.width, 4))
        grad[(mask != mask_low).any(axis=0) | (mask != mask_high).any(axis=0)] = 0
        difference = (grad * (render_reference(high, c, rule) - render_reference(low, c, rule))).sum()
        slopes = render_backward_reference(g, c, grad, rule)
        parts = [slopes[f] * (getattr(high, f).astype(np.float64) - getattr(low, f)) for f in FIELDS]
        assert abs(difference - sum(p.sum() for p in parts)) < 2e-3 * sum(np.abs(p).sum() for p in parts) + 1e-12
        checked += any(p.any() for p in parts)
    assert checked > 20


def assert_matches_twin(g, c, seed=0, tight=2e-3, share=0.01, rule=INRIA):
    """Kernel against twin, relative to a Gaussian's size of gradient; a pixel at a threshold may fall either way."""
    grad = np.random.default_rng(seed).normal(size=(c.height, c.width, 4)).astype(np.float32)
    p = project(g, c, rule)
    ours = render_backward(g, c, p, render(g, c, projection=p), grad)
    twin = render_backward_reference(g, c, grad.astype(np.float64), rule)
    for field in FIELDS:
        a, b = getattr(ours, field).reshape(len(g), -1), twin[field].reshape(len(g), -1)
        assert np.isfinite(a).all(), field
        scale = np.abs(b).max(axis=1) + 1e-2 * np.abs(b).mean() + 1e-12
        wrong = (np.abs(a - b).max(axis=1) > tight * scale).mean()
        assert wrong <= share, f"{field}: {wrong:.3f} of the Gaussians differ"
    return ours, twin


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("size", [(64, 64), (17, 49), (1, 1)])
def test_kernels_match_the_twin(seed, size):
    assert_matches_twin(cloud(300, seed, scale=0.05), camera(*size), seed, share=0.03)


@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize("scale", [0.05, 0.012])
def test_kernels_match_the_twin_by_every_rule(name, scale):
    assert_matches_twin(cloud(300, 5, scale=scale), camera(64, 64), 5, share=0.03, rule=RULES[name])


@pytest.mark.parametrize("name", RULES)
def test_gradients_behind_many_opaque_splats_are_finite(name):
    g = cloud(200, 7, scale=0.3, logit=9.0)  # a transmittance of less than float32 has
    c = camera(48, 48)
    p = project(g, c, RULES[name])
    slopes = render_backward(g, c, p, render(g, c, projection=p), np.ones((48, 48, 4), np.float32))
    assert all(np.isfinite(getattr(slopes, field)).all() for field in FIELDS)


@pytest.mark.parametrize("axes", [(0.8, 1e-3, 1e-3), (0.8, 0.8, 1e-4), (1e-6, 1e-6, 1e-6), (3.0, 3.0, 3.0)])
def test_needles_pancakes_points_and_giants_match_the_twin(axes):
    g = cloud(60, 1)
    g = Gaussians(g.means, np.log(np.tile(axes, (60, 1))), g.quaternions, g.opacity_logits, g.colors)
    assert_matches_twin(g, camera(48, 48), tight=2e-2, share=0.1)  # float32 cancels in the exponent of a long needle


def test_a_gaussian_at_the_near_plane_has_a_finite_gradient():
    c = camera(32, 32)
    depths = np.array([0.0099, 0.0100001, 0.011, 0.02])
    means = (c.rotation.T @ (np.outer([0, 0, 1.0], depths) - c.translation[:, None])).T
    g = Gaussians(means, np.full((4, 3), -6.0), np.ones((4, 4)), np.full(4, -1.0), np.full((4, 3), 0.5))
    ours, _ = assert_matches_twin(g, c, share=0.0)
    assert not ours.means[0].any()
    assert ours.means[1:].any(axis=1).all()


def test_an_alpha_at_its_clamp_moves_colours_only():
    g = Gaussians(np.zeros((1, 3)), np.full((1, 3), 5.0), [[1, 0, 0, 0]], [30.0], [[1, 0.5, -1]])
    ours, _ = assert_matches_twin(g, camera(33, 33), share=0.0)
    assert not any(getattr(ours, field).any() for field in FIELDS[:4])
    assert ours.colors[0, :2].all()
    assert ours.colors[0, 2] == 0  # below its own clamp


@pytest.mark.parametrize("logit", [-3.0, 6.0])
def test_thousands_of_layers_match_the_twin(logit):
    g, c = cloud(3000, 3, scale=0.3, logit=logit, box=0.2), camera(20, 20)
    assert_matches_twin(g, c, tight=2e-2, share=0.05)


def test_a_quaternions_norm_divides_its_gradient():
    g, c = cloud(100, 4), camera()
    factors = 10 ** np.random.default_rng(0).uniform(-4, 4, (100, 1))
    scaled = Gaussians(g.means, g.log_scales, g.quaternions * factors, g.opacity_logits, g.colors)
    (ours, _), (wide, _) = assert_matches_twin(g, c, share=0.03), assert_matches_twin(scaled, c, share=0.03)
    size = np.abs(ours.quaternions).max(axis=1, keepdims=True)
    off = np.abs(wide.quaternions * factors - ours.quaternions) > 2e-3 * size
    assert off.any(axis=1).mean() < 0.05
    along = np.abs(
        (ours.quaternions * g.quaternions / np.linalg.norm(g.quaternions, axis=1, keepdims=True)).sum(axis=1)
    )
    assert (along <= 1e-5 * size[:, 0]).all()


def test_nothing_and_what_is_not_drawn():
    c = camera()
    for g in (cloud(0), cloud(5, logit=-20.0)):
        p = project(g, c)
        out = render_backward(g, c, p, render(g, c, projection=p), np.ones((c.height, c.width, 4), np.float32))
        assert not any(getattr(out, field).any() for field in FIELDS)


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e10])
def test_gradients_of_extreme_gaussians_are_finite_whatever_the_slope(size):
    g, c = extreme_cloud(), camera(48, 48)
    grad = np.random.default_rng(0).normal(size=(48, 48, 4)).astype(np.float32) * np.float32(size)
    p = project(g, c)
    found = render_backward(g, c, p, render(g, c, projection=p), grad)
    behind = (g.means @ c.rotation.T + c.translation)[:, 2] <= 0.01
    assert behind.any()
    for field in FIELDS:
        assert np.isfinite(getattr(found, field)).all()
        assert not getattr(found, field)[behind].any()


def test_colour_gradients_of_a_million_add_up_to_the_alpha_of_the_picture():
    g, c = cloud(1_000_000, 8, scale=0.004), camera(64, 64)
    white = Gaussians(g.means, g.log_scales, g.quaternions, g.opacity_logits, np.ones_like(g.colors))
    p = project(white, c)
    image = render(white, c, projection=p)
    found = render_backward(white, c, p, image, np.ones((64, 64, 4), np.float32))
    assert all(np.isfinite(getattr(found, field)).all() for field in FIELDS)
    assert found.colors.sum(dtype=np.float64) == pytest.approx(3 * image[..., 3].sum(dtype=np.float64), rel=1e-4)


@pytest.mark.parametrize("rule", [RULES["inria"], RULES["compensated"]], ids=lambda rule: rule.name)
@pytest.mark.parametrize("axes", [(0.1, 0.05, 0.02), (0.6, 0.6, 1e-5)])
def test_own_axes_gradients_match_the_twin(axes, rule):
    g, c = cloud(200, 8), camera(48, 40)
    g = Gaussians(g.means, np.log(np.tile(axes, (200, 1))), g.quaternions, g.opacity_logits, g.colors)
    factors = np.float32(rotations(g.quaternions) * np.exp(g.log_scales.astype(np.float64))[:, None, :])
    np.testing.assert_allclose(factors @ factors.transpose(0, 2, 1), covariances(g), atol=1e-7)
    grad = np.random.default_rng(0).normal(size=(c.height, c.width, 4)).astype(np.float32)
    p = project_factors(g.means, factors, g.opacity_logits, c, rule)
    pairs = pair_sums(p, g.colors, render(g, c, projection=p), grad)
    ours, _ = own_axes_backward(g.means, factors, g.colors, c, p, pairs)
    centres, inverses, logits, colors = image_gradients(g, c, grad.astype(np.float64), rule)
    means, spatial = space_gradients(g, c, centres, inverses, rule)
    steps = np.einsum("kji,kj->ki", factors, means)
    entries = 2 * factors.transpose(0, 2, 1) @ spatial @ factors
    pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    twin = [steps, np.stack([entries[:, i, j] * (1 + (i != j)) for i, j in pairs], -1), logits[:, None], colors]
    found = [rows.T for rows in np.split(ours, [3, 9, 10])]
    for a, b in zip(found, twin, strict=True):
        scale = np.abs(b).max(axis=1) + 1e-2 * np.abs(b).mean()
        assert (np.abs(a - b).max(axis=1) > 5e-3 * scale).mean() < 0.05
