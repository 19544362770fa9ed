"""Slopes of the image error in each Gaussian's own frame: against differences, and what each column says."""

import numpy as np
import pytest
from network_models import scene

from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.frames import rotations
from vvgt_cli.network.config import SLOPES
from vvgt_cli.network.prepare import STEP, pack, slope_rows, unpack
from vvgt_cli.splat import project, render, render_reference
from vvgt_cli.splat.render import pair_sums, step_slopes


def stepped(g, step):
    """Gaussians after a step (K, 13) in their own frames."""
    axes, scales = rotations(g.quaternions), np.exp(g.log_scales.astype(np.float64))
    w, x, y, z = g.quaternions.T.astype(np.float64)
    a, b, c = step[:, 6:9].T / 2
    turn = [-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a]
    return Gaussians(
        g.means + np.einsum("kij,kj->ki", axes, scales * step[:, :3]),
        g.log_scales + step[:, 3:6],
        g.quaternions + np.stack(turn, axis=1),
        g.opacity_logits + step[:, 9],
        g.colors + step[:, 10:],
    )


@pytest.mark.parametrize("columns", [(0, 3), (3, 6), (6, 9), (9, 10), (10, 13)])
def test_gradients_in_the_own_frame_against_differences(columns):
    gaussians, cameras, _ = scene(count=12, views=1, seed=4)
    gaussians = unpack(pack(gaussians))
    slope, projection = np.random.default_rng(0).normal(size=(32, 32, 4)), project(gaussians, cameras[0])
    pairs = pair_sums(projection, gaussians.colors, render(gaussians, cameras[0]), slope)
    found = step_slopes(gaussians, cameras[0], projection, pairs, gaussians.colors)
    assert found.shape == (12, STEP)
    step = np.zeros((12, STEP))
    step[:, slice(*columns)] = np.random.default_rng(1).normal(size=(12, columns[1] - columns[0]))
    loss = lambda e: (render_reference(stepped(gaussians, e * step), cameras[0]) * slope).sum()  # noqa: E731
    difference = (loss(2e-3) - loss(-2e-3)) / 4e-3
    # the jump of the cut at 1/255 is left out of gradients, and is part of the difference
    assert (found * step).sum() == pytest.approx(difference, rel=0.12)


def test_columns_say_direction_agreement_and_size():
    gaussians, cameras, _ = scene(count=50, views=4)
    gaussians = unpack(pack(gaussians))
    brighter = np.stack([render(gaussians, camera) for camera in cameras]) * np.float32(1.5)
    rows = slope_rows(gaussians, cameras, brighter)
    assert rows.shape == (50, SLOPES)
    assert rows.dtype == np.float32
    assert np.isfinite(rows).all()
    assert (rows[:, 10:13] <= 0).all()  # more colour lowers the error everywhere
    assert np.median(rows[:, 10:13]) < -0.8  # and all views agree
    same = slope_rows(gaussians, cameras, np.stack([render(gaussians, camera) for camera in cameras]))
    assert (same[:, 20] < rows[:, 20] - 1).all()  # the scene's error
    shown = slope_rows(gaussians, cameras[:1], brighter[:1])
    seen = np.abs(shown[:, 10]) > 0
    assert np.allclose(np.abs(shown[seen, 10]), 1, atol=1e-3)  # one view always agrees with itself


def test_what_no_view_shows_has_neither_slope_nor_error():
    gaussians, cameras, images = scene(count=20, views=4)
    gaussians = unpack(pack(gaussians))
    gaussians.means[7] = (0, 0, 90)
    row = slope_rows(gaussians, cameras, images)[7]
    assert not row[:13].any()
    np.testing.assert_allclose(row[13:18], np.log(1e-4), rtol=1e-6)
    np.testing.assert_allclose(row[18:20], [np.log(0.01), 0], atol=1e-6)
