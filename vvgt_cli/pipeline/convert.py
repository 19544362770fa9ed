"""`convert` and `init`: volume and transfer function in, `.ply` out, stage by stage."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import check_room
from vvgt_cli.gaussians import Gaussians, PlyOptions, as_stored
from vvgt_cli.jit.ahead import CONVERT, INIT
from vvgt_cli.network.card import find_model, read_card
from vvgt_cli.pipeline.mend import check_view_memory, mend, wide
from vvgt_cli.pipeline.outputs import STDOUT, Output, claimed, write_text
from vvgt_cli.pipeline.place import AUTO, out_of_box, placed, remarks, way_up
from vvgt_cli.pipeline.plan import Costs, Limits, Plan, Planner, check_plan_memory, estimate, file_bytes, view_edge
from vvgt_cli.pipeline.record import ConversionReport, Run
from vvgt_cli.pipeline.render import write_gaussians
from vvgt_cli.pipeline.result import PREVIEW_VIEWS, Conversion
from vvgt_cli.pipeline.resume import CLOSED_FORM, FITTED, Stages, checkpoint_folder, stages_of
from vvgt_cli.pipeline.score import psnr_note, score_test_views
from vvgt_cli.pipeline.seats import SIDE, from_above, score_seats
from vvgt_cli.pipeline.source import Source, SourceRequest, load
from vvgt_cli.progress import Console

if TYPE_CHECKING:
    from vvgt_cli.dvr import Scene
    from vvgt_cli.vbm import Start

QUICKEST = 0.5  # of the estimate, where the closed form took less: the rest then takes less too
FAINT = 0.02  # opacity
FEWEST = 5000  # Gaussians that a fog keeps


@dataclass(frozen=True)
class FitOptions:
    """What the Gaussians are made for.

    Attributes:
        max_gaussians: budget K.
        size: pixels along an image's edge that the file is made for.
        init: "vbm", "wavelet" or "uniform".
        rule: of `vvgt_cli.splat.rules` that is fitted to and scored by.
        seed: of whatever draws random numbers.
        model: network that runs before the steps: a folder or the name of a shipped one, None for none.
        steps: of gradient descent after the closed form, at most; None: what the plan finds worth its time.
    """

    max_gaussians: int = 100_000
    size: int = 1080
    init: str = "vbm"
    rule: str = "inria"
    seed: int = 0
    steps: int | None = None
    model: str | None = None


@dataclass(frozen=True)
class ConvertRequest:
    """A whole conversion.

    Attributes:
        source: what to read.
        output: `.ply` to write, "-" for standard output, None for none.
        fit: what the Gaussians are made for.
        limits: error, time and size that decide what is done.
        dry_run: plan, and write nothing.
        ply: how the file is written; up, the volume's place and the distance are filled in from the source.
        up: world axis or anatomical direction that viewers show upwards, "none", or "auto" (`place.way_up`).
        report: JSON to write, "-" for standard output, None for none.
        preview: PNG to write (reference, ours, difference of a few test views), None for none.
        overwrite: replace files that exist.
        all_views: score on all ten test views, by SSIM and FLIP too, as a report has it.
        checkpoint: folder that keeps what the stages make, until the output is written; None for none.
    """

    source: SourceRequest
    output: str | None = None
    fit: FitOptions = field(default_factory=FitOptions)
    limits: Limits = field(default_factory=Limits)
    dry_run: bool = False
    ply: PlyOptions = field(default_factory=PlyOptions)
    up: str = AUTO
    report: str | None = None
    preview: str | None = None
    overwrite: bool = False
    checkpoint: str | None = None
    all_views: bool = False

    def budget(self) -> int:
        """Gaussians that fit.

        Raises:
            UsageError: not one does.
        """
        return self.limits.gaussians(self.fit.max_gaussians, self.ply.sh_degree)

    @property
    def scored_whole(self) -> bool:
        """Whether on all ten test views."""
        return self.all_views or self.report is not None

    def outputs(self) -> list[Output]:
        """Everything that will be written."""
        outputs = [Output("-o", self.output, (".ply",))] if self.output else []
        if self.report:
            outputs.append(Output("--report", self.report, (".json",), binary=False))
        if self.preview:
            outputs.append(Output("--preview", self.preview, (".png",)))
        return outputs

    def inputs(self) -> list[str]:
        """Files that are read."""
        return self.source.paths()


def convert(request: ConvertRequest, console: Console | None = None) -> ConversionReport:
    """Volume to `.ply`: `made`, and its outputs written.

    Raises:
        UsageError: an output that may not be written; found before anything is read.
        DataError: input that is not what it must be, or a scene that shows nothing.
    """
    request.budget()
    if request.checkpoint is not None and request.limits.time_budget is not None:
        raise UsageError("--checkpoint is of runs that repeat to the byte, --time-budget of others; give one of both")
    run = Run(console or Console(), ConversionReport("convert"))
    with claimed(request.outputs(), request.inputs(), request.overwrite), checkpoint_folder(request.checkpoint):
        conversion = made(run, request)
        if conversion is None:
            return run.finish()
        report = _write(run, request, conversion)
        if request.checkpoint is not None and not _interrupted(run):
            Stages(Path(request.checkpoint)).finish()
        return report


def in_memory(
    source: SourceRequest, fit: FitOptions, limits: Limits, all_views: bool = False, console: Console | None = None
) -> Conversion:
    """A conversion of which nothing is written.

    Raises:
        DataError, UsageError: as `convert`.
    """
    run = Run(console or Console(), ConversionReport("convert"))
    conversion = made(run, ConvertRequest(source, None, fit, limits, all_views=all_views))
    assert conversion is not None  # None is of dry runs
    run.finish()
    return conversion


def initialise_only(request: ConvertRequest, console: Console | None = None) -> ConversionReport:
    """Volume to `.ply` by the closed form alone: no image is rendered.

    Raises:
        UsageError, DataError: as `convert`.
    """
    run = Run(console or Console(), ConversionReport("init"))
    with claimed(request.outputs(), request.inputs(), request.overwrite):
        source, scene = _begin(run, request)
        start = _closed_form(run, scene, request.fit)
        return _write(run, request, _conversion(run, request, source, scene, as_stored(start.gaussians)))


def made(run: Run, request: ConvertRequest) -> Conversion | None:
    """Closed form, what views can mend of it, gradient descent; scored on the test views; only checkpoints are written.

    What of these is done, and with how many Gaussians, follows from the request's limits and what the stages cost
    (`pipeline.plan`); the check views decide. What is left out is said, and costs nothing.

    Returns:
        The conversion; None of a dry run, whose plan the run's report holds.

    Raises:
        DataError, UsageError: as `convert`.
    """
    fit = replace(request.fit, max_gaussians=request.budget())
    if fit.model is not None:
        read_card(find_model(fit.model))  # fails before the work, not after
    source, scene = _begin(run, request)
    costs = estimate(scene, fit.size, fit.max_gaussians, request.scored_whole)
    sparse = fit.max_gaussians <= view_edge(fit.size, half=False) ** 2  # a guess, until the Gaussians are there
    planner = Planner(request.limits, fit.max_gaussians, fit.steps, request.ply.sh_degree, fit.size, sparse, fit.model)
    plan = planner.plan(costs, run.elapsed())
    run.report.plan = plan.record()
    check_view_memory(plan, fit.size)
    if request.dry_run:
        return None
    check_plan_memory(plan, costs, scene, fit.size)
    stages = stages_of(request, source, fit)
    kept = stages.load(FITTED)
    gaussians = kept[0] if kept else _fitted(run, request, scene, fit, planner, plan, costs, stages)
    if kept:
        run.console.say(f"{request.checkpoint} holds the fitted Gaussians: only the scores are left")
    _score(run, request, scene, gaussians)
    return _conversion(run, request, source, scene, gaussians)


def _fitted(
    run: Run,
    request: ConvertRequest,
    scene: Scene,
    fit: FitOptions,
    planner: Planner,
    plan: Plan,
    costs: Costs,
    stages: Stages,
) -> Gaussians:
    """Closed form, and what views can mend of it; as the file will hold it."""
    anew = plan.back_project or request.limits.target_psnr is not None  # cells are cut once more
    start = _closed_form(run, scene, fit, Stages() if anew else stages)
    if request.output not in (None, STDOUT):
        check_room(request.output, file_bytes(len(start.gaussians), request.ply.sh_degree))
    planner = replace(planner, wide=wide(start.gaussians, fit.size))
    plan = planner.plan(
        costs.at(max(run.report.stages[-1].seconds / costs.closed_form, QUICKEST)), run.elapsed(), begun=True
    )
    check_view_memory(plan, fit.size)
    gaussians = as_stored(mend(run, scene, start, plan, request.limits, fit, stages.descent))
    if not _interrupted(run):
        stages.save(FITTED, gaussians)
    return gaussians


def _interrupted(run: Run) -> bool:
    """Whether Ctrl-C ended gradient descent: the same command then goes on with it."""
    return run.report.refinement is not None and run.report.refinement["reason"] == "interrupted"


def _conversion(run: Run, request: ConvertRequest, source: Source, scene: Scene, gaussians: Gaussians) -> Conversion:
    return Conversion(out_of_box(gaussians, source.volume), run.report, _ply(request, source), source, scene)


def _begin(run: Run, request: ConvertRequest) -> tuple[Source, Scene]:
    """Read, and lay the volume out for the kernels."""
    with run.stage("read") as stage:
        source = load(request.source)
        stage.note = describe_source(source)
        ply = _ply(request, source)
    for remark in remarks(source.volume, ply):
        run.console.say(remark)
    run.compile(CONVERT if run.report.command == "convert" else INIT, source.kernel_type())
    with run.stage("scene"):
        scene = source.scene()
    run.report.volume = volume_record(source)
    run.report.transfer_function = tf_record(source, request.source)
    run.report.options = asdict(request.fit) | asdict(request.limits) | {
        "frame": ply.frame, "up": ply.up, "sh_degree": ply.sh_degree,
    }  # fmt: skip
    return source, scene


def _ply(request: ConvertRequest, source: Source) -> PlyOptions:
    """How the file is written, with all that follows from the source."""
    ply = replace(
        request.ply,
        up=way_up(request.up, request.ply.frame, source.volume.space),
        unit_distance=source.unit_distance,
        unit_distance_label=source.unit_label,
        made_for=request.fit.size,
        rule=request.fit.rule,
    )
    return placed(ply, source.volume)


def describe_source(source: Source) -> str:
    """One line: grid, type, values, function, unit distance."""
    volume, numbers = source.volume, source.statistics
    grid = " x ".join(map(str, volume.dims))
    holes = [f"{n} {what} (transparent)" for n, what in ((numbers.nan_count, "NaN"), (numbers.inf_count, "inf")) if n]
    values = ", ".join([f"values {numbers.lo:g} to {numbers.hi:g}", *holes])
    distance = f"opacity per {source.unit_distance:g} ({source.unit_label})"
    return f"{volume.name}: {grid} {volume.data.dtype.name}, {values}; {source.tf.name}: {distance}"


def volume_record(source: Source) -> dict[str, Any]:
    """The volume as reports show it."""
    volume, numbers = source.volume, source.statistics
    return {
        "name": volume.name,
        "dims": volume.dims,
        "dtype": volume.data.dtype.name,
        "spacing": volume.spacing,
        "space": volume.space or "none",
        "range": (numbers.lo, numbers.hi),
        "nan": numbers.nan_count,
        "inf": numbers.inf_count,
    }


def tf_record(source: Source, request: SourceRequest) -> dict[str, Any]:
    """The transfer function as reports show it."""
    return {
        "name": source.tf.name,
        "given": request.tf is not None,
        "tf_range": request.tf_range,
        "nodes": source.tf.node_range(),
        "unit_distance": source.unit_distance,
        "unit_distance_label": source.unit_label,
    }


def _closed_form(run: Run, scene: Scene, fit: FitOptions, stages: Stages | None = None) -> Start:
    """The closed form, or what is kept of it: without the pyramid, which views cut anew for a target or no steps."""
    from vvgt_cli.vbm import Start, VbmOptions, initialise
    from vvgt_cli.vbm.closed_form import bound

    stages = stages or Stages()
    if kept := stages.load(CLOSED_FORM):
        with run.stage("closed form") as stage:
            stage.note = f"{len(kept[0])} Gaussians, as kept in {stages.folder}"
        return Start(kept[0], None)
    options = VbmOptions(max_gaussians=fit.max_gaussians, size=fit.size, method=fit.init, seed=fit.seed)
    with run.stage("closed form") as stage:
        start = initialise(scene, options, progress=run.console.bar("closed form"))
        if not len(start.gaussians):
            raise DataError(
                f"{scene.volume.name} under {scene.tf.name}: nothing visible from any view; "
                "expected opacity above 0 where the data are (try 'vvgt tf show TF -o tf.png --volume VOLUME')"
            )
        found = len(start.gaussians)
        start, spared = thinned(start)
        stage.note = f"{len(start.gaussians)} Gaussians ({fit.init})"
        if start.form is not None and not spared and found < fit.max_gaussians:
            stage.note += f", no more: {bound(start.form)}"
    if spared:
        run.leave_out(f"{spared} Gaussians", "so faint that viewers differ on what they draw of them")
    stages.save(CLOSED_FORM, start.gaussians)
    return start


def thinned(start: Start) -> tuple[Start, int]:
    """Half the budget, again and again, while the median opacity is below `FAINT`; and how many Gaussians that spares.

    Programs leave out what is below 1/255, 1/510 or 1/100 in a pixel: of a fog of faint splats each shows another part.
    """
    before = len(start.gaussians)
    while start.form is not None and start.form.budget >= 2 * FEWEST:
        if np.median(start.gaussians.opacity_logits) >= math.log(FAINT / (1 - FAINT)):
            break
        form = replace(start.form, budget=start.form.budget // 2)
        start = replace(start, form=form, gaussians=form.gaussians())
    return start, before - len(start.gaussians)


def _score(run: Run, request: ConvertRequest, scene: Scene, gaussians: Gaussians) -> None:
    """Scores on the test views, and from the seats."""
    from vvgt_cli.dvr import RenderSettings

    fit, whole = request.fit, request.scored_whole
    with run.stage("test views") as stage:
        scores = score_test_views(
            scene,
            gaussians,
            fit.size,
            RenderSettings(),
            rule=fit.rule,
            perceptual=whole,
            only=None if whole else PREVIEW_VIEWS,
            progress=run.console.bar("test views"),
        )
        run.report.scores = asdict(scores)
        stage.note = f"{psnr_note(scores)}, {scores.views} views of {fit.size} px"
    budget = request.limits.time_budget
    if budget is not None and run.elapsed() > budget:
        run.leave_out("seats", "time is up")
        return
    with run.stage("seats") as stage:
        seats = score_seats(scene, gaussians, from_above(fit.size), views=SIDE)
        run.report.seats = [asdict(seat) for seat in seats]
        stage.note = f"worst of {len(seats)}: {seats[0].name()}, {seats[0].psnr:.2f} dB"


def _write(run: Run, request: ConvertRequest, conversion: Conversion) -> ConversionReport:
    """Write the file, the preview and the report."""
    from vvgt_cli.images import write_png

    report = run.report
    assert request.output is not None
    write_gaussians(run, request.output, conversion.gaussians, conversion.ply, request.overwrite)
    if request.preview:
        with run.stage("preview"):
            write_png(request.preview, conversion.preview(), request.overwrite)
    run.finish()
    if request.report:
        write_text(request.report, report.to_json(), request.overwrite)
    return report
