"""Colours by least squares, and where the image error is."""

import numpy as np
import pytest

from vvgt_cli.cameras import default_views
from vvgt_cli.closed_form import fit as fit_module
from vvgt_cli.closed_form.fit import BRIGHTEST, PRIOR, blending_weights, solve_colors, weights_and_errors
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.splat import blend, project, render

CAMERAS = default_views("train", 4, size=40)


def cloud(count: int, seed: int = 0, extent: float = 0.6) -> Gaussians:
    """Random ellipsoids of 1 to 4 px, colours in [0.2, 0.8]."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-extent, extent, (count, 3)),
        np.log(rng.uniform(0.05, 0.2, (count, 3))),
        rng.standard_normal((count, 4)),
        rng.uniform(-2, 2, count),
        rng.uniform(0.2, 0.8, (count, 3)),
    )


def with_colors(gaussians: Gaussians, colors) -> Gaussians:
    colors = np.broadcast_to(np.asarray(colors, np.float32), gaussians.colors.shape)
    return Gaussians(gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.opacity_logits, colors)


def pictures(gaussians: Gaussians) -> np.ndarray:
    return np.stack([render(gaussians, camera) for camera in CAMERAS])


def design(gaussians: Gaussians) -> np.ndarray:
    """Blending weights (pixels of all views, K), float64: column k is the picture with colour 1 for k alone."""
    count = len(gaussians)
    projections = [project(gaussians, camera) for camera in CAMERAS]
    columns = np.empty((len(CAMERAS), 40 * 40, count))
    for first in range(0, count, 3):  # three a picture: one a channel
        colors = np.zeros((count, 3), np.float32)
        for channel in range(min(3, count - first)):
            colors[first + channel, channel] = 1
        for view, projection in enumerate(projections):
            image = blend(projection, colors, 40, 40).reshape(-1, 4)
            columns[view, :, first : first + 3] = image[:, : min(3, count - first)]
    return columns.reshape(-1, count)


def objective(gaussians: Gaussians, start: Gaussians, views: np.ndarray) -> np.ndarray:
    residual = sum(
        ((render(gaussians, c).astype(np.float64) - v)[..., :3] ** 2).sum(axis=(0, 1))
        for c, v in zip(CAMERAS, views, strict=True)
    )
    return residual + PRIOR * ((gaussians.colors.astype(np.float64) - start.colors) ** 2).sum(axis=0)


@pytest.fixture
def all_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit_module, "ENOUGH", 0.0)


@pytest.mark.usefixtures("all_rounds")
def test_twin_of_the_normal_equations() -> None:
    """Enough rounds end at the dense solution of (A'A + PRIOR) c = A' v + PRIOR c0."""
    truth = cloud(24)
    start = with_colors(truth, 0.5)
    views = pictures(truth)
    a = design(truth)
    right = a.T @ views[..., :3].reshape(-1, 3).astype(np.float64) + PRIOR * 0.5
    expected = np.linalg.solve(a.T @ a + PRIOR * np.eye(24), right)
    np.testing.assert_allclose(solve_colors(start, CAMERAS, views, rounds=30).colors, expected, atol=2e-4)


@pytest.mark.usefixtures("all_rounds")
def test_known_colours_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit_module, "PRIOR", 1e-4)
    truth = cloud(24)
    views = pictures(truth)
    solved = solve_colors(with_colors(truth, 0.5), CAMERAS, views, rounds=40)
    assert np.linalg.matrix_rank(design(truth)) == 24
    np.testing.assert_allclose(solved.colors, truth.colors, atol=1e-3)
    np.testing.assert_allclose(pictures(solved), views, atol=1e-4)
    for field in ("means", "log_scales", "quaternions", "opacity_logits"):
        np.testing.assert_array_equal(getattr(solved, field), getattr(truth, field))


@pytest.mark.usefixtures("all_rounds")
def test_every_round_lowers_the_objective() -> None:
    truth = cloud(300, seed=3)
    start, views = with_colors(truth, 0.5), pictures(truth)
    values = [objective(start, start, views)]
    for rounds in range(1, 8):
        values.append(objective(solve_colors(start, CAMERAS, views, rounds=rounds), start, views))
    assert (np.diff(values, axis=0) < 0).all()
    assert (values[-1] < 0.2 * values[0]).all()


def test_adjoint() -> None:
    """<forward c, y> = <c, back y>."""
    gaussians = cloud(100, seed=1)
    system = fit_module.System(gaussians, [project(gaussians, camera) for camera in CAMERAS])
    rng = np.random.default_rng(0)
    colors = rng.standard_normal((100, 3)).astype(np.float32)
    images = [rng.standard_normal((40, 40, 3)).astype(np.float32) for _ in CAMERAS]
    left = sum((system.forward(i, colors, (40, 40)) * y).sum(dtype=np.float64) for i, y in enumerate(images))
    back = system.back(images)
    assert left == pytest.approx(float((back * colors).sum()), rel=1e-4)


def test_unseen_keep_their_colours() -> None:
    truth = cloud(20)
    means = truth.means.copy()
    means[:3] = [[0, 0, 50], [0, 90, 0], [-70, 0, 0]]
    logits = truth.opacity_logits.copy()
    logits[3] = -9  # below 1/255: never drawn
    truth = Gaussians(means, truth.log_scales, truth.quaternions, logits, truth.colors)
    unseen = design(truth).max(axis=0) == 0
    assert 2 <= unseen.sum() <= 4
    solved = solve_colors(with_colors(truth, 0.33), CAMERAS, pictures(truth))
    np.testing.assert_array_equal(solved.colors[unseen], np.float32(0.33))
    assert (np.abs(solved.colors[~unseen] - 0.33).max(axis=1) > 1e-3).all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_gaussians(count: int) -> None:
    truth = cloud(count)
    start, views = with_colors(truth, 0.1), pictures(truth)
    solved = solve_colors(start, CAMERAS, views, rounds=5)
    assert len(solved) == count
    assert np.isfinite(solved.colors).all()
    if count:
        assert (objective(solved, start, views) < 0.5 * objective(start, start, views)).all()
    assert weights_and_errors(solved, CAMERAS, views)[1].shape == (count,)


def test_colours_stay_in_range() -> None:
    truth = cloud(30)
    views = pictures(with_colors(truth, 9.0))
    assert solve_colors(truth, CAMERAS, views, rounds=8).colors.max() == BRIGHTEST
    assert solve_colors(truth, CAMERAS, -views, rounds=8).colors.min() == 0


def test_rounds_end_where_they_gain_little() -> None:
    truth = cloud(24)
    seen: list[tuple[int, int]] = []
    solve_colors(truth, CAMERAS, pictures(truth), 9, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(9, 9)]  # nothing to gain: one round


@pytest.mark.usefixtures("all_rounds")
def test_views_that_count_at_twice_the_size_draw_the_colours_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every view counted so: the solution for the smaller dilation."""
    monkeypatch.setattr(fit_module, "PRIOR", 1e-4)
    truth = cloud(24)
    views = np.stack([blend(project(truth, c, INRIA.at(0.5)), truth.colors, 40, 40) for c in CAMERAS])
    near = solve_colors(with_colors(truth, 0.5), CAMERAS, views, 30, twice_every=1)
    far = solve_colors(with_colors(truth, 0.5), CAMERAS, views, 30)
    assert np.abs(near.colors - truth.colors).mean() < 0.5 * np.abs(far.colors - truth.colors).mean()


def test_image_errors() -> None:
    truth = cloud(60, seed=5)
    views = pictures(truth)
    assert weights_and_errors(truth, CAMERAS, views)[1].max() == 0
    wrong = truth.colors.copy()
    wrong[17] += 0.2
    wrong = with_colors(truth, wrong)
    weights, errors = weights_and_errors(wrong, CAMERAS, views)
    assert errors.min() >= 0
    a = design(truth)
    expected = a.T @ (0.6 * a[:, 17])  # weight x error: three channels that are 0.2 a[:, 17] off
    np.testing.assert_allclose(errors, expected, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(weights, a.sum(axis=0), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(blending_weights(wrong, CAMERAS), weights, rtol=1e-12)
