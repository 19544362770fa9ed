"""Gradients of the loss: against central differences, and SSIM's value against a plain float64 twin."""

from dataclasses import replace

import numpy as np
import pytest

from vvgt_cli.cameras import default_views
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.images.metrics import C1, C2, ssim
from vvgt_cli.refine import OptimizeOptions
from vvgt_cli.refine.loop import begin
from vvgt_cli.refine.loss import KERNEL, SMOOTH, add_ssim_gradient, add_texture_gradient, loss_gradient
from vvgt_cli.refine.options import TEXTURE


def pictures(height=31, width=26, seed=0):
    rng = np.random.default_rng(seed)
    image = np.clip(0.5 + np.cumsum(rng.normal(0, 0.1, (height, width, 4)), axis=1), 0, 1)
    return image, np.clip(image + rng.normal(0, 0.2, image.shape), 0, 1)


def blurred(plane):
    """Separable correlation in float64 with zeros beyond the border."""
    kernel = KERNEL.astype(np.float64)
    for axis in (0, 1):
        plane = np.apply_along_axis(lambda line: np.convolve(line, kernel)[5:-5], axis, plane)
    return plane


def ssim_twin(image, target):
    """Sum over pixels and RGB of SSIM (Wang et al. 2004), each window weighted with zeros outside, float64."""
    total = 0.0
    for c in range(3):
        x, y = image[..., c], target[..., c]
        m, n = blurred(x), blurred(y)
        s, t, both = blurred(x * x) - m * m, blurred(y * y) - n * n, blurred(x * y) - m * n
        total += ((2 * m * n + C1) * (2 * both + C2) / ((m * m + n * n + C1) * (s + t + C2))).sum()
    return total


def test_the_kernels_ssim_is_the_twins_and_inside_the_border_the_metrics():
    x, y = pictures()
    got = add_ssim_gradient(np.float32(x), np.float32(y), 1.0, np.zeros(x.shape, np.float32))
    assert abs(got - ssim_twin(x, y) / (3 * x[..., 0].size)) < 1e-4
    wide = np.zeros((80, 80, 4)), np.zeros((80, 80, 4))
    for full, part in zip(wide, (x, y), strict=True):
        full[20 : 20 + x.shape[0], 20 : 20 + x.shape[1]] = part
    whole = add_ssim_gradient(*(np.float32(w) for w in wide), 1.0, np.zeros((80, 80, 4), np.float32))
    inside = (1 - ssim(*(w[..., :3] for w in wide))) * 70 * 70  # beyond 5 pixels from the border both are blank
    assert abs((1 - whole) * 80 * 80 - inside) < 1e-3 * inside


def texture_twin(image, target):
    """Sum over pixels and RGB of the error less its blur, squared, by how smooth the target is; float64."""
    channels = range(3)
    variance = sum(np.maximum(blurred(target[..., c] ** 2) - blurred(target[..., c]) ** 2, 0) for c in channels) / 3
    errors = [image[..., c] - target[..., c] for c in channels]
    return sum(((e - blurred(e)) ** 2 * SMOOTH / (SMOOTH + variance)).sum() for e in errors)


@pytest.mark.parametrize("size", [(31, 26), (7, 5), (1, 1)])
@pytest.mark.parametrize("term", ["ssim", "texture"])
def test_gradients_of_terms_over_windows_are_the_twins_slopes(term, size):
    x, y = (p.astype(np.float32) for p in pictures(*size))
    add, twin, sign = (add_ssim_gradient, ssim_twin, -1) if term == "ssim" else (add_texture_gradient, texture_twin, 1)
    grad, exact = np.full(x.shape, 2.0, np.float32), y.astype(float)
    value = add(x, y, 0.7, grad)
    if term == "texture":
        assert value == pytest.approx(texture_twin(x.astype(float), exact), 1e-4)
    assert (grad[..., 3] == 2).all()  # added to, and alpha untouched
    rng = np.random.default_rng(1)
    for _ in range(10):
        d = rng.normal(size=x.shape) * 1e-4
        slope = sign * 0.7 * (twin(x + d, exact) - twin(x - d, exact)) / 2
        found = (grad - 2)[..., :3] * d[..., :3]
        assert abs(found.sum() - slope) < 2e-3 * np.abs(found).sum()


def test_the_texture_term_spares_edges_and_what_is_off_as_a_whole():
    flat = np.full((40, 40, 4), 0.5, np.float32)
    edge = flat.copy()
    edge[:, 20:, :3] = 1.0
    rough = flat + np.float32(0.02) * (-1) ** np.arange(40, dtype=np.float32)[:, None]

    def term(image, target, part):
        grad = np.zeros(image.shape, np.float32)
        add_texture_gradient(image, target, 1.0, grad)
        return np.abs(grad[12:28, part]).max()

    middle, near = slice(12, 28), slice(18, 22)
    assert term(rough, flat, middle) == pytest.approx(2 * 0.02, rel=0.02)  # all of it is texture
    assert term(flat + np.float32(0.02), flat, middle) < 0.02 * 2e-3
    assert term(edge + (rough - flat), edge, near) < 0.2 * 2 * 0.02


def test_pixel_losses_by_hand():
    image, target = np.zeros((1, 2, 4), np.float32), np.zeros((1, 2, 4), np.float32)
    image[0, 0] = 0.5, 0.0, 0.25, 0.5
    target[0, 1, 1] = 1.0
    grad = np.empty_like(image)
    squares = np.empty(1)
    loss_gradient(image, target, np.float32(1), np.float32(2), np.float32(0.5), grad, squares)
    assert squares[0] == pytest.approx(0.25 + 0.0625 + 1.0 + 0.5 * 0.25)
    np.testing.assert_allclose(grad[0], [[3, 0, 2, 1.5], [0, -5, 0, 0]])


def test_steps_of_our_method_follow_the_texture_term():
    rng = np.random.default_rng(0)
    colors = rng.random((40, 3))
    start = Gaussians(
        rng.uniform(-0.4, 0.4, (40, 3)), np.full((40, 3), -2.5), np.eye(1, 4).repeat(40, 0), np.ones(40), colors
    )
    camera = default_views("train", 1, size=40)[0]
    target = np.full((40, 40, 4), 0.5, np.float32)
    usual = OptimizeOptions.of("axes", steps=4)
    assert usual.texture == TEXTURE > 0
    assert OptimizeOptions.of("adam", steps=4).texture == OptimizeOptions.of("3dgs", steps=4).texture == 0
    ends = []
    for options in (usual, replace(usual, texture=0.0)):
        state = begin(start, [camera], options)
        for _ in range(4):
            state.step(camera, target, 0.0, 1.0)
        ends.append(state.gaussians().colors)
    assert np.abs(ends[0] - ends[1]).max() > 1e-4
