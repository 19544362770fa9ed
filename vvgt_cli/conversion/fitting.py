"""The Gaussians of a field: the closed form, and what improves it as planned, without scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from vvgt_cli.conversion.live import LiveForm, LiveLook, check_live
from vvgt_cli.conversion.opened import degree_of, open_field, ply_options
from vvgt_cli.conversion.place import headset_axes
from vvgt_cli.conversion.plan import Plan, Planner, WarmStart, check_memory, report_target
from vvgt_cli.conversion.request import ConvertRequest, FitOptions, file_bytes
from vvgt_cli.conversion.resume import FITTED, checkpoint_of
from vvgt_cli.conversion.stage import Stage, Work
from vvgt_cli.conversion.stages import CheckViews, ClosedFormStage, TestViews, ViewingConditions
from vvgt_cli.conversion.stages.parts import OutOfCore, StoredViews
from vvgt_cli.conversion.stages.refinement import most_steps
from vvgt_cli.conversion.stages.views import suits_small_views
from vvgt_cli.errors import UsageError
from vvgt_cli.field.blocked import Blocked
from vvgt_cli.field.field import Field, Picture
from vvgt_cli.field.workload import view_edge
from vvgt_cli.files import check_disk_space
from vvgt_cli.gaussians import Gaussians, as_stored
from vvgt_cli.gaussians.formats import format_of
from vvgt_cli.gaussians.formats.streamed import folder_of, is_streamed
from vvgt_cli.gaussians.outputs import STDOUT, check_outputs
from vvgt_cli.network.card import find_model, read_card
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run

QUICKEST = 0.5  # least pace, where the closed form took less time than estimated
SMALLER = (8, 4, 2)  # divisors of the budget that a target is tried with first


def check_request(request: ConvertRequest) -> None:
    """Raise UsageError for options that contradict each other, before anything is read."""
    request.budget()
    if request.live:
        check_live(request)
    if request.checkpoint is not None and request.fit.time_budget is not None:
        raise UsageError("--checkpoint needs runs that are repeatable, which --time-budget prevents; give one of them")
    if request.fit.model is not None:
        read_card(find_model(request.fit.model))


def plan_of(request: ConvertRequest, console: Console | None = None) -> Plan:
    """Return the plan of `convert`, after reading the volume and timing a small view; errors are those of `convert`."""
    run = Run(console or Console(), ConversionReport("convert"))
    with folder_of(request.output):
        check_outputs(request.outputs(), request.inputs(), request.overwrite)
    with open_field(run, request, resumes=False) as field:
        work = work_of(run, request, field)
        _, plan = _planned(work, request)
        report_target(run, work.fit, request.megabytes)
        return plan


def work_of(run: Run, request: ConvertRequest, field: Field) -> Work:
    """Return the state of a conversion before its first stage, with a budget that the limits allow."""
    degree, ply = degree_of(request, field.source), ply_options(request, field.source)
    budget = min(request.budget(), request.budget(degree))
    return Work(run, field, replace(request.fit, max_gaussians=budget), degree, ply=ply)


def fit(
    work: Work, request: ConvertRequest, warm: WarmStart | None = None, finished: Gaussians | None = None
) -> list[Stage]:
    """Make the Gaussians of ``work``, as they are stored, and return the stages that score them.

    Args:
        work: see `work_of`.
        request: the request.
        warm: warm start that is tried before the closed form.
        finished: finished Gaussians, box frame, that only need scores.

    Raises:
        DataError, UsageError: see `vvgt_cli.conversion.convert.convert_one`.
    """
    run, field = work.run, work.field
    if warm is not None:
        field.renderer = warm.renderer(field.views)
    if request.live or not request.scored:
        first, *scores = _unplanned(work, request)
        field.views.expect(_pictures(scores, work.fit))
        report_target(run, work.fit, request.megabytes)
        first.run(work)
        work.gaussians = work.gaussians and as_stored(work.gaussians)
        return scores
    planner, plan = _planned(work, request)
    report_target(run, work.fit, request.megabytes)
    if finished is not None:
        plan = plan.for_finished(len(finished), planner.sh_degree)
        run.report.plan = plan.record()
    elif warm is None:
        field.views.expect(_pictures(plan.stages, work.fit))
    check_memory(plan, *(() if warm is None else warm.memory(plan, work.fit)))
    work.checkpoint = checkpoint_of(request.checkpoint, field, work.fit, work.degree)
    if finished is not None:
        work.gaussians = as_stored(finished)
    elif kept := work.checkpoint.load(FITTED):
        work.gaussians = kept[0]
        run.console.message(f"{request.checkpoint} holds the fitted Gaussians: only scoring remains")
    elif warm is None or not warm.try_start(work, plan, request):
        if warm is not None:
            field.views.expect(_pictures(plan.stages, work.fit))
        whole, plan = plan, _run(work, request, planner, plan)
        if warm is not None:
            warm.keep(work, whole)
    return [stage for stage in plan.stages if stage.scores]


def _unplanned(work: Work, request: ConvertRequest) -> list[Stage]:
    """Return the stage of a conversion that nothing is fitted in, and the stages that score it."""
    if request.live:
        axes = headset_axes(work.field.source.volume, work.ply.up)
        scores = [LiveLook(), TestViews(request.scored_whole), ViewingConditions(work.fit.target, axes)]
        return [LiveForm(), *(scores if request.scored else [])]
    parts = _parts(work, request)
    if parts is None:
        return [ClosedFormStage()]
    return [parts] if parts.levels or parts.together else [parts, StoredViews()]


def _parts(work: Work, request: ConvertRequest) -> OutOfCore | None:
    """Return the stage that makes all Gaussians out of core; None where they are made in memory."""
    if not (isinstance(work.field, Blocked) and request.out_of_core):
        return None
    levels = is_streamed(request.output)
    together = not levels and (request.scored or format_of(request.output or "") is not None)
    return OutOfCore(most_steps(work.fit), levels, together, not request.scored)


def _pictures(stages: Sequence[Stage], fit: FitOptions) -> list[Picture]:
    """List the pictures that stages will request."""
    return [view for stage in stages for view in stage.views(fit)]


def _planned(work: Work, request: ConvertRequest) -> tuple[Planner, Plan]:
    """Return planner and plan before the first stage."""
    fit = work.fit
    workload = replace(work.field.workload(fit.screen, fit.max_gaussians), degree=work.degree)
    # a guess: there are fewer than pixels in a view twice as large as a small one
    wide = fit.max_gaussians <= (2 * view_edge(fit.screen, small=True)) ** 2
    planner = Planner(
        fit, sh_degree=request.ply.sh_degree or work.degree,
        wide=wide, whole=request.scored_whole, writes=request.writes,
        axes=headset_axes(work.field.source.volume, work.ply.up), parts=_parts(work, request),
    )  # fmt: skip
    plan = planner.plan(workload, work.run.elapsed())
    work.run.report.plan = plan.record()
    return planner, plan


def _run(work: Work, request: ConvertRequest, planner: Planner, plan: Plan) -> Plan:
    """Run the closed form and the stages that improve it; return the plan, revised by the closed form's time."""
    first = plan.stages[0]
    first.run(work)
    if work.levels is not None:
        return plan
    degree = work.current().degree if request.ply.sh_degree is None else request.ply.sh_degree
    if request.output is not None and request.output != STDOUT:
        check_disk_space(request.output, 2 * file_bytes(len(work.current()), degree))  # with its certificate again
    if planner.parts is None:
        # the mean of its pace and that of drawing, since steps follow neither alone on every machine
        pace = max(work.run.report.stages[-1].seconds / first.cost(plan.workload).seconds, QUICKEST) ** 0.5
        planner = replace(planner, wide=suits_small_views(work.current(), work.fit.screen), sh_degree=degree)
        workload = replace(plan.workload.at(pace), gaussians=len(work.current()), degree=work.current().degree)
        plan = planner.plan(workload, work.run.elapsed(), begun=True)
        check_memory(plan)
    else:
        plan.stages = plan.stages[1:]
    _improve(work, plan)
    work.gaussians = as_stored(work.current())  # what is scored is what the file holds
    if not work.run.report.interrupted:
        work.checkpoint.save(FITTED, work.gaussians)
    return plan


def _improve(work: Work, plan: Plan) -> None:
    """Run the planned stages before the scores, until a target is reached; errors are those of the stages."""
    ahead = [stage for stage in plan.stages if not stage.scores]
    listed = improved = False
    for n, stage in enumerate([*ahead, None]):
        if not (stage is None and improved) and work.target_reached():
            for name in (other.name for other in ahead[n:] if other.improves):
                work.run.skip(name, f"the check views have {work.fit.target_psnr:g} dB without it")
            if not improved:
                _take_fewest(work)
            return
        if not listed and not isinstance(stage, CheckViews):
            listed = True
            for name, why in plan.skipped:
                work.run.skip(name, why)
        if stage is not None:
            work.ending = plan.after(stage)
            stage.run(work)
            improved = improved or stage.improves


def _take_fewest(work: Work) -> None:
    """Take the fewest Gaussians that reach the target, among fractions of the budget."""
    start = work.start
    if start is None or start.form is None:
        return
    count = len(start.gaussians)
    for divisor in SMALLER:
        work.gaussians = replace(start.form, budget=max(count // divisor, 1)).gaussians()
        if len(work.gaussians) < count and work.target_reached():
            work.run.skip(f"{count - len(work.gaussians)} Gaussians", "the target is reached without")
            return
    work.gaussians = start.gaussians
