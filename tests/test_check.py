"""The stability suite: every case of `vvgt check` is a test here; and the command itself, when cases fail too."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from vvgt_cli import checks
from vvgt_cli.checks import BrokenError, Case, Figure, all_cases, require, run_case
from vvgt_cli.checks.scenes import build, function, smooth, step
from vvgt_cli.checks.stiffness import changes, stiffness
from vvgt_cli.dvr import Scene
from vvgt_cli.volume import Volume

CASES = list(all_cases())


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.stage}: {case.name}")
def test_case(case):
    outcome = run_case(case)
    assert outcome.passed, outcome.problem


def test_there_are_enough_cases_through_every_stage_each_with_a_name_of_its_own():
    assert len(CASES) >= 500
    assert len({(case.stage, case.name) for case in CASES}) == len(CASES)
    assert {case.stage for case in CASES} == {
        "reading", "function", "ray caster", "closed form", "splats", "gradients", "optimiser", ".ply", "network",
        "whole way", "harmonics", "light", "optics grid", "ways",
    }  # fmt: skip


def broken():
    raise BrokenError("alpha 1.5")


def crashing():
    return np.zeros(3)[7]


HOPELESS = [
    Case("stage", "off", lambda: Figure("off", 2.0, 1.0)),
    Case("stage", "nan", lambda: Figure("off", float("nan"), 1.0)),
    Case("other", "broken", broken),
    Case("other", "crash", crashing),
]


@pytest.mark.parametrize(
    ("case", "problem"),
    list(zip(HOPELESS, ("off 2, at most 1", "off nan", "alpha 1.5", "IndexError: .*py:"), strict=True)),
)
def test_what_is_wrong_fails_with_one_line(case, problem):
    outcome = run_case(case)
    assert not outcome.passed
    assert "\n" not in outcome.problem
    assert re.search(problem, outcome.problem), outcome.problem
    with pytest.raises(BrokenError, match="no"):
        require(False, "no")


def few(monkeypatch, cases):
    monkeypatch.setattr("vvgt_cli.commands.check.all_cases", lambda: iter(cases))


def test_the_command_prints_a_table_and_ends_with_status_0(vvgt, monkeypatch):
    few(monkeypatch, CASES[:3])
    result = vvgt("check")
    assert result.code == 0
    table = result.out.decode().splitlines()
    assert [line.split()[0] for line in table[1:4]] == ["ok"] * 3
    assert table[-1].split() == ["reading", "3", "cases,", "none", "failed"]
    assert "reading" in result.err


def test_failures_end_with_status_1_and_are_named(vvgt, monkeypatch):
    few(monkeypatch, [*CASES[:2], *HOPELESS])
    result = vvgt("check")
    assert result.code == 1
    assert "4 of 6 cases failed (stage: off; stage: nan; other: broken and 1 more)" in result.error
    assert result.out.decode().count("\nFAIL") == 4


def test_json_holds_every_outcome(vvgt, monkeypatch):
    few(monkeypatch, [CASES[0], *HOPELESS])
    document = json.loads(vvgt("check", "--json", "--quiet").out)
    assert (document["format"], document["cases"], document["failed"]) == ("vvgt-check", 5, 4)
    assert [o["passed"] for o in document["outcomes"]] == [True, False, False, False, False]
    assert document["outcomes"][2]["value"] is None
    assert document["machine"]
    assert document["stiffness"] is None


def test_a_scene_is_measured_and_looked_at(vvgt):
    result = vvgt("check", "example:blob:16", "--tf", "viridis", "--json", "--tolerance", "0.01")
    assert result.code == 0, result.err
    document = json.loads(result.out)
    assert document["volume"]["dims"] == [16, 16, 16]
    found = document["stiffness"]
    assert found["needed_step"] in (1.0, 2.0, 4.0)
    assert 0 < found["change_per_voxel"] < 1
    assert len(document["outcomes"]) == 4
    assert "step that an error of 0.002 needs" in vvgt("check", "example:blob:16", "--tf", "viridis").out.decode()


def test_options_of_a_volume_need_one(vvgt):
    assert vvgt("check", "--tf", "viridis").code == 2
    assert "expected VOLUME" in vvgt("check", "--spacing", 1, 1, 2).error


def test_stiffness_of_a_step_function_and_of_a_slope():
    depth = 3.0  # a voxel
    stiff = build(smooth(12), step(-np.expm1(-depth)))
    found = stiffness(stiff, 1e-3)
    assert found.depth_per_step == pytest.approx(depth / 2, rel=1e-6)
    assert found.explicit_step == pytest.approx(1 / depth, rel=1e-6)
    assert found.change_per_voxel == pytest.approx(1)
    assert list(found.errors.values()) == sorted(found.errors.values(), reverse=True)
    slope = build(np.broadcast_to(np.linspace(0, 1, 21), (5, 5, 21)).copy(), function([0, 1], [0, 0.01]))
    change, abrupt = changes(slope)
    assert change == pytest.approx(1 / 20, rel=0.02)
    assert abrupt == 0
    assert stiffness(slope, 1e-3).needed_step == 4.0
    assert stiffness(stiff, 1e-9).needed_step is None


def test_a_spike_between_two_voxels_counts_as_change():
    data = np.zeros((3, 3, 4), np.float32)
    data[:, :, 2:] = 1.0  # neighbours at 0 and 1, both transparent; opaque between
    change, abrupt = changes(build(data, function([0, 0.4, 0.5, 0.6, 1], [0, 0, 1, 0, 0])))
    assert change == 1
    assert abrupt == 1


def test_stiffness_of_a_grid_is_that_of_its_extinction():
    """Labels of 1 and 0.6 of the largest extinction along x, then nothing: steps of 0.4 and 0.6."""
    grid = np.zeros((3, 3, 6, 4), np.float32)
    grid[:, :, :4, 3] = 0.5, 0.5, 0.3, 0.3
    scene = Scene.of_grid(Volume(grid[..., 3]), function([0, 1], [0, 1]), 1.0, grid)
    change, abrupt = changes(scene)
    assert change == pytest.approx(0.6)
    assert abrupt == pytest.approx(9 / (9 * 4 + 4 * 6 * 2))  # of neighbours along x, and along y and z, that show any
    assert stiffness(scene, 1e-3).depth_per_step == pytest.approx(0.25)


def test_slabs_change_no_figure(monkeypatch):
    scene = build(smooth(12), step(0.5))
    whole = changes(scene)
    monkeypatch.setattr(checks.stiffness, "SLAB", 300)
    assert changes(scene) == whole
