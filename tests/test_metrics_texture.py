"""Texture on smooth areas: made pictures of which the answer is known."""

import numpy as np
import pytest

from vvgt_cli.errors import DataError
from vvgt_cli.images.metrics import BLOCK, COARSE, FINE, band, texture

SIZE = 160
X = np.arange(SIZE, dtype=np.float64)


def picture(levels, alpha=1.0):
    """(SIZE, SIZE, 4) of grey ``levels`` of 255, broadcast."""
    image = np.empty((SIZE, SIZE, 4))
    image[..., :3] = (np.broadcast_to(levels, (SIZE, SIZE)) / 255)[..., None]
    image[..., 3] = alpha
    return image.astype(np.float32)


FLAT = picture(100.0)


def passed(wavelength):
    """Part of a wave's amplitude that lies in the band."""
    return sum(sign * np.exp(-2 * (np.pi * sigma / wavelength) ** 2) for sign, sigma in ((1, FINE), (-1, COARSE)))


@pytest.mark.parametrize("wavelength", [3, 6, 8, 16, 32])  # of which blocks hold whole ones, or nearly
def test_a_wave_on_a_flat_field_is_its_amplitude_over_root_two(wavelength):
    wave = 100 + np.cos(2 * np.pi * X / wavelength)
    found = texture([(FLAT, picture(wave))])
    assert found.ours == pytest.approx(passed(wavelength) / np.sqrt(2), abs=0.04)  # borders
    assert found.reference == pytest.approx(0, abs=1e-4)
    assert found.blocks == (SIZE // BLOCK) ** 2
    assert found.ours_worst >= found.ours


def test_a_lattice_of_gaussians_ripples_as_in_the_formula():
    """2 exp(-2 pi^2 (s / a)^2) of the mean, along one axis."""
    edge, mean = 12.0, 100.0
    for wide, ripple in ((0.4, 0.0850), (0.5, 0.01439), (0.6, 0.00164)):
        row = sum(np.exp(-0.5 * ((X - c) / (wide * edge)) ** 2) for c in np.arange(-5 * edge, SIZE + 5 * edge, edge))
        row *= mean * edge / (wide * edge * np.sqrt(2 * np.pi))
        assert 2 * np.exp(-2 * np.pi**2 * wide**2) == pytest.approx(ripple, rel=0.01)
        found = texture([(FLAT, picture(row))])
        assert found.ours == pytest.approx(mean * ripple * passed(edge) / np.sqrt(2), rel=0.05, abs=0.002)


def test_an_edge_is_no_smooth_area_and_fog_no_opaque_one():
    edge = picture(np.where(X < 2 * BLOCK, 40.0, 200.0))  # between the second column of blocks and the third
    found = texture([(edge, picture(100 + np.cos(X)))])
    assert found.blocks == 3 * (SIZE // BLOCK)
    assert found.reference < 1
    assert texture([(picture(100.0, alpha=0.9), FLAT)]).blocks == 0
    hole = FLAT.copy()
    hole[40, 40, 3] = 0.5
    assert texture([(hole, FLAT)]).blocks == (SIZE // BLOCK) ** 2 - 1


def test_means_are_over_the_blocks_of_all_views_and_the_worst_tenth_is_each_picture_s_own():
    quiet, loud = picture(100 + 0.1 * np.cos(2 * np.pi * X / 8)), picture(100 + np.cos(2 * np.pi * X / 8))
    one, other = texture([(FLAT, quiet)]), texture([(FLAT, loud)])
    both = texture([(FLAT, quiet), (FLAT, loud)])
    assert both.blocks == 2 * one.blocks
    assert both.ours == pytest.approx((one.ours + other.ours) / 2)
    assert both.ours_worst == pytest.approx(other.ours_worst, rel=0.02)
    assert texture([(quiet, FLAT)]).reference_worst == pytest.approx(one.ours_worst)


def test_what_no_screen_shows_is_no_texture():
    white = picture(255.0)
    beyond = picture(300 + 20 * np.cos(2 * np.pi * X / 8))
    assert texture([(white, beyond)]).ours == pytest.approx(0, abs=1e-3)


def test_colours_count_each_and_what_is_smaller_than_a_block_has_no_texture():
    red = FLAT.copy()
    red[..., 0] = picture(100 + np.cos(2 * np.pi * X / 8))[..., 0]
    grey = texture([(FLAT, picture(100 + np.cos(2 * np.pi * X / 8)))])
    assert texture([(FLAT, red)]).ours == pytest.approx(grey.ours / np.sqrt(3), rel=1e-3)
    small = FLAT[: BLOCK - 1, : BLOCK - 1]
    assert texture([(small, small)]) == texture([])
    assert texture([]).ours is None
    assert np.abs(band(FLAT)).max() < 1e-3  # edges are continued
    with pytest.raises(DataError, match="expected the same"):
        texture([(FLAT, FLAT[:-1])])
