"""Cells by error: when they are cut, and when they are kept."""

import numpy as np
import pytest

from tests.test_conversion_plan import WORKLOAD, darkened, done, of
from vvgt_cli.closed_form.fit import solve_colors
from vvgt_cli.conversion.plan import Planner
from vvgt_cli.conversion.request import FitOptions
from vvgt_cli.conversion.stages import CellsByError

FORM = "vvgt_cli.closed_form.closed_form.ClosedForm"


def test_cells_by_error_are_kept_where_the_check_views_gain_and_dropped_where_they_lose(tmp_path, monkeypatch):
    def colored(form, drawn, cameras, views, rule):
        return solve_colors(drawn, cameras, views, rule=rule)

    fit = FitOptions(200, 48, steps=24)
    monkeypatch.setattr(f"{FORM}.cut_by_error", colored)
    stage = next(stage for stage in done(tmp_path, fit).stages if stage.name == "cells by error")
    assert stage.kept
    assert stage.psnr > stage.psnr_before
    monkeypatch.setattr(f"{FORM}.cut_by_error", lambda form, drawn, *_: darkened(drawn))
    stages = done(tmp_path, fit, overwrite=True).stages
    stage = next(stage for stage in stages if stage.name == "cells by error")
    assert not stage.kept
    assert stage.psnr < stage.psnr_before
    refined = next(stage for stage in stages if stage.name == "refinement")
    assert refined.psnr_before == pytest.approx(stage.psnr_before, abs=1e-3)


def test_cells_are_chosen_by_views_from_all_sides(tmp_path, monkeypatch):
    """Of 120 views of a spiral, every fifth would stand in bands with holes of 67 degrees."""
    used = []

    def seen(form, drawn, cameras, views, rule):
        used.extend(cameras)
        assert len(views) == len(cameras)
        return drawn

    monkeypatch.setattr(f"{FORM}.cut_by_error", seen)
    monkeypatch.setattr("vvgt_cli.conversion.stages.refinement.refine", lambda run, start, *_: start)
    done(tmp_path, FitOptions(60, 16, steps=200))
    eyes = np.array([camera.position for camera in used])
    eyes /= np.linalg.norm(eyes, axis=1, keepdims=True)
    ways = np.random.default_rng(0).normal(size=(4000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    assert len(used) == 24
    assert np.degrees(np.arccos((ways @ eyes.T).max(axis=1))).max() < 45


def test_cells_are_cut_by_error_where_there_is_a_pyramid_and_steps_follow():
    def cut(steps, init="moments", model=None, **limits):
        found = Planner(FitOptions(1000, 400, init, steps=steps, model=model, **limits)).plan(WORKLOAD, 1.0)
        return of(found, CellsByError)

    assert cut(24) is not None
    assert cut(None).keep
    assert not cut(None, target_psnr=40.0).keep  # fewer Gaussians may be enough: the pyramid is needed again
    assert cut(None, "wavelet") is cut(23) is cut(0) is cut(24, model="some") is None
