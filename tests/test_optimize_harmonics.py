"""Descent on harmonics: it finds a view-dependent colour that degree 0 cannot show, and loses none on the way."""

from dataclasses import replace

import numpy as np
import pytest

import vvgt_cli as vvgt
from tests.test_gaussians_harmonics import cloud
from vvgt_cli import closed_form
from vvgt_cli.cameras import default_views
from vvgt_cli.conversion.plan import Planner
from vvgt_cli.conversion.stages.refinement import HARMONICS, step_seconds
from vvgt_cli.field.workload import Workload
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.images.metrics import psnr
from vvgt_cli.refine import METHODS, OptimizeOptions, OptimizeRecord, optimize
from vvgt_cli.refine.checkpoint import Checks, fingerprint, resume, save
from vvgt_cli.refine.loop import begin
from vvgt_cli.refine.states import KNOWN_HARMONICS_RATE, SLOPE, Densified, densify
from vvgt_cli.splat import render

CAMERAS, CHECKS = default_views("train", 24, size=40), default_views("check", 2, size=40)
TEST = default_views("test", size=40)


def shiny(count: int = 60, degree: int = 2, seed: int = 0) -> Gaussians:
    return replace(cloud(count, degree, seed, 0.25), colors=np.random.default_rng(seed).uniform(0.3, 0.7, (count, 3)))


def views(g: Gaussians, cameras) -> np.ndarray:
    return np.stack([render(g, camera) for camera in cameras])


def score(g: Gaussians, truth: Gaussians) -> float:
    return float(np.mean([psnr(render(truth, c)[..., :3], render(g, c)[..., :3]) for c in TEST]))


@pytest.mark.parametrize(("method", "steps", "gain"), [("axes", 96, 4.0), ("adam", 200, 0.2)])
def test_harmonics_are_found_and_degree_0_is_behind(method, steps, gain):
    truth = shiny()
    start, images, check = replace(truth, harmonics=None), views(truth, CAMERAS), (CHECKS, views(truth, CHECKS))
    options = OptimizeOptions(steps=steps, method=method)
    ends = [optimize(start.of_degree(degree), CAMERAS, images, options, check)[0] for degree in (0, 2)]
    assert [end.degree for end in ends] == [0, 2]
    assert score(ends[1], truth) > score(ends[0], truth) + gain


def test_harmonics_of_the_start_move_slower_than_those_from_zero():
    """The first step of Adam is its rate, whatever the slope: beside that of colours it tells the rate of harmonics."""
    truth = shiny()
    images, moved = views(truth, CAMERAS), []
    given = truth.harmonics * np.float32(0.5)
    padded = given.copy()
    padded[:, truth.degree**2 - 1 :] = 0  # its highest degree begins at zero
    for harmonics in (np.zeros_like(given), given, padded):
        state = begin(replace(truth, harmonics=harmonics), CAMERAS, OptimizeOptions(steps=10))
        state.error = 0.05
        state.step(CAMERAS[0], images[0], 0.0, 1.0)
        end = state.gaussians()
        moved.append(np.abs(end.harmonics - harmonics).max() / np.abs(end.colors - truth.colors).max())
    assert moved[1] == pytest.approx(KNOWN_HARMONICS_RATE * moved[0], rel=0.02)
    assert moved[2] == pytest.approx(moved[0], rel=0.02)


def test_zeros_that_no_gradient_moves_leave_the_bytes_of_degree_0():
    """Views of Gaussians that look the same from everywhere, at rate 0 of the harmonics: the same run."""
    truth = shiny(degree=0)
    start, images = replace(truth, colors=truth.colors * np.float32(0.8)), views(truth, CAMERAS)
    options, ends = OptimizeOptions(steps=10), []
    for degree in (0, 3):
        state = begin(start.of_degree(degree), CAMERAS, options)
        state.harmonic_rate = 0.0
        for n in range(10):
            state.step(CAMERAS[n], images[n], n / 10, 1.0)
        ends.append(state.gaussians())
    assert not ends[1].harmonics.any()
    for field, array in ends[0].arrays().items():
        assert array.tobytes() == getattr(ends[1], field).tobytes()


@pytest.mark.parametrize("method", METHODS)
def test_states_draw_and_return_what_they_were_given(method):
    g = shiny()
    state = begin(g, CAMERAS, OptimizeOptions.of(method, steps=4))
    np.testing.assert_array_equal(state.gaussians().harmonics, g.harmonics)
    c = CAMERAS[3]
    np.testing.assert_allclose(state.picture(c, INRIA), render(g, c), atol=1e-4)


def test_negative_base_colours_are_kept_where_harmonics_may_make_up_for_them():
    g = replace(shiny(), colors=np.full((60, 3), -0.1))
    for method in METHODS:
        state = begin(g, CAMERAS, OptimizeOptions.of(method, steps=4))
        np.testing.assert_array_equal(state.gaussians().colors, g.colors)
    assert begin(g.of_degree(0), CAMERAS, OptimizeOptions()).gaussians().colors.min() == 0


def test_clones_splits_and_moments_go_with_their_harmonics():
    g = shiny()
    score_of = np.where(np.arange(60) % 3 == 0, 2 * SLOPE, 0)
    denser, origin = densify(g, score_of, 1000, 3.3, np.random.default_rng(0))
    assert denser.harmonics.shape == (80, 8, 3)
    np.testing.assert_array_equal(denser.harmonics[60:], g.harmonics[::3])
    np.testing.assert_array_equal(denser.harmonics[origin >= 0], g.harmonics[origin[origin >= 0]])
    state = Densified(g, CAMERAS, OptimizeOptions.of("3dgs", steps=30, max_gaussians=90))
    images = views(shiny(seed=1), CAMERAS)
    for camera, image in zip(CAMERAS[:6], images, strict=False):
        state.step(camera, image, 0.0, 1.0)
    state.slopes[:] = np.where(np.arange(60) < 7, 1.0, 0.0)
    state._densify()
    assert 2 * len(state.arrays) == len(state.running) == 12
    assert {len(array) for array in state.arrays} == {len(moment) for moment in state.running} == {67}


@pytest.mark.parametrize("method", METHODS)
def test_a_checkpoint_holds_them(method, tmp_path):
    g, options = shiny(), OptimizeOptions.of(method, steps=9)
    images = views(shiny(seed=1), CAMERAS)
    path, states = str(tmp_path / "a.npz"), [begin(g, CAMERAS, options) for _ in range(2)]
    walk = {"speed": 1.0, "elapsed": 0.0}
    for n in range(3):
        states[0].step(CAMERAS[n], images[n], 0.1, 1.0)
    judges = [Checks(state, None, OptimizeRecord()) for state in states]
    save(path, "key", states[0], judges[0], OptimizeRecord(), walk)
    assert resume(path, "key", states[1], judges[1], OptimizeRecord()) == walk
    for n in range(3, 6):
        for state in states:
            state.step(CAMERAS[n], images[n], 0.1, 1.0)
    first, second = (state.gaussians() for state in states)
    for field, array in first.arrays().items():
        assert array.tobytes() == getattr(second, field).tobytes()
    assert np.abs(first.harmonics - g.harmonics).max() > 0
    other = replace(g, harmonics=g.harmonics * np.float32(0.5))
    assert len({fingerprint(x, options) for x in (g, other, replace(g, harmonics=None))}) == 3


def test_the_plan_knows_that_steps_with_harmonics_take_longer():
    workload = Workload(100_000, 1e6, 1e6, 400, 0.05)
    seconds = [step_seconds(replace(workload, degree=degree), small=False) for degree in range(4)]
    assert seconds == sorted(seconds)
    assert [s / seconds[0] for s in seconds] == pytest.approx(HARMONICS)


@pytest.mark.parametrize("steps", [0, 20])
def test_a_conversion_keeps_what_its_closed_form_has(steps, monkeypatch, tmp_path):
    """Through colours solved or steps, what viewers drop, the checkpoint and the file."""
    made, planned = closed_form.initialise, []

    def glossy(*args, **options):
        start = made(*args, **options)
        harmonics = np.full((len(start.gaussians), 3, 3), 0.2)
        return replace(start, gaussians=replace(start.gaussians, harmonics=harmonics), form=None)

    def seen(self, workload, *args, **options):
        planned.append((self.sh_degree, workload.degree))
        return plan(self, workload, *args, **options)

    plan = Planner.plan
    monkeypatch.setattr(closed_form, "initialise", glossy)
    monkeypatch.setattr(Planner, "plan", seen)
    result = vvgt.convert("example:blob:16", max_gaussians=60, screen=32, steps=steps)
    assert planned == [(0, 0), (1, 1)]
    assert result.gaussians.degree == 1
    for options, degree in (({}, 1), ({"sh_degree": 0}, 0), ({"sh_degree": 2}, 2)):
        result.save(tmp_path / "a.ply", overwrite=True, **options)
        assert vvgt.read_ply(tmp_path / "a.ply")[0].degree == degree
