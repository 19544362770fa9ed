"""The conversion of one volume under a transfer function, stage by stage, to a file or in memory."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path

from vvgt_cli.conversion.certify import with_certificate
from vvgt_cli.conversion.file_layout import degree_of, harmonics_warning, ply_options
from vvgt_cli.conversion.gaussian_files import is_page, report_format_cost, write_gaussians
from vvgt_cli.conversion.live import check_live, convert_live
from vvgt_cli.conversion.place import headset_axes, placement_warnings, to_unit_frame
from vvgt_cli.conversion.plan import Plan, Planner, check_memory, report_target
from vvgt_cli.conversion.request import ConvertRequest, FitOptions, file_bytes
from vvgt_cli.conversion.result import Conversion
from vvgt_cli.conversion.resume import FITTED, Checkpoint, checkpoint_folder, checkpoint_of
from vvgt_cli.conversion.stage import Work
from vvgt_cli.conversion.stages import CheckViews, ClosedFormStage
from vvgt_cli.conversion.stages.views import suits_small_views
from vvgt_cli.conversion.warm_start import WarmStart
from vvgt_cli.errors import UsageError
from vvgt_cli.field.blocked import Blocked
from vvgt_cli.field.field import Field, Picture, Resident
from vvgt_cli.field.open import MIN_BLOCKED, FieldNeeds, automatic, blocked, store_beside
from vvgt_cli.field.settings import MANY
from vvgt_cli.field.source import Source, describe_source, load, tf_record, volume_record
from vvgt_cli.field.workload import expected_wide
from vvgt_cli.files import check_disk_space
from vvgt_cli.gaussians import Gaussians, as_stored
from vvgt_cli.gaussians.formats import format_of
from vvgt_cli.gaussians.outputs import STDOUT, check_outputs, claimed, write_text
from vvgt_cli.jit.ahead import CONVERT, EVALUATE, INIT, LIVE, for_blocks, for_degree
from vvgt_cli.look.suggest import fitting
from vvgt_cli.network.card import find_model, read_card
from vvgt_cli.progress import Console
from vvgt_cli.refine import load_ahead
from vvgt_cli.score.record import ConversionReport, Run

QUICKEST = 0.5  # least pace, where the closed form took less time than estimated
SMALLER = (8, 4, 2)  # divisors of the budget that a target is tried with first


def convert(
    request: ConvertRequest, console: Console | None = None, finished: Gaussians | None = None,
    start: WarmStart | None = None,
) -> ConversionReport:  # fmt: skip
    """Convert a volume to a file, and return the report; see `run_conversion` for the arguments.

    Raises:
        UsageError: an output may not be written; raised before anything is read.
        DataError: the input is invalid, or nothing is visible.
    """
    request.budget()
    if request.live:
        check_live(request)  # before anything is read
    if request.checkpoint is not None and request.limits.time_budget is not None:
        raise UsageError("--checkpoint needs runs that are repeatable, which --time-budget prevents; give one of them")
    run = Run(console or Console(), ConversionReport("convert"))
    with (
        claimed(request.outputs(), request.inputs(), request.overwrite),
        checkpoint_folder(request.checkpoint),
        open_field(run, request) as field,
    ):
        early = _early_writer(run, request)
        report = _write(run, request, run_conversion(run, request, field, finished, start, early), early is not None)
        if request.checkpoint is not None and not report.interrupted:
            Checkpoint(Path(request.checkpoint)).finish()
        return report


def convert_in_memory(
    request: ConvertRequest, console: Console | None = None, start: WarmStart | None = None,
    unscored: Callable[[Conversion], None] | None = None,
) -> Conversion:  # fmt: skip
    """Convert a volume without writing anything; arguments as of `run_conversion`, errors as of `convert`."""
    run = Run(console or Console(), ConversionReport("convert"))
    with ExitStack() as stack:
        field = stack.enter_context(open_field(run, request))
        conversion = run_conversion(run, request, field, start=start, unscored=unscored)
        weakref.finalize(conversion, stack.pop_all().close)  # the conversion draws the field's blocks
    run.finish()
    return conversion


def initialise_only(request: ConvertRequest, console: Console | None = None) -> ConversionReport:
    """Convert a volume to a file by the closed form alone, without rendering; errors are those of `convert`."""
    run = Run(console or Console(), ConversionReport("init"))
    with claimed(request.outputs(), request.inputs(), request.overwrite), open_field(run, request, INIT) as field:
        work = Work(run, field, request.fit, degree=degree_of(request, field.source))
        ClosedFormStage().run(work)
        return _write(run, request, _conversion(request, work, as_stored(work.current())))


def plan_conversion(request: ConvertRequest, console: Console | None = None) -> Plan:
    """Return the plan of `convert`, after reading the volume and timing a small view; errors are those of `convert`."""
    run = Run(console or Console(), ConversionReport("convert"))
    check_outputs(request.outputs(), request.inputs(), request.overwrite)
    if by_regions(request) and (request.blocks or automatic(request.source, run.console)) is not None:
        raise UsageError(
            f"--dry-run with more than {MANY:,} Gaussians in blocks: each region is refined by itself, without a plan; "
            "remove --dry-run, or lower --max-gaussians"
        )
    with open_field(run, replace(request, output=None)) as field:
        work, _, plan = _planned(run, request, field)
        report_target(run, work.fit, request.megabytes)
        return plan


def fit_gaussians(run: Run, request: ConvertRequest) -> Gaussians:
    """Return a conversion's Gaussians, box frame, neither scored nor written; errors are those of `convert`."""
    with open_field(run, request) as field:
        work, planner, plan = _planned(run, request, field)
        check_memory(plan)
        _fit(work, request, planner, plan)
        return work.current()


def run_conversion(
    run: Run, request: ConvertRequest, field: Field, finished: Gaussians | None = None,
    start: WarmStart | None = None, unscored: Callable[[Conversion], None] | None = None,
) -> Conversion:  # fmt: skip
    """Convert a field: closed form, refinement as planned (`vvgt_cli.conversion.plan`), scores on the test views.

    Only checkpoints are written, and the run's report stays open.

    Args:
        run: times the stages.
        request: the request.
        field: the volume under its look.
        finished: finished Gaussians, box frame, that only need scores.
        start: warm start that is tried before the closed form.
        unscored: called with the conversion before it has scores and a certificate.

    Raises:
        DataError, UsageError: see `convert`.
    """
    if request.live:
        check_live(request)
        return convert_live(run, request, field, ply_options(request, field.source), unscored=unscored)
    regions = finished is None and start is None and isinstance(field, Blocked) and by_regions(request)
    if start is not None:
        field.renderer = start.renderer(field.views)
    work, planner, plan = _planned(run, request, field, expected=start is None and not regions)
    report_target(run, work.fit, request.megabytes)
    if finished is not None or regions:
        finish = planner.finish(work.limits.time_budget is None) if regions else []
        plan = plan.for_finished(plan.gaussians if finished is None else len(finished), planner.sh_degree, finish)
        run.report.plan = plan.record()
    check_memory(plan, *(() if start is None else start.memory(plan, work.fit)))
    if regions and isinstance(field, Blocked):
        from vvgt_cli.conversion.shards.run import gaussians_by_regions

        finished = gaussians_by_regions(run, request, field)
        field.views.expect(_pictures(plan, work.fit))
    work.checkpoint = checkpoint_of(request.checkpoint, work.field, work.fit, request.limits)
    kept = work.checkpoint.load(FITTED)
    if finished is not None:
        work.gaussians = as_stored(finished)
        improve(work, plan)
        work.gaussians = as_stored(work.current())
    elif kept:
        work.gaussians = kept[0]
        run.console.message(f"{request.checkpoint} holds the fitted Gaussians: only scoring remains")
    elif start is None or not start.try_start(work, plan, request):
        if start is not None:
            field.views.expect(_pictures(plan, work.fit))
        whole, plan = plan, _fit(work, request, planner, plan)
        if start is not None:
            start.keep(work, whole)
    conversion = _conversion(request, work, work.current())
    if unscored is not None:
        unscored(conversion)
    for stage in plan.stages:
        if stage.scores:
            stage.run(work)
    conversion.ply = with_certificate(conversion.ply, run, work.field, work.fit, conversion.gaussians, request.command)
    return conversion


def _pictures(plan: Plan, fit: FitOptions) -> list[Picture]:
    """List the pictures that the stages of a plan will request."""
    return [view for stage in plan.stages for view in stage.views(fit)]


def _planned(run: Run, request: ConvertRequest, field: Field, expected: bool = True) -> tuple[Work, Planner, Plan]:
    """Return work, planner and plan before the first stage; ``expected`` announces the plan's pictures to the field."""
    fit = replace(request.fit, max_gaussians=request.budget())
    if fit.model is not None:
        read_card(find_model(fit.model))  # fails before the work, not after
    degree = degree_of(request, field.source)
    fit = replace(fit, max_gaussians=min(fit.max_gaussians, request.budget(degree)))
    workload = replace(field.workload(fit.size, fit.max_gaussians), degree=degree)
    guess = expected_wide(fit.max_gaussians, fit.size)
    planner = Planner(
        request.limits, fit, sh_degree=request.ply.sh_degree or degree, wide=guess, whole=request.scored_whole,
        writes=request.writes, axes=headset_axes(field.source.volume, ply_options(request, field.source).up),
    )  # fmt: skip
    plan = planner.plan(workload, run.elapsed())
    run.report.plan = plan.record()
    if expected:
        field.views.expect(_pictures(plan, fit))
    return Work(run, field, fit, request.limits, degree), planner, plan


def _fit(work: Work, request: ConvertRequest, planner: Planner, plan: Plan) -> Plan:
    """Run the closed form and the stages that improve it; return the plan, revised by the closed form's time."""
    first = plan.stages[0]
    first.run(work)
    degree = work.current().degree if request.ply.sh_degree is None else request.ply.sh_degree
    if request.output is not None and request.output != STDOUT:
        check_disk_space(request.output, 2 * file_bytes(len(work.current()), degree))  # with its certificate again
    # the mean of its pace and that of drawing, since steps follow neither alone on every machine
    pace = max(work.run.report.stages[-1].seconds / first.cost(plan.workload).seconds, QUICKEST) ** 0.5
    planner = replace(planner, wide=suits_small_views(work.current(), work.fit.size), sh_degree=degree)
    workload = replace(plan.workload.at(pace), gaussians=len(work.current()), degree=work.current().degree)
    plan = planner.plan(workload, work.run.elapsed(), begun=True)
    check_memory(plan)
    improve(work, plan)
    work.gaussians = as_stored(work.current())  # what is scored is what the file holds
    if not work.run.report.interrupted:
        work.checkpoint.save(FITTED, work.gaussians)
    return plan


def improve(work: Work, plan: Plan) -> None:
    """Run the planned stages before the scores, until a target is reached; errors are those of the stages."""
    ahead = [stage for stage in plan.stages if not stage.scores]
    listed = improved = False
    for n, stage in enumerate([*ahead, None]):
        if not (stage is None and improved) and work.target_reached():
            for name in (other.name for other in ahead[n:] if other.improves):
                work.run.skip(name, f"the check views have {work.limits.target_psnr:g} dB without it")
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


def _conversion(request: ConvertRequest, work: Work, gaussians: Gaussians) -> Conversion:
    """Return a conversion without scores."""
    source = work.field.source
    return Conversion(
        to_unit_frame(gaussians, source.volume), work.run.report, ply_options(request, source), work.field,
    )  # fmt: skip


@contextmanager
def open_field(run: Run, request: ConvertRequest, kernels: tuple[str, ...] = CONVERT) -> Iterator[Field]:
    """Open a request's volume under its look, in memory or in blocks, and compile ``kernels``.

    Blocks are stored beside the output until it is written: after an interruption the same command reuses them.

    Raises:
        DataError, UsageError: see `vvgt_cli.field.source.load`.
    """
    if request.fit.device != "cpu":
        load_ahead()
    options = request.blocks or automatic(request.source, run.console)
    if options is None:
        with run.stage("read") as stage:
            source = load(request.source)
            stage.note = describe_source(source)
        _report_source(run, request, source)
        run.compile(_kernels(kernels, request, source), source.kernel_type())
        with run.stage("scene"):
            field = Resident.of(source, request.fit.device, run.console.message)
        yield field
        return
    needs = FieldNeeds(request.budget(), request.fit.size, request.ply.sh_degree, by_regions(request), request.live)
    with store_beside(request.output) as store, blocked(run, request.source, options, store, needs) as found:
        _report_source(run, request, found.source)
        run.compile(for_blocks(_kernels(kernels, request, found.source)), found.source.kernel_type())
        yield found
        store.remove()


def by_regions(request: ConvertRequest) -> bool:
    """Return whether a request in blocks is for so many Gaussians that they are refined region by region."""
    fit = request.fit
    other = fit.init != "vbm" or fit.model or fit.device != "cpu" or request.live or request.checkpoint
    return request.budget() > MANY and fit.steps != 0 and not other


def _report_source(run: Run, request: ConvertRequest, source: Source) -> None:
    """Report what was read."""
    ply = ply_options(request, source)
    flattened = harmonics_warning(degree_of(request, source), source)
    for warning in [*placement_warnings(source.volume, ply), *([flattened] if flattened else [])]:
        run.console.message(warning)
    plain = request.source.tf is None and not source.gridded and source.volume.data.nbytes < MIN_BLOCKED
    if plain and (name := fitting(source.overall, source.volume)) and name not in source.layers[0].tf.name:
        run.console.message(f"{source.volume.name}: no look is given; --tf {name} is made for such data, try it")
    run.report.volume = volume_record(source)
    run.report.transfer_function = tf_record(source, request.source)
    fit = request.fit
    run.report.options = asdict(fit) | asdict(request.limits) | {
        "max_megabytes": request.megabytes, "frame": ply.frame, "up": ply.up, "sh_degree": ply.sh_degree,
    }  # fmt: skip


def _kernels(names: tuple[str, ...], request: ConvertRequest, source: Source) -> tuple[str, ...]:
    """Return the kernels that a source needs of ``names``."""
    names += LIVE if request.live else ()
    return for_degree(source.kernels(names), degree_of(request, source))


def _early_writer(run: Run, request: ConvertRequest) -> Callable[[Conversion], None] | None:
    """Return a function that writes the file before its scores are known; None where it is written once."""
    if request.writes < 2:
        return None

    def write(conversion: Conversion) -> None:
        _write_file(run, request, conversion, more="; complete; scoring next")

    return write


def _write_file(run: Run, request: ConvertRequest, conversion: Conversion, again: bool = False, more: str = "") -> None:
    """Write the file, a page with all its contents, or ``again`` with its certificate; ``more`` ends the message."""
    assert request.output is not None
    page = is_page(request.output) and request.ply.comments
    limit = None if request.megabytes is None else 1e6 * request.megabytes
    values = conversion.values(run, limit) if page and request.values else None
    write_gaussians(
        run, request.output, conversion.gaussians, conversion.ply, request.overwrite or again, conversion.normals(),
        "certificate" if again else "write", more, values,
    )  # fmt: skip


def _write(run: Run, request: ConvertRequest, conversion: Conversion, written: bool = False) -> ConversionReport:
    """Write the file, the preview and the report; where the file is ``written``, only its certificate is missing."""
    from vvgt_cli.images import write_png

    report = run.report
    assert request.output is not None
    if conversion.ply.certificate is not None or not written:
        _write_file(run, request, conversion, again=written)
    if format_of(request.output):
        source = conversion.field.source
        run.compile(source.kernels(EVALUATE), source.kernel_type())
        report_format_cost(
            run, request.output, conversion.gaussians, conversion.ply, conversion.field.views, source.volume
        )
    if request.preview:
        with run.stage("preview"):
            write_png(request.preview, conversion.preview(), request.overwrite)
    run.finish()
    if request.report:
        write_text(request.report, report.to_json(), request.overwrite)
    return report
