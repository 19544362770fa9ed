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
from typing import Any

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.cameras.types import render_in_box
from vvgt_cli.commands.peers import Peer, PeerViews, train
from vvgt_cli.conversion.convert import convert_one
from vvgt_cli.conversion.live import live_refusal
from vvgt_cli.conversion.opened import open_field
from vvgt_cli.conversion.previous_frame import RememberedViews
from vvgt_cli.conversion.request import ConvertRequest, FitOptions
from vvgt_cli.conversion.stages.refinement import refine
from vvgt_cli.conversion.stages.views import CheckViews, TrainingViews, view_count
from vvgt_cli.defaults import REPORT_STEPS
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.field import Field, Picture, Resident
from vvgt_cli.field.source import tf_record, volume_record
from vvgt_cli.field.workload import view_edge
from vvgt_cli.gaussians import Gaussians, as_stored, read_ply, write_ply
from vvgt_cli.gaussians.frames import transform
from vvgt_cli.gaussians.outputs import STDOUT, Output, check_folder, check_outputs, write_text
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.images import coarser, png_bytes
from vvgt_cli.jit.ahead import INIT
from vvgt_cli.network.card import SHIPPED, find_model
from vvgt_cli.progress import Console, counted
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
from vvgt_cli.score.views import Views, render_check_views, score_test_views, scored_views
from vvgt_cli.volume.blocks import check_memory

SHARES = (64, 16, 4)  # of the budget, for the closed form at several K
STARTS = 2  # of the budget, what the baselines begin with: they grow
FAINT = 0.1  # opacity of 3DGS' first points
PICTURED = (0, 4)  # test views on the page: from above, from the side
NEIGHBOURS = 0.72  # mean distance to the three nearest of n random points, over (volume / n)^(1/3)


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


def plan_runs(
    fit: FitOptions, steps: Sequence[int] = REPORT_STEPS, peers: Sequence[Peer] = (), live: bool = False
) -> list[PlannedRun]:
    """List the runs: other trainers first, as they may fail; then ours from the cheapest on; then the baselines.

    Args:
        fit: largest budget K, screen, seed, and the network, None for none.
        steps: lengths of gradient descent, one run each; the baselines take the longest.
        peers: other trainers, one run each.
        live: include the live form (docs/live.md), which not every scene has.
    """
    most, form = fit.max_gaussians, replace(fit, steps=0, model=None)
    budgets = sorted({max(most // share, 1) for share in SHARES} | {most})
    runs = [
        PlannedRun(f"closed form, K = {short(k)}", short(k), "closed form", replace(form, max_gaussians=k))
        for k in budgets
    ]
    if live:
        runs.append(PlannedRun(f"live form, K = {short(most)}", "live", "live", replace(form, steps=None)))
    if fit.model:
        runs.append(PlannedRun(f"network {Path(fit.model).name}", "network", "network", replace(fit, steps=0)))
    runs += [PlannedRun(f"{n} steps", f"{n} steps", "steps", replace(form, steps=n)) for n in sorted(set(steps))]
    longest = replace(form, steps=max(steps, default=0))
    if longest.steps:
        for name, start in (("3DGS", "points"), ("iVR-GS setting", "samples")):
            runs.append(PlannedRun(f"{name}, {longest.steps} steps", name, "baseline", longest, start))
    return [PlannedRun(peer.name, peer.name, "peer", longest, peer=peer) for peer in peers] + runs


@dataclass(frozen=True)
class Reference:
    """Reference that every run is scored against, as `vvgt evaluate` draws it; it counts in no run's time.

    Attributes:
        views: the test views, which are rendered once.
        size: pixels along their edge.
        axes: (3, 3) `Volume.axes`: from the box frame, in which the views are, to the unit frame.
        conditions: views at the size made for, and at the next larger.
    """

    views: RememberedViews
    size: int
    axes: np.ndarray
    conditions: list[ConditionView]

    @classmethod
    def render(cls, volume: Field, size: int, console: Console) -> Reference:
        """Render the test views."""
        from vvgt_cli.dvr import REFERENCE

        views, around = RememberedViews(size, volume.views), condition_pictures(screens(size), SIDE)
        scored = [Picture(camera, REFERENCE, blocks) for _, camera, blocks in scored_views(size)]
        volume.views.expect([*scored, *(Picture(camera, REFERENCE, part) for _, camera, part in around)])
        for picture in counted(scored, console.bar("reference")):
            views.view(*picture)
        conditions = list(condition_views(volume.views, around, REFERENCE))
        return cls(views, size, volume.source.volume.axes, conditions)

    def vtk_psnr(self, field: Field) -> float | None:
        """Return the mean PSNR of VTK's pictures in the views that are drawn whole, None if it cannot draw them."""
        from vvgt_cli.dvr import REFERENCE
        from vvgt_cli.dvr.vtk import view_renderer
        from vvgt_cli.images.metrics import score_view
        from vvgt_cli.volume.vtk.messages import quiet_vtk

        if not isinstance(field, Resident):
            return None
        cameras = [camera for _, camera, _ in scored_views(self.size, every=False)]
        try:
            with quiet_vtk():  # which says where it looked for a screen
                draw = view_renderer(field.scene)
                pairs = [(self.views.view(camera, REFERENCE), draw(camera)) for camera in cameras]
        except (DataError, UsageError):
            return None
        return float(np.mean([score_view(*pair, perceptual=False).psnr for pair in pairs]))

    def score(self, gaussians: Gaussians, report: ConversionReport) -> None:
        """Set the scores of Gaussians in their report as `vvgt evaluate` measures them."""
        from vvgt_cli.dvr import REFERENCE

        report.scores = asdict(score_test_views(self.views, gaussians, self.size, REFERENCE))
        report.conditions = [asdict(one) for one in score_conditions(gaussians, self.conditions)]

    def pictures(self, draw: Callable[[Camera], np.ndarray], limit: int) -> list[bytes]:
        """Return PNG of the `PICTURED` views, upright, over black, averaged down to sides of at most ``limit``."""
        see, shown = render_in_box(draw, self.axes), []
        for n in PICTURED:
            image = np.clip(see(default_views("test", size=self.size)[n])[..., :3], 0, 1)
            shown.append(png_bytes(coarser(image, -(-self.size // limit))))
        return shown


def do_runs(
    request: ConvertRequest, planned: Sequence[PlannedRun], reference: Reference
) -> Iterator[tuple[dict[str, Any], Gaussians]]:
    """Yield each run (a dict, see `vvgt_cli.score.curves`) and its Gaussians, box frame.

    Raises:
        DataError, UsageError: as `vvgt_cli.conversion.convert.convert_one`.
        KeyboardInterrupt: a refinement was interrupted; later runs would not be comparable.
    """
    with tempfile.TemporaryDirectory() as folder:
        views = None
        if any(one.peer for one in planned):  # as many as our longest run has, at the screen's size
            count = view_count(max(one.fit.steps or 0 for one in planned), small=False)
            views = PeerViews.render(request.source, Path(folder) / "views", count, request.fit.screen, request.blocks)
        for one in planned:
            report, gaussians = _run(request, one, reference.axes, views)
            if report.interrupted:
                raise KeyboardInterrupt
            reference.score(gaussians, report)
            count = views.count if views is not None and one.peer is not None else _views_of(report, one.fit)
            yield {"name": one.name, "label": one.label, "kind": one.kind, "views": count} | asdict(report), gaussians


def warm_up(request: ConvertRequest, fit: FitOptions, steps: Sequence[int], live: bool) -> None:
    """Run every kind of run once at a tiny size, so that kernels are compiled or loaded before any clock starts."""
    few = replace(fit, max_gaussians=100, screen=64)
    for planned in plan_runs(few, (2,) if steps else (), (), live)[-5:]:
        _run(request, planned, np.eye(3))


def _run(
    request: ConvertRequest, planned: PlannedRun, axes: np.ndarray, views: PeerViews | None = None
) -> tuple[ConversionReport, Gaussians]:
    """Do one run; return its report and its Gaussians in the box frame (``axes`` as in `Reference`)."""
    if planned.kind == "baseline":
        return _baseline(replace(request, fit=planned.fit), planned.start == "points")
    if planned.peer is not None and views is not None:
        report, gaussians = train(planned.peer, views)
        return report, transform(gaussians, np.linalg.inv(axes))
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "run.ply")
        report = convert_one(
            replace(request, output=path, fit=planned.fit, up="none", live=planned.kind == "live"), Console(quiet=True)
        ).report
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


def _baseline(request: ConvertRequest, points: bool) -> tuple[ConversionReport, Gaussians]:
    """Run 3DGS (Kerbl et al. 2023): its loss, rates and density control, from random points or volume samples."""
    from vvgt_cli.closed_form import VbmOptions

    run, fit = Run(Console(quiet=True), ConversionReport("report")), request.fit
    count = max(fit.max_gaussians // STARTS, 1)
    with open_field(run, request, INIT) as volume:
        with run.stage("samples"):
            if points:
                start = random_points(np.array(volume.source.volume.unit_frame().half), count, fit.seed)
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


PAGE, TABLE, DATA = "report.html", "report.csv", "report.json"
VIEWS, VIEW_BYTES = 24, 16  # test views, ours and those shown; a pixel: float32 RGBA


def report_on(
    request: ConvertRequest, steps: Sequence[int], peers: Sequence[Peer], picture_size: int, console: Console
) -> dict[str, Any]:
    """Do all runs, write `report.json`, `report.csv`, the plots and `report.html`, and return the JSON's content.

    Args:
        request: for the folder as output; `fit` and `steps` as in `plan_runs`, without a network the shipped one.
        steps: see `plan_runs`.
        peers: other trainers.
        picture_size: largest edge of the page's pictures, in pixels.
        console: for messages.

    Raises:
        UsageError: an output that may not be written, or standard input as the volume, which every run reads again.
        DataError: invalid input.
    """
    from vvgt_cli.dvr import REFERENCE
    from vvgt_cli.splat import render

    if request.source.volume == STDOUT:
        raise UsageError("VOLUME is '-', but every run reads it again; expected a file")
    folder = _folder(str(request.output), (DATA, TABLE, PAGE, *FILES), request.overwrite)
    fit, size = _with_model(request.fit), request.fit.screen
    check_memory(VIEWS * size**2 * VIEW_BYTES, f"--screen {size}: test views and ours", "try a smaller --screen")
    alone = ConvertRequest(request.source, fit=replace(fit, model=None), blocks=request.blocks)
    with open_field(Run(console, ConversionReport("report")), alone, INIT) as volume:
        scene = volume.source
        live = live_refusal(replace(alone, live=True), scene) is None
        warm_up(alone, fit, steps, live)
        reference = Reference.render(volume, size, console)
        ceiling = reference.vtk_psnr(volume)
        shown = reference.pictures(lambda camera: reference.views.view(camera, REFERENCE), picture_size)
    runs, ours, planned = [], [], plan_runs(fit, steps, peers, live)
    for run, gaussians in do_runs(alone, planned, reference):
        runs.append(run)
        ours.append(reference.pictures(partial(render, gaussians), picture_size))
        score = f"PSNR {psnr(run):.2f} dB, worst condition {worst_condition(run):.2f} dB"
        megabytes = f"{run['gaussians']} Gaussians, {run['bytes'] / 1e6:.1f} MB"
        console.stage(f"{len(runs)}/{len(planned)}", cost(run), f"{run['name']}: {score}, {megabytes}")
    bend = knee(runs)
    content = {
        "command_line": request.command or "",
        "volume": volume_record(scene),
        "transfer_function": tf_record(scene, request.source),
        "options": {
            "max_gaussians": fit.max_gaussians, "screen": size, "steps": steps, "model": fit.model, "seed": fit.seed,
            "blocks": request.blocks, "live": live, "peers": peers,
        },
        "reference": {
            "views": len(default_views("test")), "size": size, "step": REFERENCE.step,
            "rays": max(rays for _, rays in REFERENCE.tiers),
        },
        "front": [run["name"] for run in pareto(runs)],
        "knee": bend["name"] if bend else None,
        "unit_costs": unit_costs(runs),
        "runs": [run | {"cost": cost(run)} for run in runs],
        "vtk_psnr": ceiling,
    }  # fmt: skip
    text = document("vvgt-report", content)
    report: dict[str, Any] = json.loads(text)
    folder.mkdir(exist_ok=True)
    write_text(str(folder / DATA), text, request.overwrite)
    series, title = [ReportRuns(scene.volume.name, runs, report)], f"Error against run time: {scene.volume.name}"
    _write(folder, series, title, Pictures(list(PICTURED), shown, ours), request.overwrite)
    console.message(f"{folder / PAGE}")
    return report


def _with_model(fit: FitOptions) -> FitOptions:
    """Return the options with the shipped network if none is named and one is installed."""
    if fit.model is not None:
        return fit
    try:
        find_model(SHIPPED)
    except UsageError:
        return fit
    return replace(fit, model=SHIPPED)


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
    check_folder(folder, "report")
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
