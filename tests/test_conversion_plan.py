"""What `convert` decides to do: limits, estimates, and what is skipped."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from onnx_models import write_model
from test_cli_infer import DARKER

from tests.refused import refused
from vvgt_cli.cameras.blocks import BLOCK, ENOUGH, FEW, spread_blocks
from vvgt_cli.conversion.convert import convert_one
from vvgt_cli.conversion.fitting import plan_of
from vvgt_cli.conversion.plan import Planner, check_memory
from vvgt_cli.conversion.request import ConvertRequest, FitOptions
from vvgt_cli.conversion.stages import BackProjection, Network, Refinement, TrainingViews
from vvgt_cli.conversion.stages.refinement import WIDER
from vvgt_cli.conversion.stages.views import view_count
from vvgt_cli.defaults import EARLY, MAX_STEPS, STEPS
from vvgt_cli.errors import UsageError
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.field.workload import Workload
from vvgt_cli.gaussians import Gaussians, PlyOptions, read_ply
from vvgt_cli.gaussians.constants import DILATION
from vvgt_cli.gaussians.rules import RULES
from vvgt_cli.progress import Console
from vvgt_cli.refine.options import TEXTURE

WORKLOAD = Workload(gaussians=100_000, cells=1e6, voxels=10.2e6, size=48, view=0.05, pace=1.0, base_bytes=2e8)
FORM = 0.4 + 0.62 + 0.03 * 10.2 + 0.28  # seconds of its closed form
SOURCE = SourceRequest("example:marschner-lobb:24")
SMALL = FitOptions(400, 48)


def plan(steps=None, spent=1.0, begun=False, workload=WORKLOAD, size=48, wide=True, **limits):
    """The plan of a method without cells that could be cut again."""
    workload = replace(workload, size=size)
    return Planner(FitOptions(1000, size, "wavelet", steps=steps, **limits), wide=wide).plan(workload, spent, begun)


def of(found, kind):
    """The stage of a kind in a plan, or None."""
    return next((stage for stage in found.stages if isinstance(stage, kind)), None)


def steps_of(found):
    stage = of(found, Refinement)
    return 0 if stage is None else stage.steps


def ending(edge=48.0, judge=0.06, check=0.06, size=48):
    """Seconds of three test views, the conditions, texture and the file."""
    near = (size // 3) ** 2  # pixels
    views = 2 if spread_blocks(size, size) is None else 1  # one of the conditions' is a test view
    texture = judge * near / edge**2 + 0.05 * near / 400**2
    return 3 * (judge + 0.03 * (edge / 400) ** 2) + views * check + 0.15 + 0.155 + texture + 0.1


def drawn(size, enough):
    """Pixels of a view's blocks."""
    blocks = spread_blocks(size, size, enough=enough)
    return size**2 if blocks is None else blocks.numbers.size * BLOCK**2


def done(tmp_path, fit=SMALL, **options):
    return convert_one(ConvertRequest(SOURCE, str(tmp_path / "a.ply"), fit, **options), Console(quiet=True)).report


def chosen(report):
    """What the plan had for refinement."""
    return next(stage for stage in report.plan["stages"] if stage["name"] == "refinement")


def names(report):
    return [stage.name for stage in report.stages]


def test_without_limits_the_default_steps_are_planned_and_back_projection_is_not():
    found = plan()
    assert [stage.name for stage in found.stages] == [
        "closed form", "check views", "views", "refinement", "test views", "conditions"
    ]  # fmt: skip
    assert steps_of(found) == STEPS
    assert [name for name, _ in found.skipped] == ["network", "back-projection"]
    assert found.seconds == pytest.approx(sum(seconds for _, seconds in found.costs()))
    step = 0.027 * (48 / 400) ** 2 + 0.0275
    assert found.seconds == pytest.approx(1 + FORM + STEPS * step + 120 * 0.05 + 4 * 0.06 + ending())
    assert found.bytes == 3600 + 1000 * 68
    assert f"{STEPS} steps" in found.text()


@pytest.mark.parametrize(("size", "edge"), [(400, 200), (1080, 200), (300, 150)])
def test_views_are_small_where_gaussians_are_wide(size, edge):
    found = plan(size=size)
    descent, views = of(found, Refinement), of(found, TrainingViews)
    assert (descent.small, descent.steps, views.edge) == (True, STEPS, edge)
    judged, check_pixels, whole = drawn(size, ENOUGH), drawn(size, FEW), min(size, 300)
    judge, check = (1.2 * 0.05 * pixels / whole**2 for pixels in (judged, check_pixels))
    step = 0.027 * (edge / 400) ** 2 + 0.0275
    count = view_count(STEPS, True)
    seconds = 1 + FORM + STEPS * step + count * (edge / whole) ** 2 * 0.05 + 4 * check
    seconds += ending(judged**0.5, judge, check, size)
    assert found.seconds == pytest.approx(seconds)
    bytes_ = 294e6 + 1240e5 + 32 * (count * edge**2 + 4 * check_pixels + size**2)
    assert found.memory == pytest.approx(2e8 + bytes_, rel=1e-3)
    assert of(plan(size=size, time_budget=20.0), Refinement).small
    for other in (plan(size=size, wide=False), plan(size=size, steps=23)):
        assert (of(other, Refinement).small, of(other, TrainingViews).edge) == (False, min(size, 300))
    assert not of(plan(size=100), Refinement).small


def test_refinement_on_small_views_gains_on_whole_ones(tmp_path):
    report = done(tmp_path, FitOptions(600, 128))
    stages = {stage.name: stage for stage in report.stages}
    assert stages["views"].note.startswith("96 of 64 px to fit to")
    assert stages["refinement"].kept
    assert stages["refinement"].psnr > stages["refinement"].psnr_before + 1
    assert chosen(report)["small"]
    assert report.refinement["dilation"] == DILATION / 4
    assert report.refinement["rule"] == "inria"


def test_a_large_screen_is_fitted_to_by_its_dilation_on_small_views(tmp_path):
    report = done(tmp_path, FitOptions(600, 600, steps=48))
    assert report.refinement["dilation"] == pytest.approx(DILATION / 9)
    stages = {stage.name: stage for stage in report.stages}
    assert stages["views"].note.startswith("24 of 200 px")
    assert "blocks" in stages["check views"].note
    header = read_ply(tmp_path / "a.ply")[1]
    assert (header.screen_size, header.rule) == (600, "inria")
    other = done(tmp_path, FitOptions(600, 600, steps=48, rule="playcanvas"), overwrite=True)
    by = {(condition["rule"], condition["size"]): condition["psnr"] for condition in report.conditions}
    assert {(condition["rule"], condition["size"]): condition["psnr"] for condition in other.conditions}[
        "playcanvas", 600
    ] > by["playcanvas", 600]
    assert report.conditions == sorted(report.conditions, key=lambda condition: condition["psnr"])
    assert len(by) == 10


def test_narrow_gaussians_get_whole_views(tmp_path, monkeypatch):
    monkeypatch.setattr("vvgt_cli.conversion.fitting.suits_small_views", lambda *_: False)
    report = done(tmp_path, FitOptions(600, 128, steps=30))
    assert chosen(report)["small"]  # what was foreseen
    assert next(stage for stage in report.stages if stage.name == "views").note.startswith("24 of 128 px")
    assert report.refinement["dilation"] == DILATION


def test_views_that_do_not_fit_are_refused(monkeypatch):
    found = plan(size=400)  # 96 of 200 px, blocks of 4 to check by, one of which is drawn whole
    found.stages = found.stages[1:]  # the closed form is done
    monkeypatch.setattr("vvgt_cli.conversion.plan.free_memory", lambda: 400**2 * 32 * 28)
    check_memory(found)
    monkeypatch.setattr("vvgt_cli.conversion.plan.free_memory", lambda: 400**2 * 32 * 26)
    for pictures, size in ((0, 392), (400**2 * 32 * 23, 288)):  # with those that a series keeps
        refused(UsageError, f"--screen 400.*--screen {size} would fit", check_memory, found, pictures)


def test_gaussians_that_do_not_fit_are_refused_with_the_number_that_would(monkeypatch):
    monkeypatch.setattr("vvgt_cli.closed_form.closed_form.expected_cells", lambda *sizes: 2.0 * sizes[3])
    workload = replace(WORKLOAD, gaussians=1_000_000, cells=2e6)
    found = Planner(FitOptions(1_000_000, 48, steps=0)).plan(workload, 1.0)
    each, views = 0.8 * (2 * 294 + 1240), 0.8 * 32 * 48**2 * 29
    monkeypatch.setattr("vvgt_cli.conversion.plan.free_memory", lambda: each * 1e6 + views + 1)
    check_memory(found)
    monkeypatch.setattr("vvgt_cli.conversion.plan.free_memory", lambda: each * 3e5 + views)
    refused(UsageError, "--max-gaussians 250000 would fit", check_memory, found)
    with pytest.raises(UsageError, match="--max-gaussians 125000 would fit"):  # a series keeps more
        check_memory(found, beside=lambda workload: 0.5 * each * workload.gaussians)


def test_no_steps_leave_back_projection():
    found = plan(steps=0)
    assert steps_of(found) == 0
    assert of(found, BackProjection) is not None
    assert found.stages[0].recut
    assert [name for name, _ in found.skipped] == ["refinement"]


def test_back_projection_is_kept_where_the_check_views_gain_and_dropped_where_they_lose(tmp_path, monkeypatch):
    fit = FitOptions(200, 48, steps=0)
    convert_one(ConvertRequest(SOURCE, str(tmp_path / "init.ply"), fit, scored=False), Console(quiet=True))
    alone = read_ply(tmp_path / "init.ply")[0]
    stage = next(stage for stage in done(tmp_path, fit).stages if stage.name == "back-projection")
    assert stage.kept
    assert stage.psnr > stage.psnr_before
    assert not np.array_equal(read_ply(tmp_path / "a.ply")[0].colors, alone.colors)
    monkeypatch.setattr(
        "vvgt_cli.closed_form.backproject", lambda start, *_, **__: (darkened(start.gaussians), "worse")
    )
    stage = next(stage for stage in done(tmp_path, fit, overwrite=True).stages if stage.name == "back-projection")
    assert not stage.kept
    assert stage.psnr < stage.psnr_before
    assert np.array_equal(read_ply(tmp_path / "a.ply")[0].colors, alone.colors)


def darkened(g):
    return Gaussians(g.means, g.log_scales, g.quaternions, g.opacity_logits, 0.1 * g.colors)


@pytest.mark.parametrize(
    ("page", "text"),
    [
        ("README.md", "({} steps)"), ("docs/python.md", "1080 px and {} steps"),
        ("docs/optimize.md", "Then follow {} steps"), ("docs/blocks.md", "`--steps` ({})"),
        ("docs/commands/convert.md", "takes [{} steps]"),
    ],
)  # fmt: skip
def test_pages_state_the_default_number_of_steps(page: str, text: str) -> None:
    assert text.format(STEPS) in (Path(__file__).parents[1] / page).read_text("utf-8")


@pytest.mark.parametrize(("steps", "before"), [(1, True), (23, True), (24, False)])
def test_few_steps_are_taken_after_back_projection(steps, before, tmp_path):
    assert (of(plan(steps=steps), BackProjection) is not None) is before
    if steps == 1:
        stages = names(done(tmp_path, FitOptions(200, 48, steps=1)))
        assert stages.index("back-projection") < stages.index("refinement")
        assert stages.count("views") == 1


def test_more_time_is_more_steps_and_never_more_than_the_time():
    taken = [plan(time_budget=seconds) for seconds in (2, 7, 9, 10, 15, 20, 30, 100)]
    steps = [steps_of(found) for found in taken]
    assert steps == sorted(steps)
    assert steps[0] == 0
    assert 8 <= steps[3] < steps[-1] == MAX_STEPS
    for found, seconds in zip(taken[2:], (9, 10, 15, 20, 30, 100), strict=True):
        assert found.seconds <= seconds
        assert of(found, Refinement).most == MAX_STEPS
    assert of(taken[0], BackProjection) is None
    assert {name for name, _ in taken[0].skipped} == {"refinement", "back-projection"}
    assert steps_of(plan(time_budget=30, steps=40)) == 40


def test_a_network_runs_where_there_is_time_for_it():
    planner = Planner(FitOptions(1000, 400, model="some"))
    workload = replace(WORKLOAD, size=400)
    assert of(planner.plan(workload, 1.0), Network).model == "some"
    assert not of(planner.plan(workload, 1.0), Refinement).small  # it was trained on whole views
    short = Planner(FitOptions(1000, 400, model="some", time_budget=7.0)).plan(workload, 1.0)
    assert of(short, Network) is None
    assert "network" in {name for name, _ in short.skipped}


def test_views_are_fitted_to_at_their_size_and_judged_at_the_screens(tmp_path, monkeypatch):
    asked = []

    def refine(run, gaussians, train, check, options, begin=None):
        asked.append((options.rule, options.check_rule, options.texture, gaussians, begin))
        return gaussians

    monkeypatch.setattr("vvgt_cli.conversion.stages.refinement.refine", refine)
    done(tmp_path, FitOptions(100, 128, steps=30, rule="playcanvas"))
    rule = RULES["playcanvas"]
    assert asked[0][:3] == (rule.at(0.5), rule, TEXTURE)
    start, begin = asked[0][3:]
    wider = np.sort(np.exp(begin[0].log_scales - start.log_scales), axis=1)
    np.testing.assert_allclose(wider, np.tile([1, WIDER, WIDER], (len(start), 1)), rtol=1e-4)
    done(tmp_path, FitOptions(100, 128, steps=30, init="uniform"), overwrite=True)  # which stand on no lattice
    done(tmp_path, FitOptions(100, 128, steps=10), overwrite=True)  # too few to make it sharp again
    assert [found[-1] for found in asked[1:]] == [None, None]


def test_a_slower_machine_gets_fewer_steps_after_the_closed_form():
    quick, slow = (plan(time_budget=12, spent=6, begun=True, workload=WORKLOAD.at(pace)) for pace in (1, 3))
    assert steps_of(quick) > steps_of(slow) > 0
    assert WORKLOAD.at(3).view == WORKLOAD.view  # measured, not fitted


def test_steps_are_planned_for_the_gaussians_that_there_are(tmp_path, monkeypatch):
    monkeypatch.setattr("vvgt_cli.conversion.stages.closed_form.FAINT_LOGIT", np.inf)  # all is a fog
    monkeypatch.setattr("vvgt_cli.conversion.stages.closed_form.FEWEST", 200)
    plan_of, seen, made = Planner.plan, [], []

    def note(self, workload, *rest, **begun):
        seen.append(workload.gaussians)
        return plan_of(self, workload, *rest, **begun)

    monkeypatch.setattr(Planner, "plan", note)
    monkeypatch.setattr("vvgt_cli.conversion.fitting._improve", lambda work, plan: made.append(len(work.current())))
    done(tmp_path, FitOptions(1000, 48))
    assert made[0] < 300
    assert seen == [1000, made[0]]


def test_views_come_in_sets():
    assert [view_count(steps, True) for steps in (0, 1, 48, 80, 112, 144, 10_000)] == [24, 24, 24, 48, 72, 96, 120]
    assert [view_count(steps, False) for steps in (0, 24, 60, 112, 10_000)] == [24, 24, 48, 96, 120]


@pytest.mark.parametrize(
    ("limits", "line"),
    [
        ({"time_budget": 0.0}, "--time-budget 0"),
        ({"max_megabytes": -1.0}, "--max-megabytes -1"),
        ({"max_megabytes": float("inf")}, "--max-megabytes inf"),
        ({"target_psnr": float("nan")}, "--target-psnr nan"),
    ],
)
def test_limits_that_cannot_be_are_refused(limits, line):
    refused(UsageError, line, FitOptions, **limits)


@pytest.mark.parametrize("degree", [0, 3])
def test_a_size_is_kept_to_the_byte_and_one_without_room_is_refused(degree, tmp_path):
    fit = FitOptions(100_000, 48, steps=0, max_megabytes=0.02)
    report = done(tmp_path, fit, ply=PlyOptions(sh_degree=degree))
    assert report.gaussians == len(read_ply(tmp_path / "a.ply")[0])
    assert 0.02e6 - 4500 < report.bytes <= 0.02e6  # room for a long legend is left
    assert (tmp_path / "a.ply").stat().st_size == report.bytes
    refused(UsageError, "no Gaussian fits", done, tmp_path, replace(SMALL, max_megabytes=0.001))


def test_a_target_that_the_closed_form_has_pays_for_nothing_else(tmp_path):
    report = done(tmp_path, replace(SMALL, target_psnr=10.0))
    assert names(report) == [
        "read", "scene", "closed form", "check views", "write", "test views", "conditions", "certificate",
    ]  # fmt: skip
    assert report.gaussians <= 400 // 8
    assert [name for name, _ in report.skipped[:2]] == ["cells by error", "refinement"]
    assert "Gaussians" in report.skipped[2][0]


def test_a_target_between_ends_refinement_when_it_is_reached(tmp_path):
    start = done(tmp_path, FitOptions(400, 48, steps=24)).stages
    before = next(stage.psnr_before for stage in start if stage.name == "refinement")
    report = done(tmp_path, replace(SMALL, target_psnr=before + 1), overwrite=True)
    assert report.refinement["reason"] == "target"
    assert report.refinement["psnr_after"] >= before + 1
    assert report.refinement["steps"] < MAX_STEPS


def test_a_hopeless_target_ends_and_writes_the_best(tmp_path):
    report = done(tmp_path, FitOptions(50, 32, target_psnr=90.0))
    assert report.refinement["reason"] in ("steps", "no gain")
    assert report.refinement["psnr_after"] >= report.refinement["psnr_before"]
    assert len(read_ply(tmp_path / "a.ply")[0]) == report.gaussians


def test_no_time_leaves_the_closed_form(tmp_path):
    report = done(tmp_path, replace(SMALL, time_budget=1e-3))
    assert names(report) == ["read", "scene", "closed form", "write", "test views", "certificate"]
    assert len(read_ply(tmp_path / "a.ply")[0]) == report.gaussians > 0


def test_enough_time_leaves_all_steps(tmp_path):
    report = done(tmp_path, replace(SMALL, steps=8, time_budget=600.0))
    assert (report.refinement["reason"], report.refinement["steps"]) == ("steps", 8)


def test_a_report_is_of_all_test_views():
    asked = ({}, {"report": "r.json"}, {"all_views": True})
    assert [ConvertRequest(SOURCE, "a.ply", **one).scored_whole for one in asked] == [False, True, True]


def test_a_dry_run_plans_and_writes_nothing(tmp_path):
    request = ConvertRequest(SOURCE, str(tmp_path / "a.ply"), SMALL)
    found = plan_of(request, Console(quiet=True))
    assert not list(tmp_path.iterdir())
    assert found.seconds > 0
    assert found.memory > 1e8
    lines = found.text().splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["so", "closed", "check"]
    assert "120 views of 48 px" in found.text()
    done(tmp_path)
    refused(UsageError, "exists", plan_of, request, Console(quiet=True))


def test_the_default_refines_and_reports_what_it_skipped(tmp_path, monkeypatch):
    monkeypatch.setattr("vvgt_cli.refine.loop.UNSEEN", 0.0)
    report = done(tmp_path)
    assert report.refinement["steps"] == STEPS
    monkeypatch.setattr("vvgt_cli.refine.loop.UNSEEN", 1.0)
    early = done(tmp_path, overwrite=True)
    assert early.refinement["steps"] == EARLY
    assert f"{EARLY} steps, more would hardly be seen" in next(s.note for s in early.stages if s.name == "refinement")
    assert done(tmp_path, replace(SMALL, steps=STEPS), overwrite=True).refinement["steps"] == STEPS
    assert "back-projection" not in names(report)
    assert [name for name, _ in report.skipped] == ["network", "back-projection"]
    assert np.isfinite(report.scores["psnr"])
    assert Path(tmp_path / "a.ply").exists()


def test_a_network_that_makes_it_worse_is_dropped(tmp_path):
    write_model(tmp_path / "darker", DARKER)
    plain = done(tmp_path, FitOptions(400, 48, steps=30))
    worse = done(tmp_path, FitOptions(400, 48, steps=30, model=str(tmp_path / "darker")), overwrite=True)
    stage = next(stage for stage in worse.stages if stage.name == "network")
    assert not stage.kept
    assert stage.psnr < stage.psnr_before
    assert worse.scores["psnr"] == plain.scores["psnr"]
    refused(UsageError, "no such folder", done, tmp_path, FitOptions(400, 48, model="no/such"), overwrite=True)
