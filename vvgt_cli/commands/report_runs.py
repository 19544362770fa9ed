"""`report`: runs on one scene as JSON, CSV, plots and a page; or several reports compared."""

from __future__ import annotations

import io
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.cameras.blocks import Blocks, spread_blocks
from vvgt_cli.cameras.boxed import render_in_box
from vvgt_cli.commands.peers import Peer, PeerViews, train
from vvgt_cli.conversion.convert import convert
from vvgt_cli.conversion.live import live_refusal
from vvgt_cli.conversion.opened import open_field
from vvgt_cli.conversion.request import ConvertRequest, FitOptions
from vvgt_cli.conversion.stages.refinement import refine
from vvgt_cli.conversion.stages.views import CheckViews, TrainingViews, view_count
from vvgt_cli.defaults import MAX_GAUSSIANS, REPORT_STEPS, SIZE
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.field import Field, Picture, Resident
from vvgt_cli.field.settings import BlockOptions
from vvgt_cli.field.source import SourceRequest, tf_record, volume_record
from vvgt_cli.field.workload import view_edge
from vvgt_cli.gaussians import Gaussians, as_stored, read_ply, write_ply
from vvgt_cli.gaussians.frames import transform
from vvgt_cli.gaussians.outputs import STDOUT, Output, check_outputs, write_text
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.images import png_bytes
from vvgt_cli.jit.ahead import INIT
from vvgt_cli.network.card import SHIPPED, find_model
from vvgt_cli.progress import Console
from vvgt_cli.refine import OptimizeOptions
from vvgt_cli.score.charts import FILES, draw, write_plots
from vvgt_cli.score.curves import (
    ReportRuns,
    cost,
    knee,
    pareto,
    psnr,
    read_series,
    short,
    table,
    unit_costs,
    worst_condition,
)
from vvgt_cli.score.page import Pictures, page
from vvgt_cli.score.record import ConversionReport, Run, document
from vvgt_cli.score.viewing import SIDE, ConditionView, condition_pictures, condition_views, score_conditions, screens
from vvgt_cli.score.views import WHOLE, Views, render_check_views, score_drawn_view
from vvgt_cli.volume.blocks import check_memory

if TYPE_CHECKING:
    from vvgt_cli.images.metrics import Scores


SHARES = (64, 16, 4)  # of the budget, for the closed form at several K
STARTS = 2  # of the budget, what the baselines begin with: they grow
FAINT = 0.1  # opacity of 3DGS' first points
PICTURED = (0, 4)  # test views on the page: from above, from the side
NEIGHBOURS = 0.72  # mean distance to the three nearest of n random points, over (volume / n)^(1/3)


@dataclass(frozen=True)
class RunOptions:
    """Options of the runs.

    Attributes:
        max_gaussians: largest budget K.
        screen: pixels along the edge of the screen that files are made for and scored on.
        steps: lengths of gradient descent, one run each; the baselines take the longest.
        model: folder or name of an exported network, None for none.
        seed: random seed.
        blocks: how the volume is processed in blocks; None: in memory, or in blocks if it is large.
        live: include the live form (docs/live.md), which not every scene has.
        peers: other trainers, one run each.
    """

    max_gaussians: int = MAX_GAUSSIANS
    screen: int = SIZE
    steps: tuple[int, ...] = REPORT_STEPS
    model: str | None = None
    seed: int = 0
    blocks: BlockOptions | None = None
    live: bool = False
    peers: tuple[Peer, ...] = ()


@dataclass(frozen=True)
class PlannedRun:
    """One run.

    Attributes:
        name: for tables; ``label`` for charts.
        kind: one of `vvgt_cli.score.curves.KINDS`.
        fit: options of the conversion; the other kinds take their sizes from it.
        start: of the baselines: "points" (random in the box) or "samples" (of what the function shows).
        peer: other trainer, of kind "peer".
    """

    name: str
    label: str
    kind: str
    fit: FitOptions
    start: str | None = None
    peer: Peer | None = None


def plan_runs(options: RunOptions) -> list[PlannedRun]:
    """List the runs: other trainers first, as they may fail; then ours from the cheapest on; then the baselines."""
    most, size, seed = options.max_gaussians, options.screen, options.seed
    budgets = sorted({max(most // share, 1) for share in SHARES} | {most})
    runs = [
        PlannedRun(f"closed form, K = {short(k)}", short(k), "closed form", FitOptions(k, size, seed=seed, steps=0))
        for k in budgets
    ]
    if options.live:
        runs.append(PlannedRun(f"live form, K = {short(most)}", "live", "live", FitOptions(most, size, seed=seed)))
    if options.model:
        fit = FitOptions(most, size, seed=seed, steps=0, model=options.model)
        runs.append(PlannedRun(f"network {Path(options.model).name}", "network", "network", fit))
    for steps in sorted(set(options.steps)):
        fit = FitOptions(most, size, seed=seed, steps=steps)
        runs.append(PlannedRun(f"{steps} steps", f"{steps} steps", "steps", fit))
    most_steps = max(options.steps, default=0)
    longest = FitOptions(most, size, seed=seed, steps=most_steps)
    if most_steps:
        for name, start in (("3DGS", "points"), ("iVR-GS setting", "samples")):
            runs.append(PlannedRun(f"{name}, {most_steps} steps", name, "baseline", longest, start))
    return [PlannedRun(peer.name, peer.name, "peer", longest, peer=peer) for peer in options.peers] + runs


@dataclass(frozen=True)
class Reference:
    """Reference that every run is scored against: test views, rendered once and counted in no run's time.

    Attributes:
        cameras: of the views; ``blocks`` of each that are scored, None for the whole view.
        images: (h, w, 4) float32 each; of views that are not in `WHOLE` only the blocks are drawn.
        step: sampling distance, voxels; ``rays`` the largest number per pixel.
        axes: (3, 3) `Volume.axes`: from the box frame, in which the views are, to the unit frame.
        shown: images as `upright` makes them.
        conditions: views at the size made for, and at the next larger.
    """

    cameras: list[Camera]
    blocks: list[Blocks | None]
    images: list[np.ndarray]
    step: float
    rays: int
    axes: np.ndarray
    shown: list[np.ndarray]
    conditions: list[ConditionView]

    @classmethod
    def render(cls, volume: Field, size: int, console: Console) -> Reference:
        """Render the test views, as `vvgt evaluate` draws them."""
        from vvgt_cli.dvr import REFERENCE

        cameras, axes = default_views("test", size=size), volume.source.volume.axes
        blocks = [spread_blocks(size, size, i) for i in range(len(cameras))]
        around = condition_pictures(screens(size), SIDE)
        volume.views.expect([Picture(camera, REFERENCE, _drawn(blocks, i)) for i, camera in enumerate(cameras)])
        volume.views.expect([Picture(camera, REFERENCE, part) for _, camera, part in around])
        images, bar = [], console.bar("reference")
        for i, camera in enumerate(cameras):
            images.append(volume.views.view(camera, REFERENCE, _drawn(blocks, i)))
            if bar:
                bar(i + 1, len(cameras))
        shown = upright(images, cameras, axes, lambda camera: volume.views.view(camera, REFERENCE))
        conditions = list(condition_views(volume.views, around, REFERENCE))
        rays = max(rays for _, rays in REFERENCE.tiers)
        return cls(cameras, blocks, images, REFERENCE.step, rays, axes, shown, conditions)

    def psnr_of(self, renderer: str, field: Field) -> float | None:
        """Return another renderer's mean PSNR on the views that are drawn whole, None if it cannot draw them."""
        from vvgt_cli.dvr.backends import view_renderer
        from vvgt_cli.images.metrics import score_view
        from vvgt_cli.volume.vtk.messages import quiet_vtk

        if not isinstance(field, Resident):
            return None
        try:
            with quiet_vtk():  # which says where it looked for a screen
                draw = view_renderer(renderer, field.scene)
                scores = [score_view(self.images[i], draw(self.cameras[i]), perceptual=False).psnr for i in WHOLE]
        except (DataError, UsageError):
            return None
        return float(np.mean(scores))

    def score(self, gaussians: Gaussians) -> tuple[Scores, list[np.ndarray]]:
        """Return scores as `vvgt evaluate` measures them, and the images of the Gaussians."""
        from vvgt_cli.images.metrics import mean_scores
        from vvgt_cli.splat import render

        ours, scores = [], []
        for i, camera in enumerate(self.cameras):
            drawn = _drawn(self.blocks, i)
            ours.append(render(gaussians, camera, blocks=drawn))
            scores.append(score_drawn_view(self.images[i], ours[i], self.blocks[i], drawn is None))
        return mean_scores(scores), ours


def _drawn(blocks: Sequence[Blocks | None], view: int) -> Blocks | None:
    """Return the blocks of a test view that are drawn, None for all of it."""
    return None if view in WHOLE else blocks[view]


def upright(
    images: np.ndarray | Sequence[np.ndarray],
    cameras: Sequence[Camera],
    axes: np.ndarray,
    draw: Callable[[Camera], np.ndarray],
) -> list[np.ndarray]:
    """Return box-frame images for people: the `PICTURED` ones are redrawn in the unit frame if it differs."""
    if np.array_equal(axes, np.eye(3)):
        return list(images)
    see = render_in_box(draw, axes)
    return [see(cameras[n]) if n in PICTURED else image for n, image in enumerate(images)]


def do_runs(
    source: SourceRequest, options: RunOptions, reference: Reference, console: Console
) -> Iterator[tuple[dict[str, Any], list[np.ndarray]]]:
    """Yield each run (a dict, see `vvgt_cli.score.curves`) and its images of the reference's views.

    Raises:
        DataError, UsageError: as `vvgt_cli.conversion.convert.convert`.
        KeyboardInterrupt: a refinement was interrupted; later runs would not be comparable.
    """
    from vvgt_cli.splat import render

    with tempfile.TemporaryDirectory() as folder:
        views = None
        if options.peers:  # as many as our longest run has, at the screen's size
            count = view_count(max(options.steps, default=0), small=False)
            views = PeerViews.render(source, Path(folder) / "views", count, options.screen, options.blocks)
        for planned in plan_runs(options):
            report, gaussians = _run(source, planned, reference.axes, options.blocks, views)
            if report.refinement and report.refinement["reason"] == "interrupted":
                raise KeyboardInterrupt
            scores, images = reference.score(gaussians)
            conditions = score_conditions(gaussians, reference.conditions)
            report.scores, report.conditions = asdict(scores), [asdict(condition) for condition in conditions]
            count = views.count if views is not None and planned.peer is not None else _views_of(report, planned.fit)
            run = {"name": planned.name, "label": planned.label, "kind": planned.kind, "views": count}
            run |= asdict(report)
            yield run, upright(images, reference.cameras, reference.axes, partial(render, gaussians))


def warm_up(source: SourceRequest, options: RunOptions) -> None:
    """Run every kind of run once at a tiny size, so that kernels are compiled or loaded before any clock starts."""
    few = RunOptions(100, 64, (2,) if options.steps else (), options.model, options.seed, live=options.live)
    for planned in plan_runs(few)[-5:]:
        _run(source, planned, np.eye(3), options.blocks)


def _run(
    source: SourceRequest,
    planned: PlannedRun,
    axes: np.ndarray,
    blocks: BlockOptions | None,
    views: PeerViews | None = None,
) -> tuple[ConversionReport, Gaussians]:
    """Do one run; return its report and its Gaussians in the box frame (``axes`` as in `Reference`)."""
    if planned.kind == "baseline":
        return _baseline(source, planned, blocks)
    if planned.peer is not None and views is not None:
        report, gaussians = train(planned.peer, views)
        return report, transform(gaussians, np.linalg.inv(axes))
    with tempfile.TemporaryDirectory() as folder:
        path, live = str(Path(folder) / "run.ply"), planned.kind == "live"
        request = ConvertRequest(source, path, planned.fit, up="none", blocks=blocks, live=live)
        report = convert(request, Console(quiet=True)).report
        return report, transform(read_ply(path)[0], np.linalg.inv(axes))


def _views_of(report: ConversionReport, fit: FitOptions) -> int:
    """Return the number of training views: of gradient descent, or else of the plan."""
    if report.refinement:
        return int(report.refinement["views"])
    if report.plan is None:
        return view_count(fit.steps or 0, small=False)
    return sum(stage["count"] for stage in report.plan["stages"] if stage["name"] == TrainingViews.name)


def _views(run: Run, volume: Field, fit: FitOptions) -> tuple[Views, Views]:
    from vvgt_cli.dvr import RenderSettings, render_views

    train = default_views("train", view_count(fit.steps or 0, small=False), size=view_edge(fit.screen, small=False))
    volume.views.expect([*CheckViews().views(fit), *(Picture(camera, RenderSettings()) for camera in train)])
    with run.stage("check views"):
        checks = render_check_views(volume.views, default_views("check", size=fit.screen), RenderSettings())
    with run.stage("views"):
        return Views(train, render_views(volume.views, train)), checks


def _finish(run: Run, gaussians: Gaussians) -> tuple[ConversionReport, Gaussians]:
    stored = as_stored(gaussians)
    with run.stage("write"):
        run.report.bytes = write_ply(io.BytesIO(), stored)
    run.report.gaussians = len(stored)
    return run.finish(), stored


def _baseline(
    source: SourceRequest, planned: PlannedRun, blocks: BlockOptions | None
) -> tuple[ConversionReport, Gaussians]:
    """Run 3DGS (Kerbl et al. 2023): its loss, rates and density control, from random points or volume samples."""
    from vvgt_cli.closed_form import VbmOptions

    run, fit = Run(Console(quiet=True), ConversionReport("report")), planned.fit
    count = max(fit.max_gaussians // STARTS, 1)
    with open_field(run, ConvertRequest(source, fit=fit, blocks=blocks), INIT) as volume:
        with run.stage("samples"):
            if planned.start == "points":
                half = np.array(volume.source.volume.unit_frame().half)
                start = random_points(half, count, fit.seed)
            else:
                start = volume.pyramid(VbmOptions(count, fit.screen, "uniform", fit.seed)).gaussians
        train, check = _views(run, volume, fit)
    options = OptimizeOptions.of(
        "3dgs", steps=fit.steps, max_gaussians=fit.max_gaussians, seed=fit.seed,
        rule=INRIA.at(train.cameras[0].width / fit.screen), check_rule=INRIA,
    )  # fmt: skip
    return _finish(run, refine(run, start, train, check, options))


def random_points(half: np.ndarray, count: int, seed: int) -> Gaussians:
    """Return the random start of 3DGS: ``count`` Gaussians anywhere in the box, of any colour, round and faint.

    Sizes are the mean distance to the three nearest points; ``half`` (3,) holds the box's half edges.
    """
    rng = np.random.default_rng(seed)
    scale = NEIGHBOURS * (8 * float(np.prod(half)) / count) ** (1 / 3)
    return Gaussians(
        rng.uniform(-1, 1, (count, 3)) * half,
        np.full((count, 3), np.log(scale)),
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full(count, np.log(FAINT / (1 - FAINT))),
        rng.random((count, 3)),
    )


def pictures(images: Sequence[np.ndarray] | np.ndarray, numbers: Sequence[int], limit: int) -> list[np.ndarray]:
    """Return RGB over black of some views, (h, w, 3) in [0, 1], averaged down to sides of at most ``limit``."""
    shown = []
    for n in numbers:
        image = np.clip(images[n][..., :3], 0, 1)
        factor = -(-max(image.shape[:2]) // limit)
        height, width = (side // factor for side in image.shape[:2])
        squares = image[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
        shown.append(squares.mean(axis=(1, 3)))
    return shown


PAGE, TABLE, DATA = "report.html", "report.csv", "report.json"
VIEWS, VIEW_BYTES = 24, 16  # test views, ours and those shown; a pixel: float32 RGBA


def report_on(
    source: SourceRequest, output: str, options: RunOptions, *, picture_size: int, overwrite: bool, command: str | None,
    console: Console,
) -> dict[str, Any]:  # fmt: skip
    """Do all runs, write `report.json`, `report.csv`, the plots and `report.html`, and return the JSON's content.

    ``picture_size`` is the largest edge of the page's pictures, in pixels, and ``command`` what the user typed.

    Raises:
        UsageError: an output that may not be written, or standard input as the volume, which every run reads again.
        DataError: invalid input.
    """
    if source.volume == STDOUT:
        raise UsageError("VOLUME is '-', but every run reads it again; expected a file")
    folder = _folder(output, (DATA, TABLE, PAGE, *FILES), overwrite)
    options, size = _with_model(options), options.screen
    check_memory(VIEWS * size**2 * VIEW_BYTES, f"--screen {size}: test views and ours", "try a smaller --screen")
    whole = ConvertRequest(source, fit=FitOptions(options.max_gaussians, size), blocks=options.blocks)
    with open_field(Run(console, ConversionReport("report")), whole, INIT) as volume:
        scene = volume.source
        options = replace(options, live=live_refusal(replace(whole, live=True), scene) is None)
        warm_up(source, options)
        reference = Reference.render(volume, size, console)
        ceiling = reference.psnr_of("vtk", volume)
    runs, ours = [], []
    total = len(plan_runs(options))
    for run, images in do_runs(source, options, reference, console):
        runs.append(run)
        ours.append(list(map(png_bytes, pictures(images, PICTURED, picture_size))))
        score = f"PSNR {psnr(run):.2f} dB, worst condition {worst_condition(run):.2f} dB"
        megabytes = f"{run['gaussians']} Gaussians, {run['bytes'] / 1e6:.1f} MB"
        console.stage(f"{len(runs)}/{total}", cost(run), f"{run['name']}: {score}, {megabytes}")
    best, bend = [run["name"] for run in pareto(runs)], knee(runs)
    content = {
        "command_line": command or "",
        "volume": volume_record(scene),
        "transfer_function": tf_record(scene, source),
        "options": asdict(options),
        "reference": {"views": len(reference.cameras), "size": size, "step": reference.step, "rays": reference.rays},
        "front": best,
        "knee": bend["name"] if bend else None,
        "unit_costs": unit_costs(runs),
        "runs": [run | {"cost": cost(run)} for run in runs],
        "vtk_psnr": ceiling,
    }
    text = document("vvgt-report", content)
    report: dict[str, Any] = json.loads(text)
    series = [ReportRuns(scene.volume.name, runs, report)]
    shown = list(map(png_bytes, pictures(reference.shown, PICTURED, picture_size)))
    folder.mkdir(exist_ok=True)
    write_text(str(folder / DATA), text, overwrite)
    title = f"Error against run time: {scene.volume.name}"
    _write(folder, series, title, Pictures(list(PICTURED), shown, ours), overwrite)
    console.message(f"{folder / PAGE}")
    return report


def _with_model(options: RunOptions) -> RunOptions:
    """Return the options with the shipped network if none is named and one is installed."""
    if options.model is not None:
        return options
    try:
        find_model(SHIPPED)
    except UsageError:
        return options
    return replace(options, model=SHIPPED)


def compare(paths: Sequence[str], output: str, overwrite: bool, console: Console) -> None:
    """Compare several reports: write `report.csv`, the plots and `report.html`.

    Args:
        paths: `report.json` of `vvgt report`, or `--report` of `vvgt convert`.
        output: folder to write to; created if missing.
        overwrite: replace files that exist.
        console: for messages.

    Raises:
        UsageError: fewer than two reports, or outputs that may not be written.
        DataError: a file that is not a report.
    """
    if len(paths) < 2:
        raise UsageError(f"--compare: {len(paths)} report; expected two or more, as --compare A.json B.json")
    folder = _folder(output, (TABLE, PAGE, *FILES), overwrite, paths)
    series = _distinct([read_series(path) for path in paths])
    folder.mkdir(exist_ok=True)
    _write(folder, series, "Error against run time, compared", None, overwrite)
    for one in series:
        best = max(one.scored(), key=lambda run: psnr(run) or 0)
        console.message(f"{one.name}: {len(one.runs)} runs, best {best['name']} with {psnr(best):.2f} dB")
    console.message(f"{folder / PAGE}")


def _distinct(series: list[ReportRuns]) -> list[ReportRuns]:
    """Add numbers to reports that share a name, and put the report's name before those of its runs."""
    names, renamed = [one.name for one in series], []
    for n, one in enumerate(series):
        name = one.name if names.count(one.name) == 1 else f"{one.name} ({n + 1})"
        runs = [{"label": run["name"], **run, "name": f"{name}: {run['name']}"} for run in one.runs]
        renamed.append(ReportRuns(name, runs, one.document))
    return renamed


def _folder(output: str, names: Sequence[str], overwrite: bool, inputs: Sequence[str] = ()) -> Path:
    """Return the folder if all files may be written there."""
    folder = Path(output)
    if output == STDOUT:
        raise UsageError("-o -: a report is a folder of files; expected a folder's name")
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"-o {folder}: is a file; expected a folder's name")
    if not folder.parent.is_dir():
        raise UsageError(f"-o {folder}: the folder {folder.parent} does not exist; make it first")
    if not os.access(folder if folder.is_dir() else folder.parent, os.W_OK):
        raise UsageError(f"-o {folder}: is not writable; choose another folder")
    if folder.is_dir():
        check_outputs([Output("-o", str(folder / name)) for name in names], list(inputs), overwrite)
    return folder


def _write(folder: Path, series: list[ReportRuns], title: str, shown: Pictures | None, overwrite: bool) -> None:
    write_text(str(folder / TABLE), table([run for one in series for run in one.runs]), overwrite)
    charts = draw(series)
    write_plots(folder, charts, overwrite)
    write_text(str(folder / PAGE), page(series, charts, title, shown), overwrite)
