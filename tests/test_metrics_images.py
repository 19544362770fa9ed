"""SSIM and FLIP against their definitions, their properties, and other programs where installed."""

import math

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError
from vvgt_cli.images.metrics import CAP, flip, psnr, separable, ssim, visible_difference


def picture(height=70, width=90, seed=0):
    """A smooth picture with edges, in [0, 1]."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width] / 10
    waves = [np.sin(x * rng.uniform(0.3, 2) + y * rng.uniform(0.3, 2) + rng.uniform(0, 6)) for _ in range(3)]
    image = 0.5 + 0.4 * np.stack(waves, axis=-1)
    image[20:40, 30:60] = rng.random(3)
    return np.clip(image, 0, 1)


def noisy(image, sigma, seed=1):
    return np.clip(image + np.random.default_rng(seed).normal(0, sigma, image.shape), 0, 1)


def test_a_difference_is_seen_in_matter_and_by_weight():
    """One pixel in fifty differs by 0.5, those beside matter by more."""
    reference = np.zeros((20, 10, 4), np.float32)
    reference[:10] = 0.5, 0.5, 0.5, 1
    ours = reference.copy()
    ours[:10:5, ::10, 1] = 0.0
    ours[10:, :, :3] = 1.0
    assert visible_difference([reference], [ours]) == 0.5
    ours[0, 0] = reference[0, 0]
    assert visible_difference([reference], [ours]) < 0.01
    ours[10:, :, 3] = 0.5  # matter where there is none
    assert visible_difference([reference], [ours]) == 1.0
    weights = np.ones((20, 10), np.float32)
    weights[10:] = 0.4
    assert visible_difference([reference], [ours], [weights]) < 0.01
    assert visible_difference([reference[10:]], [np.full((10, 10, 4), 7.0)]) == 1.0  # beyond what a screen shows
    assert visible_difference([0 * reference], [0 * reference]) == 0.0


@pytest.mark.parametrize("shape", [(21, 21), (64, 65), (130, 40), (200, 129)])
def test_separable_filter_is_the_two_dimensional_correlation(shape):
    rng = np.random.default_rng(0)
    image, kx, ky = rng.random(shape), rng.random(5), rng.random(8)
    expected = np.einsum("hwij,i,j->hw", np.lib.stride_tricks.sliding_window_view(image, (8, 5)), ky, kx)
    np.testing.assert_allclose(separable(image, kx, ky), expected, rtol=1e-12)


def test_psnr_of_known_errors():
    image = np.full((4, 5, 3), 0.5)
    assert psnr(image, image + 0.1) == pytest.approx(20)
    assert psnr(image, image) == CAP
    assert psnr(np.full((2, 2), 1.0), np.full((2, 2), 7.0)) == CAP  # clipped
    mask = np.zeros((4, 5), bool)
    mask[0, 0] = True
    worse = image.copy()
    worse[0, 0] += 0.01
    assert psnr(image, worse, mask) == pytest.approx(40)
    refused(DataError, "no pixels", psnr, image, worse, mask & False)
    refused(DataError, "same shape", psnr, image, image[:1])


def test_ssim_is_the_formula_in_float64():
    a, b = picture(), noisy(picture(), 0.05)
    g = np.exp(-(np.arange(-5, 6) ** 2) / 4.5)
    weight = np.outer(g, g) / g.sum() ** 2
    values = []
    for c in range(3):
        wa, wb = (np.lib.stride_tricks.sliding_window_view(i[..., c], (11, 11)) for i in (a, b))
        ma, mb = ((w * weight).sum((-1, -2)) for w in (wa, wb))
        va, vb = (((w - m[..., None, None]) ** 2 * weight).sum((-1, -2)) for w, m in ((wa, ma), (wb, mb)))
        cov = ((wa - ma[..., None, None]) * (wb - mb[..., None, None]) * weight).sum((-1, -2))
        values.append((2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    assert ssim(a, b) == pytest.approx(np.mean(values), abs=1e-6)


def test_ssim_properties():
    a = picture()
    assert ssim(a, a) == pytest.approx(1, abs=1e-6)
    assert ssim(a, noisy(a, 0.02)) > ssim(a, noisy(a, 0.1)) > ssim(a, 1 - a)
    refused(DataError, "at least 11", ssim, a[:10], a[:10])
    refused(DataError, "same", ssim, a, a[:, 1:])


def test_ssim_is_scikit_image():
    skimage = pytest.importorskip("skimage.metrics")
    a, b = picture(), noisy(picture(), 0.05)
    expected = skimage.structural_similarity(
        a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=2
    )
    assert ssim(a, b) == pytest.approx(expected, abs=1e-6)


def test_flip_is_the_reference_program():
    evaluator = pytest.importorskip("flip_evaluator")
    for a, b in (
        (picture(), noisy(picture(), 0.05)),
        (picture(), np.roll(picture(), 1, axis=0)),
        (picture(), picture(seed=5)),
    ):
        _, mean, _ = evaluator.evaluate(a.astype(np.float32), b.astype(np.float32), "LDR", applyMagma=False)
        assert flip(a, b) == pytest.approx(mean, abs=1e-5)


# means by the authors' program (flip-evaluator 1.7) for pictures that anyone can make
FLIP_OF_CONSTANTS = {
    ((0, 0, 0), (1, 1, 1)): 0.967399,
    ((0, 1, 0), (0, 0, 1)): 1.000000,
    ((0.5, 0.5, 0.5), (0.55, 0.5, 0.5)): 0.149689,
}


@pytest.mark.parametrize(("colors", "expected"), FLIP_OF_CONSTANTS.items())
def test_flip_of_constant_images(colors, expected):
    a, b = (np.broadcast_to(np.array(c, dtype=np.float64), (40, 40, 3)) for c in colors)
    assert flip(a, b) == pytest.approx(expected, abs=5e-5)  # float32, and a square root at 0


def test_flip_of_an_edge_and_of_points():
    a = np.zeros((48, 48, 3))
    a[:, 24:] = 1
    assert flip(a, np.roll(a, 1, axis=1)) == pytest.approx(0.146061, abs=5e-5)  # float32, and a square root at 0
    dots = np.zeros((48, 48, 3))
    dots[8::16, 8::16] = 1
    assert flip(np.zeros_like(dots), dots) == pytest.approx(0.055895, abs=5e-5)  # float32, and a square root at 0


def test_flip_properties():
    a = picture()
    assert flip(a, a) == 0
    assert 0 < flip(a, noisy(a, 0.01)) < flip(a, noisy(a, 0.1)) < 1
    assert flip(a, noisy(a, 0.1)) == pytest.approx(flip(noisy(a, 0.1), a), abs=1e-6)
    assert flip(a, 5 * a - 2) == pytest.approx(flip(a, np.clip(5 * a - 2, 0, 1)))  # clipped
    assert flip(a, noisy(a, 0.1), 20) != pytest.approx(flip(a, noisy(a, 0.1)), abs=1e-3)
    assert math.isfinite(flip(a[:1, :1], 1 - a[:1, :1]))  # smaller than any kernel
    refused(DataError, r"same \(h, w, 3\)", flip, a, a[..., :2])
