"""Convert one volume under a transfer function, stage by stage: `convert` to a file, `convert_in_memory` without."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path

from vvgt_cli.conversion.certify import certified
from vvgt_cli.conversion.gaussian_files import write_gaussians
from vvgt_cli.conversion.live import check_live, live_conversion
from vvgt_cli.conversion.place import out_of_box, placed, remarks, way_up
from vvgt_cli.conversion.plan import Plan, Planner, check_memory
from vvgt_cli.conversion.readback import tell_cost
from vvgt_cli.conversion.request import ConvertRequest, FitOptions, file_bytes
from vvgt_cli.conversion.result import Conversion
from vvgt_cli.conversion.resume import FITTED, Checkpoint, checkpoint_folder, checkpoint_of
from vvgt_cli.conversion.stage import Work
from vvgt_cli.conversion.stages import CheckViews, ClosedFormStage
from vvgt_cli.conversion.stages.views import wide
from vvgt_cli.conversion.warm_start import WarmStart
from vvgt_cli.errors import UsageError
from vvgt_cli.field.field import Field, Picture, Resident
from vvgt_cli.field.open import FieldNeeds, automatic, blocked, store_beside
from vvgt_cli.field.source import Source, describe_source, load, tf_record, volume_record
from vvgt_cli.field.workload import expected_wide
from vvgt_cli.files import check_room
from vvgt_cli.gaussians import Gaussians, PlyOptions, as_stored
from vvgt_cli.gaussians.formats import format_of
from vvgt_cli.gaussians.legend import legend_text
from vvgt_cli.gaussians.outputs import STDOUT, check_outputs, claimed, write_text
from vvgt_cli.jit.ahead import CONVERT, EVALUATE, INIT, LIVE, for_blocks, for_degree
from vvgt_cli.look.labels import LabelTable
from vvgt_cli.network.card import find_model, read_card
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run

QUICKEST = 0.5  # of the estimate, where the closed form took less: the rest then takes less too
VIEW_DEGREE = 2  # of harmonics by default where the light depends on the view: abs(n . v) is even
SMALLER = (8, 4, 2)  # parts of the budget that a target is tried with first


def convert(
    request: ConvertRequest, console: Console | None = None, made: Gaussians | None = None,
    start: WarmStart | None = None,
) -> ConversionReport:  # fmt: skip
    """Convert a volume to a file, and return the report; arguments as of `run_conversion`.

    Raises:
        UsageError: an output that may not be written; found before anything is read.
        DataError: invalid input, or a scene that shows nothing.
    """
    request.budget()
    if request.live:
        check_live(request)  # before anything is read
    if request.checkpoint is not None and request.limits.time_budget is not None:
        raise UsageError("--checkpoint is of runs that repeat to the byte, --time-budget of others; give one of both")
    run = Run(console or Console(), ConversionReport("convert"))
    with (
        claimed(request.outputs(), request.inputs(), request.overwrite),
        checkpoint_folder(request.checkpoint),
        opened(run, request) as field,
    ):
        early = _early(run, request)
        report = _write(run, request, run_conversion(run, request, field, made, start, early), early is not None)
        if request.checkpoint is not None and not report.interrupted:
            Checkpoint(Path(request.checkpoint)).finish()
        return report


def convert_in_memory(
    request: ConvertRequest, console: Console | None = None, start: WarmStart | None = None,
    unscored: Callable[[Conversion], None] | None = None,
) -> Conversion:  # fmt: skip
    """Convert a volume without writing anything; arguments as of `run_conversion`.

    Raises:
        DataError, UsageError: as `convert`.
    """
    run = Run(console or Console(), ConversionReport("convert"))
    with ExitStack() as stack:
        field = stack.enter_context(opened(run, request))
        conversion = run_conversion(run, request, field, start=start, unscored=unscored)
        weakref.finalize(conversion, stack.pop_all().close)  # the conversion draws the field's blocks
    run.finish()
    return conversion


def initialise_only(request: ConvertRequest, console: Console | None = None) -> ConversionReport:
    """Convert a volume to a file by the closed form alone, without rendering anything.

    Raises:
        UsageError, DataError: as `convert`.
    """
    run = Run(console or Console(), ConversionReport("init"))
    with claimed(request.outputs(), request.inputs(), request.overwrite), opened(run, request, INIT) as field:
        work = Work(run, field, request.fit, degree=degree_of(request, field.source))
        ClosedFormStage().run(work)
        return _write(run, request, _conversion(request, work, as_stored(work.made())))


def planned(request: ConvertRequest, console: Console | None = None) -> Plan:
    """Return the plan of `convert`: the volume is read and laid out, and a small view is timed.

    Raises:
        DataError, UsageError: as `convert`.
    """
    run = Run(console or Console(), ConversionReport("convert"))
    check_outputs(request.outputs(), request.inputs(), request.overwrite)
    with opened(run, replace(request, output=None)) as field:
        return _planned(run, request, field)[-1]


def fitted(run: Run, request: ConvertRequest) -> Gaussians:
    """Return the Gaussians of a conversion in the box frame, neither scored nor written.

    Raises:
        DataError, UsageError: as `convert`.
    """
    with opened(run, request) as field:
        work, planner, plan = _planned(run, request, field)
        check_memory(plan)
        _fit(work, request, planner, plan)
        return work.made()


def run_conversion(
    run: Run, request: ConvertRequest, field: Field, made: Gaussians | None = None,
    start: WarmStart | None = None, unscored: Callable[[Conversion], None] | None = None,
) -> Conversion:  # fmt: skip
    """Convert a field: closed form, refinement as planned (`vvgt_cli.conversion.plan`), scores on the test views.

    Only checkpoints are written, and the run's report stays open.

    Args:
        run: times the stages.
        request: what is asked for.
        field: the volume under its look.
        made: Gaussians in the box frame that only need scores.
        start: an earlier conversion that is tried before the closed form.
        unscored: called with the conversion before it has scores and a certificate.

    Raises:
        DataError, UsageError: as `convert`.
    """
    if request.live:
        check_live(request)
        return live_conversion(run, request, field, ply_options(request, field.source), unscored=unscored)
    if start is not None:
        field.views = start.views(field.views)
    work, planner, plan = _planned(run, request, field, expected=start is None)
    if made is not None:
        plan.stages, plan.left_out = [stage for stage in plan.stages if stage.scores], []
        plan.gaussians, plan.case = len(made), replace(plan.case, gaussians=len(made))
        plan.bytes = file_bytes(len(made), planner.sh_degree)
        run.report.plan = plan.record()
    check_memory(plan, *(() if start is None else start.memory(plan, work.fit)))
    work.checkpoint = checkpoint_of(request.checkpoint, work.field, work.fit, request.limits)
    kept = work.checkpoint.load(FITTED)
    if made is not None:
        work.gaussians = as_stored(made)
    elif kept:
        work.gaussians = kept[0]
        run.console.say(f"{request.checkpoint} holds the fitted Gaussians: only the scores are left")
    elif start is None or not start.try_start(work, plan, request):
        if start is not None:
            field.views.expect(_pictures(plan, work.fit))
        whole, plan = plan, _fit(work, request, planner, plan)
        if start is not None:
            start.keep(work, whole)
    conversion = _conversion(request, work, work.made())
    if unscored is not None:
        unscored(conversion)
    for stage in plan.stages:
        if stage.scores:
            stage.run(work)
    conversion.ply = certified(conversion.ply, run, work.field, work.fit, conversion.gaussians, request.command)
    return conversion


def _pictures(plan: Plan, fit: FitOptions) -> list[Picture]:
    """Return the pictures that a plan's stages will ask for."""
    return [view for stage in plan.stages for view in stage.views(fit)]


def _planned(run: Run, request: ConvertRequest, field: Field, expected: bool = True) -> tuple[Work, Planner, Plan]:
    """Return all that the first stage needs; with ``expected`` the field is told which pictures it will draw."""
    fit = replace(request.fit, max_gaussians=request.budget())
    if fit.model is not None:
        read_card(find_model(fit.model))  # fails before the work, not after
    degree = degree_of(request, field.source)
    fit = replace(fit, max_gaussians=request.limits.gaussians(fit.max_gaussians, degree))
    case = replace(field.workload(fit.size, fit.max_gaussians), degree=degree)
    guess = expected_wide(fit.max_gaussians, fit.size)
    planner = Planner(
        request.limits, fit, sh_degree=request.ply.sh_degree or degree, wide=guess, whole=request.scored_whole,
        writes=request.writes,
    )  # fmt: skip
    plan = planner.plan(case, run.elapsed())
    run.report.plan = plan.record()
    if expected:
        field.views.expect(_pictures(plan, fit))
    return Work(run, field, fit, request.limits, degree), planner, plan


def _fit(work: Work, request: ConvertRequest, planner: Planner, plan: Plan) -> Plan:
    """Run the closed form and the stages that improve it; return the plan, revised by the closed form's time."""
    first = plan.stages[0]
    first.run(work)
    degree = work.made().degree if request.ply.sh_degree is None else request.ply.sh_degree
    if request.output is not None and request.output != STDOUT:
        check_room(request.output, 2 * file_bytes(len(work.made()), degree))  # with its certificate once more
    # halfway between its pace and that of drawing: steps follow neither alone on every machine
    pace = max(work.run.report.stages[-1].seconds / first.cost(plan.case).seconds, QUICKEST) ** 0.5
    planner = replace(planner, wide=wide(work.made(), work.fit.size), sh_degree=degree)
    case = replace(plan.case.at(pace), gaussians=len(work.made()), degree=work.made().degree)
    plan = planner.plan(case, work.run.elapsed(), begun=True)
    check_memory(plan)
    improve(work, plan)
    work.gaussians = as_stored(work.made())  # what is scored is what the file holds
    if not work.run.report.interrupted:
        work.checkpoint.save(FITTED, work.gaussians)
    return plan


def improve(work: Work, plan: Plan) -> None:
    """Run the planned stages before the scores, until a target is reached.

    Raises:
        DataError, UsageError: as the stages.
    """
    ahead = [stage for stage in plan.stages if not stage.scores]
    told = improved = False
    for n, stage in enumerate([*ahead, None]):
        if not (stage is None and improved) and work.target_reached():
            for name in (other.name for other in ahead[n:] if other.improves):
                work.run.leave_out(name, f"the check views have {work.limits.target_psnr:g} dB without it")
            if not improved:
                _fewer(work)
            return
        if not told and not isinstance(stage, CheckViews):
            told = True
            for name, why in plan.left_out:
                work.run.leave_out(name, why)
        if stage is not None:
            work.ending = plan.after(stage)
            stage.run(work)
            improved = improved or stage.improves


def _fewer(work: Work) -> None:
    """Take the fewest Gaussians that reach the target: a part of the budget, or all of it."""
    start = work.start
    if start is None or start.form is None:
        return
    count = len(start.gaussians)
    for part in SMALLER:
        work.gaussians = replace(start.form, budget=max(count // part, 1)).gaussians()
        if len(work.gaussians) < count and work.target_reached():
            work.run.leave_out(f"{count - len(work.gaussians)} Gaussians", "the target is reached without")
            return
    work.gaussians = start.gaussians


def _conversion(request: ConvertRequest, work: Work, gaussians: Gaussians) -> Conversion:
    """Return a conversion without scores."""
    source = work.field.source
    return Conversion(out_of_box(gaussians, source.volume), work.run.report, ply_options(request, source), work.field)


@contextmanager
def opened(run: Run, request: ConvertRequest, kernels: tuple[str, ...] = CONVERT) -> Iterator[Field]:
    """Open a request's volume under its look, in memory or in blocks, and compile ``kernels``.

    Blocks lie beside the output until it is written: after an interruption the same command reads those that are there.

    Raises:
        DataError, UsageError: as `vvgt_cli.field.source.load`.
    """
    options = request.blocks or automatic(request.source, run.console)
    if options is None:
        with run.stage("read") as stage:
            source = load(request.source)
            stage.note = describe_source(source)
        _tell(run, request, source)
        run.compile(_kernels(kernels, request, source), source.kernel_type())
        with run.stage("scene"):
            field = Resident.of(source)
        yield field
        return
    wanted = FieldNeeds(request.budget(), request.fit.size, request.ply.sh_degree, values=request.live)
    with store_beside(request.output) as store, blocked(run, request.source, options, store, wanted) as found:
        _tell(run, request, found.source)
        run.compile(for_blocks(_kernels(kernels, request, found.source)), found.source.kernel_type())
        yield found
        store.remove()


def _tell(run: Run, request: ConvertRequest, source: Source) -> None:
    """Report what was read."""
    ply = ply_options(request, source)
    flattened = _flattened(degree_of(request, source), source)
    for remark in [*remarks(source.volume, ply), *([flattened] if flattened else [])]:
        run.console.say(remark)
    run.report.volume = volume_record(source)
    run.report.transfer_function = tf_record(source, request.source)
    run.report.options = asdict(request.fit) | asdict(request.limits) | {
        "frame": ply.frame, "up": ply.up, "sh_degree": ply.sh_degree,
    }  # fmt: skip


def _kernels(names: tuple[str, ...], request: ConvertRequest, source: Source) -> tuple[str, ...]:
    """Return the kernels that a source needs of ``names``."""
    names += LIVE if request.live else ()
    return for_degree(source.kernels(names), degree_of(request, source))


def degree_of(request: ConvertRequest, source: Source) -> int:
    """Return the degree of spherical harmonics: 0 where the light does not depend on the view, else as asked, or 2."""
    if source.lighting is None or not source.lighting.depends_on_view:
        return 0
    return VIEW_DEGREE if request.ply.sh_degree is None else request.ply.sh_degree


def _flattened(degree: int, source: Source) -> str | None:
    """Return a message where the degree asked for cannot hold the light."""
    if degree >= VIEW_DEGREE or source.lighting is None or not source.lighting.depends_on_view:
        return None
    return (
        f"--sh-degree {degree}: what the headlight and highlights show changes with the view; the file has their mean "
        f"over directions (--sh-degree {VIEW_DEGREE} holds them)"
    )


def ply_options(request: ConvertRequest, source: Source) -> PlyOptions:
    """Return how the file is written, with all that follows from the source."""
    ply = replace(
        request.ply,
        up=way_up(request.up, request.ply.frame, source.volume.space),
        unit_distance=source.unit_distance,
        unit_distance_label=source.unit_label,
        made_for=request.fit.size,
        rule=request.fit.rule,
        light=source.lighting,
        function=source.name if len(source.layers) > 1 else source.tf.name,
        optics=source.optics(),
        legend=_legend(source),
    )
    return placed(ply, source.volume)


def _legend(source: Source) -> str | None:
    """Return the legend of one function or label table."""
    if len(source.layers) > 1:
        return None
    labelled, volume = isinstance(source.tf, LabelTable), source.volume
    numbers = None if labelled else source.statistics
    lo, hi = (0.0, 0.0) if numbers is None else (numbers.lo, numbers.hi)
    return legend_text(source.tf, lo, hi, "HU" if volume.hounsfield else "")


def _early(run: Run, request: ConvertRequest) -> Callable[[Conversion], None] | None:
    """Return what writes the file before its scores are known, where it is written twice."""
    output = request.output
    if output is None or request.writes < 2:
        return None

    def write(found: Conversion) -> None:
        more = "; it is whole, scores follow"
        write_gaussians(run, output, found.gaussians, found.ply, request.overwrite, found.normals(), more=more)

    return write


def _write(run: Run, request: ConvertRequest, conversion: Conversion, written: bool = False) -> ConversionReport:
    """Write the file, the preview and the report; where the file is ``written``, only its certificate is missing."""
    from vvgt_cli.images import write_png

    report = run.report
    assert request.output is not None
    if conversion.ply.certificate is not None or not written:
        file, stage = (request.output, conversion.gaussians, conversion.ply), "certificate" if written else "write"
        write_gaussians(run, *file, request.overwrite or written, conversion.normals(), stage)
    if format_of(request.output):
        source = conversion.field.source
        run.compile(source.kernels(EVALUATE), source.kernel_type())
        tell_cost(run, request.output, conversion.gaussians, conversion.ply, conversion.field.views, source.volume)
    if request.preview:
        with run.stage("preview"):
            write_png(request.preview, conversion.preview(), request.overwrite)
    run.finish()
    if request.report:
        write_text(request.report, report.to_json(), request.overwrite)
    return report
