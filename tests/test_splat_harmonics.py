"""Colours that depend on the view, through the splatter: pictures and gradients against the float64 twin."""

from dataclasses import replace

import numpy as np
import pytest

from tests.random_clouds import random_cloud
from tests.splat_twin import render_backward_reference, view_slopes
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.gaussians.frames import rotations, view_colors
from vvgt_cli.gaussians.types import HARMONICS
from vvgt_cli.splat import project, render, render_backward, render_reference
from vvgt_cli.splat.reference import layers
from vvgt_cli.splat.render import own_axes_backward, pair_sums, project_factors, seen_colors, seen_slopes

EYE = (2.0, -1.7, 1.1)
DEGREES = (1, 2, 3)


def camera(width=24, height=20, eye=EYE):
    return look_at(eye, width=width, height=height, fov=40.0)


def cloud(count, degree, seed=0, scale=0.1, size=0.4):
    g = random_cloud(count, seed, scale, 0.4, colors=(-0.2, 1.0))
    return replace(g, harmonics=np.random.default_rng(seed).normal(0, size, (count, HARMONICS[degree], 3)))


@pytest.mark.parametrize("degree", DEGREES)
def test_kernels_are_their_twins_rounded_once(degree):
    g, eye = cloud(500, degree), np.array([0.3, 0.2, -0.4])
    seen = seen_colors(g.means, g.colors, g.harmonics, eye)
    np.testing.assert_allclose(seen, view_colors(g, eye), rtol=1e-6, atol=1e-7)
    loss = np.random.default_rng(1).normal(size=(500, 3)).astype(np.float32)
    loss[:7] = 0
    ours, twin = seen_slopes(g.means, g.harmonics, eye, loss), view_slopes(g, eye, loss.astype(np.float64))
    for a, b in zip(ours, twin, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
        assert not a[:7].any()


@pytest.mark.parametrize("degree", DEGREES)
def test_pictures_match_the_twin(degree):
    g, c = cloud(300, degree, scale=0.05), camera(64, 56)
    picture = render(g, c)
    assert (np.abs(picture - render_reference(g, c)) > 1e-4).mean() < 3e-3
    assert np.abs(picture - render(replace(g, harmonics=None), c)).max() > 0.1


def test_degree_0_and_zeros_are_the_same_bytes():
    g, c = cloud(300, 3), camera(48, 48)
    plain = replace(g, harmonics=None)
    assert seen_colors(plain.means, plain.colors, None, c.position) is plain.colors
    for degree in DEGREES:
        assert render(plain.of_degree(degree), c).tobytes() == render(plain, c).tobytes()
        p = project(plain, c)
        image, grad = render(plain, c, projection=p), np.ones((48, 48, 4), np.float32)
        ours, alone = (render_backward(x, c, p, image, grad) for x in (plain.of_degree(degree), plain))
        for field in plain.arrays():
            np.testing.assert_array_equal(getattr(ours, field), getattr(alone, field))
        assert alone.harmonics is None
        assert np.abs(ours.harmonics).max() > 0


def test_huge_coefficients_stay_finite():
    g = cloud(50, 3)
    for size in (1e20, 3e38):
        huge = replace(g, harmonics=np.sign(g.harmonics) * np.float32(size))
        assert np.isfinite(render(huge, camera())).all()


@pytest.mark.parametrize("block", range(6))
def test_the_twin_agrees_with_central_differences(block):
    fields, checked = ("means", "colors", "harmonics"), 0
    for seed in range(block, 120, 6):
        rng = np.random.default_rng(seed)
        g, c = cloud(6, 1 + seed % 3, seed, scale=0.1), camera(12, 10)
        steps = {f: 2e-4 * rng.normal(size=getattr(g, f).shape) for f in fields}
        near = np.abs(view_colors(g, c.position)) < 0.01  # no derivative at the clamp
        moved = {f: [np.float32(getattr(g, f) + sign * steps[f]) for sign in (-1, 1)] for f in fields}
        low, high = (replace(g, **{f: moved[f][i] for f in fields}) for i in (0, 1))
        drawn = [list(layers(x, c)) for x in (low, g, high)]
        orders = [[k for k, _, _ in one] for one in drawn]
        if not orders[0] == orders[1] == orders[2] or near.any():
            continue
        masks = [np.array([a > 0 for _, a, _ in one]) for one in drawn]
        grad = rng.normal(size=(c.height, c.width, 4))
        grad[(masks[0] != masks[1]).any(axis=0) | (masks[2] != masks[1]).any(axis=0)] = 0
        difference = (grad * (render_reference(high, c) - render_reference(low, c))).sum()
        slopes = render_backward_reference(g, c, grad)
        parts = [slopes[f] * (getattr(high, f).astype(np.float64) - getattr(low, f)) for f in fields]
        assert abs(difference - sum(p.sum() for p in parts)) < 2e-3 * sum(np.abs(p).sum() for p in parts) + 1e-12
        checked += any(p.any() for p in parts)
    assert checked > 8


@pytest.mark.parametrize("degree", DEGREES)
def test_gradients_match_the_twin(degree):
    g, c = cloud(300, degree, scale=0.05), camera(64, 64)
    grad = np.random.default_rng(0).normal(size=(64, 64, 4)).astype(np.float32)
    p = project(g, c)
    ours = render_backward(g, c, p, render(g, c, projection=p), grad)
    twin = render_backward_reference(g, c, grad.astype(np.float64))
    for field in g.arrays():
        a, b = getattr(ours, field).reshape(300, -1), twin[field].reshape(300, -1)
        scale = np.abs(b).max(axis=1) + 1e-2 * np.abs(b).mean()
        assert (np.abs(a - b).max(axis=1) > 2e-3 * scale).mean() <= 0.03, field
    dark = view_colors(g, c.position) < 0
    assert dark.any()
    assert not ours.colors[dark].any()
    assert not ours.harmonics.transpose(0, 2, 1)[dark].any()


def test_own_axes_gradients_match_the_twin():
    g, c = cloud(200, 3), camera(48, 40)
    factors = np.float32(rotations(g.quaternions) * np.exp(g.log_scales.astype(np.float64))[:, None, :])
    grad = np.random.default_rng(0).normal(size=(c.height, c.width, 4)).astype(np.float32)
    p = project_factors(g.means, factors, g.opacity_logits, c)
    seen = seen_colors(g.means, g.colors, g.harmonics, c.position)
    pairs = pair_sums(p, seen, render(g, c, projection=p), grad)
    rows, harmonics = own_axes_backward(g.means, factors, seen, c, p, pairs, g.harmonics)
    twin = render_backward_reference(g, c, grad.astype(np.float64))
    steps = np.einsum("kji,kj->ki", factors, twin["means"])
    for a, b in ((rows[:3].T, steps), (harmonics, twin["harmonics"])):
        a, b = a.reshape(200, -1), b.reshape(200, -1)
        scale = np.abs(b).max(axis=1) + 1e-2 * np.abs(b).mean()
        assert (np.abs(a - b).max(axis=1) > 5e-3 * scale).mean() < 0.05
