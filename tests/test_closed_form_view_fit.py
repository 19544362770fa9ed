"""Colours and harmonics solved from views together: known ones come back, and what views do not tell stays put."""

from dataclasses import replace

import numpy as np
import pytest

from tests.test_gaussians_harmonics import cloud
from vvgt_cli.cameras import default_views
from vvgt_cli.closed_form import fit
from vvgt_cli.closed_form import fit as fit_module
from vvgt_cli.closed_form.fit import BRIGHTEST, solve_colors
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.frames import basis, directions
from vvgt_cli.images.metrics import psnr
from vvgt_cli.splat import project, render

CAMERAS, TEST = default_views("train", 24, size=40), default_views("test", size=40)


def shiny(count: int = 60, degree: int = 2, seed: int = 0) -> Gaussians:
    """Light enough that no colour is below 0, so that pictures are linear in colours and harmonics."""
    return replace(cloud(count, degree, seed, 0.1), colors=np.random.default_rng(seed).uniform(0.4, 0.7, (count, 3)))


def pictures(gaussians: Gaussians, cameras=CAMERAS) -> np.ndarray:
    return np.stack([render(gaussians, camera) for camera in cameras])


def mean_psnr(gaussians: Gaussians, truth: Gaussians) -> float:
    return float(np.mean([psnr(render(truth, c)[..., :3], render(gaussians, c)[..., :3]) for c in TEST]))


@pytest.fixture
def all_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit_module, "ENOUGH", 0.0)


@pytest.mark.usefixtures("all_rounds")
@pytest.mark.parametrize("degree", [1, 2])
def test_twin_of_the_normal_equations(degree, monkeypatch):
    """Enough rounds end at the dense solution, with the priors of each unknown."""
    truth = shiny(12, degree)
    start = replace(truth, colors=np.full((12, 3), 0.5)).of_degree(0).of_degree(degree)
    views = pictures(truth)
    terms = 1 + truth.harmonics.shape[1]
    rows, weights = [], np.zeros(12)
    for camera in CAMERAS:
        columns, system = np.empty((40 * 40, 12)), fit.System(truth, [project(truth, camera)])
        for k in range(12):
            columns[:, k] = system.forward(0, np.eye(12)[:, [k] * 3], (40, 40))[..., 0].reshape(-1)
        b = np.concatenate([np.ones((12, 1)), basis(directions(truth.means, camera.position)[0], degree)], axis=1)
        rows.append((columns[:, :, None] * b).reshape(1600, -1))
        weights += columns.sum(axis=0)
    a = np.concatenate(rows)
    prior = np.full((12, terms), fit_module.PRIOR)
    prior[:, 1:] = (fit.PIXELS + fit.SHARE * weights)[:, None]
    x0 = np.zeros((12, terms, 3))
    x0[:, 0] = 0.5
    right = a.T @ views[..., :3].reshape(-1, 3).astype(np.float64) + prior.reshape(-1, 1) * x0.reshape(-1, 3)
    expected = np.linalg.solve(a.T @ a + np.diag(prior.reshape(-1)), right).reshape(12, terms, 3)
    solved = solve_colors(start, CAMERAS, views, rounds=60)
    np.testing.assert_allclose(solved.colors, expected[:, 0], atol=3e-4)
    np.testing.assert_allclose(solved.harmonics, expected[:, 1:], atol=1e-3)


def test_adjoint():
    g = shiny(50, 3)
    system = fit.ViewDependentSystem(g, [project(g, c) for c in CAMERAS], [c.position for c in CAMERAS])
    rng = np.random.default_rng(0)
    unknowns = rng.standard_normal((50, 16, 3))
    images = [rng.standard_normal((40, 40, 3)).astype(np.float32) for _ in CAMERAS]
    left = sum((system.forward(i, unknowns, (40, 40)) * y).sum(dtype=np.float64) for i, y in enumerate(images))
    assert left == pytest.approx(float((system.back(images) * unknowns).sum()), rel=1e-4)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_known_harmonics_come_back_and_degree_0_is_far_behind(degree):
    truth = shiny(60, degree)
    start, views = replace(truth, colors=np.full((60, 3), 0.5), harmonics=None), pictures(truth)
    plain = solve_colors(start, CAMERAS, views, rounds=20)
    assert plain.harmonics is None
    solved = solve_colors(start.of_degree(degree), CAMERAS, views, rounds=20)
    assert solved.degree == degree
    assert mean_psnr(solved, truth) > mean_psnr(plain, truth) + 8
    for field in ("means", "log_scales", "quaternions", "opacity_logits"):
        np.testing.assert_array_equal(getattr(solved, field), getattr(truth, field))


def test_what_views_do_not_tell_stays_as_it_was():
    truth = shiny(30, 2)
    truth = replace(truth, opacity_logits=np.where(np.arange(30) < 3, -9, truth.opacity_logits))  # not drawn
    views = pictures(truth)
    np.testing.assert_allclose(solve_colors(truth, CAMERAS, views).harmonics, truth.harmonics, atol=1e-5)
    start = replace(truth, colors=np.full((30, 3), 0.33), harmonics=truth.harmonics + np.float32(0.2))
    solved = solve_colors(start, CAMERAS, views)
    np.testing.assert_allclose(solved.harmonics[:3], start.harmonics[:3], atol=1e-6)
    np.testing.assert_allclose(solved.colors[:3], 0.33, atol=1e-6)


def test_colours_and_harmonics_stay_in_range():
    truth = shiny(30, 2)
    wild = pictures(truth) * np.random.default_rng(0).uniform(0, 40, (24, 1, 1, 1)).astype(np.float32)
    solved = solve_colors(truth, CAMERAS, wild, rounds=8)
    assert 0 <= solved.colors.min() <= solved.colors.max() <= BRIGHTEST
    most = np.linalg.norm(solved.harmonics, axis=1) * np.sqrt(8 / (4 * np.pi))
    assert most.max() <= BRIGHTEST * (1 + 1e-6)
