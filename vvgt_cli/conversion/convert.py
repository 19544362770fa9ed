"""`convert` and `init`: volume and transfer function in, `.ply` out, stage by stage."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path

from vvgt_cli.conversion.carried import Carry
from vvgt_cli.conversion.certify import certified
from vvgt_cli.conversion.gaussian_files import write_gaussians
from vvgt_cli.conversion.live import check_live, live_conversion
from vvgt_cli.conversion.onward import Onward
from vvgt_cli.conversion.place import out_of_box, placed, remarks, way_up
from vvgt_cli.conversion.plan import Plan, Planner, check_memory
from vvgt_cli.conversion.readback import tell_cost
from vvgt_cli.conversion.request import ConvertRequest, FitOptions, file_bytes
from vvgt_cli.conversion.result import Conversion
from vvgt_cli.conversion.resume import FITTED, Checkpoint, checkpoint_folder, checkpoint_of
from vvgt_cli.conversion.stage import Work
from vvgt_cli.conversion.stages import CheckViews, ClosedFormStage
from vvgt_cli.conversion.stages.views import wide
from vvgt_cli.errors import UsageError
from vvgt_cli.field.field import Field, Picture, Resident
from vvgt_cli.field.open import Wanted, automatic, beside, blocked
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
    request: ConvertRequest, console: Console | None = None, made: Gaussians | None = None, carry: Carry | None = None
) -> ConversionReport:
    """Volume to `.ply`: `run_conversion`, and its outputs written.

    Raises:
        UsageError: an output that may not be written; found before anything is read.
        DataError: input that is not what it must be, or a scene that shows nothing.
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
        report = _write(run, request, run_conversion(run, request, field, made, carry, early), early is not None)
        if request.checkpoint is not None and not _interrupted(run):
            Checkpoint(Path(request.checkpoint)).finish()
        return report


def without_files(
    request: ConvertRequest, console: Console | None = None, onward: Onward | None = None,
    unscored: Callable[[Conversion], None] | None = None,
) -> Conversion:  # fmt: skip
    """A conversion of which nothing is written; ``unscored`` as of `run_conversion`.

    Raises:
        DataError, UsageError: as `convert`.
    """
    run = Run(console or Console(), ConversionReport("convert"))
    with ExitStack() as stack:
        field = stack.enter_context(opened(run, request))
        conversion = run_conversion(run, request, field, carry=onward, unscored=unscored)
        weakref.finalize(conversion, stack.pop_all().close)  # what it draws is there as long as it is
    run.finish()
    return conversion


def initialise_only(request: ConvertRequest, console: Console | None = None) -> ConversionReport:
    """Volume to `.ply` by the closed form alone: no image is rendered.

    Raises:
        UsageError, DataError: as `convert`.
    """
    run = Run(console or Console(), ConversionReport("init"))
    with claimed(request.outputs(), request.inputs(), request.overwrite), opened(run, request) as field:
        work = Work(run, field, request.fit, degree=degree_of(request, field.source))
        ClosedFormStage().run(work)
        return _write(run, request, _conversion(request, work, as_stored(work.made())))


def planned(request: ConvertRequest, console: Console | None = None) -> Plan:
    """What `convert` would do: the volume is read and laid out, a small view is timed, nothing is written.

    Raises:
        DataError, UsageError: as `convert`.
    """
    run = Run(console or Console(), ConversionReport("convert"))
    check_outputs(request.outputs(), request.inputs(), request.overwrite)
    with opened(run, replace(request, output=None)) as field:
        return _planned(run, request, field)[-1]


def fitted(run: Run, request: ConvertRequest) -> Gaussians:
    """The Gaussians of a conversion, box frame, not scored and not written.

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
    carry: Carry | Onward | None = None, unscored: Callable[[Conversion], None] | None = None,
) -> Conversion:  # fmt: skip
    """Closed form, what views can improve of it, scores on the test views; only checkpoints are written.

    What of these is done, and with how many Gaussians, follows from the request's limits and what the stages cost
    (`vvgt_cli.conversion.plan`); the check views decide. What is left out is said, and costs nothing. Of Gaussians that
    are ``made`` already, box frame, there are scores alone. With a ``carry``, it goes on from the frame before where
    that is as near. ``unscored`` is handed the conversion before there are scores, and so without a certificate.

    Returns:
        The same conversion; the run's report is still open.

    Raises:
        DataError, UsageError: as `convert`.
    """
    if request.live:
        check_live(request)
        return live_conversion(run, request, field, ply_options(request, field.source), unscored=unscored)
    if carry is not None:
        field = carry.remembered(field)
    work, planner, plan = _planned(run, request, field, expected=carry is None)
    if made is not None:
        plan.stages, plan.left_out = [stage for stage in plan.stages if stage.scores], []
        plan.gaussians, plan.case = len(made), replace(plan.case, gaussians=len(made))
        plan.bytes = file_bytes(len(made), planner.sh_degree)
        run.report.plan = plan.record()
    check_memory(plan, *(carry.beside(plan, work.fit) if isinstance(carry, Carry) else ()))
    work.checkpoint = checkpoint_of(request.checkpoint, work.field, work.fit, request.limits)
    kept = work.checkpoint.load(FITTED)
    if made is not None:
        work.gaussians = as_stored(made)
    elif kept:
        work.gaussians = kept[0]
        run.console.say(f"{request.checkpoint} holds the fitted Gaussians: only the scores are left")
    elif carry is None or not carry.goes_on(work, plan, request):
        if carry is not None:
            field.expect(_pictures(plan, work.fit))
        whole, plan = plan, _fit(work, request, planner, plan)
        if carry is not None:
            carry.keep(work, whole)
    conversion = _conversion(request, work, work.made())
    if unscored is not None:
        unscored(conversion)
    for stage in plan.stages:
        if stage.scores:
            stage.run(work)
    conversion.ply = certified(conversion.ply, run, work.field, work.fit, conversion.gaussians, request.command)
    return conversion


def _pictures(plan: Plan, fit: FitOptions) -> list[Picture]:
    """That its stages will ask for."""
    return [view for stage in plan.stages for view in stage.views(fit)]


def _planned(run: Run, request: ConvertRequest, field: Field, expected: bool = True) -> tuple[Work, Planner, Plan]:
    """All that comes before the first stage; the pictures that it needs are ``expected``."""
    fit = replace(request.fit, max_gaussians=request.budget())
    if fit.model is not None:
        read_card(find_model(fit.model))  # fails before the work, not after
    degree = degree_of(request, field.source)
    fit = replace(fit, max_gaussians=request.limits.gaussians(fit.max_gaussians, degree))
    case = replace(field.case(fit.size, fit.max_gaussians), degree=degree)
    guess = expected_wide(fit.max_gaussians, fit.size)
    planner = Planner(
        request.limits, fit.max_gaussians, fit.steps, request.ply.sh_degree or degree, fit.size, guess, fit.model,
        request.scored_whole, fit.init == "vbm", fit.init == "vbm", request.writes,
    )  # fmt: skip
    plan = planner.plan(case, run.elapsed())
    run.report.plan = plan.record()
    if expected:
        field.expect(_pictures(plan, fit))
    return Work(run, field, fit, request.limits, degree), planner, plan


def _fit(work: Work, request: ConvertRequest, planner: Planner, plan: Plan) -> Plan:
    """The closed form, and what views improve; returns the plan, made anew by what the closed form took and showed."""
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
    if not _interrupted(work.run):
        work.checkpoint.save(FITTED, work.gaussians)
    return plan


def improve(work: Work, plan: Plan) -> None:
    """The stages that views pay for; from where a target is reached on, none.

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
    """The fewest Gaussians that reach the target: a part of the budget, or all."""
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


def _interrupted(run: Run) -> bool:
    """Whether Ctrl-C ended gradient descent: the same command then goes on with it."""
    return run.report.refinement is not None and run.report.refinement["reason"] == "interrupted"


def _conversion(request: ConvertRequest, work: Work, gaussians: Gaussians) -> Conversion:
    """Not scored."""
    source = work.field.source
    return Conversion(out_of_box(gaussians, source.volume), work.run.report, ply_options(request, source), work.field)


@contextmanager
def opened(run: Run, request: ConvertRequest) -> Iterator[Field]:
    """The volume of a request under all that it is shown by, in memory or in blocks; kernels are compiled.

    Blocks lie beside the output until it is written: the same command goes on with those that an ended one has left.

    Raises:
        DataError, UsageError: as `vvgt_cli.field.source.load`.
    """
    options = request.blocks or automatic(request.source, run.console)
    if options is None:
        with run.stage("read") as stage:
            source = load(request.source)
            stage.note = describe_source(source)
        _tell(run, request, source)
        run.compile(_kernels(run, request, source), source.kernel_type())
        with run.stage("scene"):
            field = Resident(source, source.scene())
        yield field
        return
    wanted = Wanted(request.budget(), request.fit.size, request.ply.sh_degree, values=request.live)
    with beside(request.output) as parts, blocked(run, request.source, options, parts, wanted) as found:
        _tell(run, request, found.source)
        run.compile(for_blocks(_kernels(run, request, found.source)), found.source.kernel_type())
        yield found
        parts.remove()


def _tell(run: Run, request: ConvertRequest, source: Source) -> None:
    """Say and record what was read."""
    ply = ply_options(request, source)
    flattened = _flattened(degree_of(request, source), source)
    for remark in [*remarks(source.volume, ply), *([flattened] if flattened else [])]:
        run.console.say(remark)
    run.report.volume = volume_record(source)
    run.report.transfer_function = tf_record(source, request.source)
    run.report.options = asdict(request.fit) | asdict(request.limits) | {
        "frame": ply.frame, "up": ply.up, "sh_degree": ply.sh_degree,
    }  # fmt: skip


def _kernels(run: Run, request: ConvertRequest, source: Source) -> tuple[str, ...]:
    """That a run will need."""
    names: tuple[str, ...] = CONVERT if run.report.command == "convert" else INIT
    names += LIVE if request.live else ()
    return for_degree(source.kernels(names), degree_of(request, source))


def degree_of(request: ConvertRequest, source: Source) -> int:
    """Of the harmonics that colours get: 0 where the light does not depend on the view, else as asked for, or 2."""
    if source.lighting is None or not source.lighting.depends_on_view:
        return 0
    return VIEW_DEGREE if request.ply.sh_degree is None else request.ply.sh_degree


def _flattened(degree: int, source: Source) -> str | None:
    """What there is to say of a light that the harmonics asked for cannot hold."""
    if degree >= VIEW_DEGREE or source.lighting is None or not source.lighting.depends_on_view:
        return None
    return (
        f"--sh-degree {degree}: what the headlight and highlights show changes with the view; the file has their mean "
        f"over directions (--sh-degree {VIEW_DEGREE} holds them)"
    )


def ply_options(request: ConvertRequest, source: Source) -> PlyOptions:
    """How the file is written, with all that follows from the source."""
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
    """Of one function or one table of labels."""
    if len(source.layers) > 1:
        return None
    labelled, volume = isinstance(source.tf, LabelTable), source.volume
    numbers = None if labelled else source.statistics
    lo, hi = (0.0, 0.0) if numbers is None else (numbers.lo, numbers.hi)
    return legend_text(source.tf, lo, hi, "HU" if volume.hounsfield else "")


def _early(run: Run, request: ConvertRequest) -> Callable[[Conversion], None] | None:
    """What writes the file before its scores are there, where it is written twice."""
    output = request.output
    if output is None or request.writes < 2:
        return None

    def write(found: Conversion) -> None:
        more = "; it is whole, scores follow"
        write_gaussians(run, output, found.gaussians, found.ply, request.overwrite, found.normals(), more=more)

    return write


def _write(run: Run, request: ConvertRequest, conversion: Conversion, written: bool = False) -> ConversionReport:
    """Write the file, the preview and the report; of a file that is ``written`` the certificate is missing."""
    from vvgt_cli.images import write_png

    report = run.report
    assert request.output is not None
    if conversion.ply.certificate is not None or not written:
        file, stage = (request.output, conversion.gaussians, conversion.ply), "certificate" if written else "write"
        write_gaussians(run, *file, request.overwrite or written, conversion.normals(), stage)
    if format_of(request.output):
        source = conversion.field.source
        run.compile(source.kernels(EVALUATE), source.kernel_type())
        tell_cost(run, request.output, conversion.gaussians, conversion.ply, conversion.field, source.volume)
    if request.preview:
        with run.stage("preview"):
            write_png(request.preview, conversion.preview(), request.overwrite)
    run.finish()
    if request.report:
        write_text(request.report, report.to_json(), request.overwrite)
    return report
