"""`vvgt check`: its self-test, the stiffness of a scene, and what it prints when cases fail."""

import json
import re
import sys

import numpy as np
import pytest

from tests.stiff_scenes import build, function, smooth, step
from vvgt_cli.checks import Case, CheckError, Figure, report, require, run_case
from vvgt_cli.checks.report import measure_changes, measure_stiffness
from vvgt_cli.checks.self_test import self_test_cases
from vvgt_cli.dvr import Scene
from vvgt_cli.gaussians.formats import FORMATS
from vvgt_cli.volume import Volume


def test_the_self_test_passes_and_prints_a_table(vvgt):
    result = vvgt.ok("check")
    rows, counts = result.out.decode().split("\n\n")
    assert all(line.startswith("ok") for line in rows.splitlines()[1:])
    for known in FORMATS:
        assert f" {known.suffix} written and read" in rows
    assert [line.split()[0] for line in counts.splitlines()] == [
        "kernels", "splats", "ray", "closed", "conversion", "files"
    ]  # fmt: skip
    assert "conversion" in result.err


def test_formats_whose_library_is_missing_are_not_tested(monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    assert not any(".usdc" in case.name for case in self_test_cases())


def raises():
    raise CheckError("alpha 1.5")


PASSING = Case("first", "good", lambda: Figure("off", 1.0, 1.0))
FAILING = {
    "off 2, at most 1": Case("stage", "off", lambda: Figure("off", 2.0, 1.0)),
    "off nan": Case("stage", "nan", lambda: Figure("off", float("nan"), 1.0)),
    "alpha 1.5": Case("other", "broken", raises),
    "IndexError: .*py:": Case("other", "crash", lambda: np.zeros(3)[7]),
}


@pytest.mark.parametrize("problem", FAILING)
def test_what_is_wrong_fails_with_one_line(problem):
    outcome = run_case(FAILING[problem])
    assert not outcome.passed
    assert "\n" not in outcome.problem
    assert re.search(problem, outcome.problem), outcome.problem
    with pytest.raises(CheckError, match="no"):
        require(False, "no")


def test_failures_end_with_status_1_and_are_named(vvgt, monkeypatch):
    monkeypatch.setattr("vvgt_cli.checks.self_test.self_test_cases", lambda: iter([PASSING, *FAILING.values()]))
    result = vvgt("check")
    assert result.code == 1
    assert "4 of 5 cases failed (stage: off; stage: nan; other: broken and 1 more)" in result.error
    assert result.out.decode().count("\nFAIL") == 4
    document = json.loads(vvgt("check", "--json", "--quiet").out)
    assert (document["format"], document["cases"], document["failed"]) == ("vvgt-check", 5, 4)
    assert [o["passed"] for o in document["outcomes"]] == [True, False, False, False, False]
    assert document["outcomes"][2]["value"] is None
    assert document["machine"]
    assert document["stiffness"] is None


def test_a_scene_is_measured_and_checked(vvgt):
    scene = ("check", "example:blob:16", "--tf", "viridis")
    document = json.loads(vvgt.ok(*scene, "--json", "--tolerance", "0.01").out)
    assert document["volume"]["dims"] == [16, 16, 16]
    found = document["stiffness"]
    assert found["needed_step"] in (1.0, 2.0, 4.0)
    assert 0 < found["change_per_voxel"] < 1
    assert len(document["outcomes"]) == 4
    assert "largest step with an error of at most 0.002" in vvgt(*scene).out.decode()


def test_options_of_a_volume_need_one(vvgt):
    assert vvgt("check", "--tf", "viridis").code == 2
    assert "expected VOLUME" in vvgt("check", "--spacing", 1, 1, 2).error


def test_stiffness_of_a_step_function_and_of_a_slope():
    depth = 3.0  # a voxel
    stiff = build(smooth(12), step(-np.expm1(-depth)))
    found = measure_stiffness(stiff, 1e-3)
    assert found.depth_per_step == pytest.approx(depth / 2, rel=1e-6)
    assert found.explicit_step == pytest.approx(1 / depth, rel=1e-6)
    assert found.change_per_voxel == pytest.approx(1)
    assert list(found.errors.values()) == sorted(found.errors.values(), reverse=True)
    slope = build(np.broadcast_to(np.linspace(0, 1, 21), (5, 5, 21)).copy(), function([0, 1], [0, 0.01]))
    change, abrupt = measure_changes(slope)
    assert change == pytest.approx(1 / 20, rel=0.02)
    assert abrupt == 0
    assert measure_stiffness(slope, 1e-3).needed_step == 4.0
    assert measure_stiffness(stiff, 1e-9).needed_step is None


def test_a_spike_between_two_voxels_counts_as_change():
    data = np.zeros((3, 3, 4), np.float32)
    data[:, :, 2:] = 1.0  # neighbours at 0 and 1, both transparent; opaque between
    change, abrupt = measure_changes(build(data, function([0, 0.4, 0.5, 0.6, 1], [0, 0, 1, 0, 0])))
    assert change == 1
    assert abrupt == 1


def test_stiffness_of_a_grid_is_that_of_its_extinction():
    """Labels of 1 and 0.6 of the largest extinction along x, then nothing: steps of 0.4 and 0.6."""
    grid = np.zeros((3, 3, 6, 4), np.float32)
    grid[:, :, :4, 3] = 0.5, 0.5, 0.3, 0.3
    scene = Scene.of_grid(Volume(grid[..., 3]), function([0, 1], [0, 1]), 1.0, grid)
    change, abrupt = measure_changes(scene)
    assert change == pytest.approx(0.6)
    assert abrupt == pytest.approx(9 / (9 * 4 + 4 * 6 * 2))  # of neighbours along x, and along y and z, that show any
    assert measure_stiffness(scene, 1e-3).depth_per_step == pytest.approx(0.25)


def test_slabs_change_no_figure(monkeypatch):
    scene = build(smooth(12), step(0.5))
    whole = measure_changes(scene)
    monkeypatch.setattr(report, "SLAB", 300)
    assert measure_changes(scene) == whole
