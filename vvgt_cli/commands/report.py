"""`report`: runs on one scene as JSON, CSV, plots and a page; or several reports compared."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from vvgt_cli.commands.infer import SHIPPED
from vvgt_cli.commands.peers import Peer
from vvgt_cli.commands.report_runs import PICTURED, Reference, RunOptions, do_runs, pictures, plan_runs, warm_up
from vvgt_cli.conversion.convert import open_field
from vvgt_cli.conversion.live import live_refusal
from vvgt_cli.conversion.request import ConvertRequest, FitOptions
from vvgt_cli.errors import UsageError
from vvgt_cli.field.source import SourceRequest, tf_record, volume_record
from vvgt_cli.gaussians.outputs import STDOUT, Output, check_outputs, write_text
from vvgt_cli.images import png_bytes
from vvgt_cli.jit.ahead import INIT
from vvgt_cli.network.card import find_model
from vvgt_cli.progress import Console
from vvgt_cli.score.charts import FILES, draw, write_plots
from vvgt_cli.score.curves import Series, cost, knee, pareto, psnr, read_series, table, unit_costs, worst_condition
from vvgt_cli.score.page import Pictures, page
from vvgt_cli.score.record import ConversionReport, Run, document
from vvgt_cli.volume.blocks import check_memory

PAGE, TABLE, DATA = "report.html", "report.csv", "report.json"
VIEWS, VIEW_BYTES = 24, 16  # test views, ours and those shown; a pixel: float32 RGBA


@dataclass(frozen=True)
class ReportRequest:
    """A report.

    Attributes:
        source: the scene.
        output: folder to write to; created if missing.
        options: of the runs.
        picture_size: largest edge of the page's pictures, in pixels.
        overwrite: replace files that exist.
        command_line: what the user typed, for the page.
    """

    source: SourceRequest
    output: str
    options: RunOptions = field(default_factory=RunOptions)
    picture_size: int = 400
    overwrite: bool = False
    command_line: str = ""


def report(request: ReportRequest, console: Console | None = None) -> dict[str, Any]:
    """Do all runs, write `report.json`, `report.csv`, the plots and `report.html`, and return the JSON's content.

    Raises:
        UsageError: an output that may not be written, or standard input as the volume, which every run reads again.
        DataError: invalid input.
    """
    console = console or Console()
    if request.source.volume == STDOUT:
        raise UsageError("VOLUME is '-', but every run reads it again; expected a file")
    folder = _folder(request.output, (DATA, TABLE, PAGE, *FILES), request.overwrite)
    request = replace(request, options=_with_model(request.options))
    size = request.options.size
    check_memory(VIEWS * size**2 * VIEW_BYTES, f"--size {size}: test views and ours", "try a smaller --size")
    fit = FitOptions(request.options.max_gaussians, size)
    whole = ConvertRequest(request.source, fit=fit, blocks=request.options.blocks)
    with open_field(Run(console, ConversionReport("report")), whole, INIT) as volume:
        source = volume.source
        live = replace(whole, live=True, fit=FitOptions(fit.max_gaussians, size))
        request = replace(request, options=replace(request.options, live=live_refusal(live, source) is None))
        warm_up(request.source, request.options)
        reference = Reference.render(volume, size, console)
        ceiling = reference.psnr_of("vtk", volume)
    runs, ours = [], []
    total = len(plan_runs(request.options))
    for run, images in do_runs(request.source, request.options, reference, console):
        runs.append(run)
        ours.append(list(map(png_bytes, pictures(images, PICTURED, request.picture_size))))
        score = f"PSNR {psnr(run):.2f} dB, worst condition {worst_condition(run):.2f} dB"
        megabytes = f"{run['gaussians']} Gaussians, {run['bytes'] / 1e6:.1f} MB"
        console.stage(f"{len(runs)}/{total}", cost(run), f"{run['name']}: {score}, {megabytes}")
    text = document("vvgt-report", _document(request, source, reference, runs) | {"vtk_psnr": ceiling})
    found: dict[str, Any] = json.loads(text)
    series = [Series(source.volume.name, runs, found)]
    shown = list(map(png_bytes, pictures(reference.shown, PICTURED, request.picture_size)))
    folder.mkdir(exist_ok=True)
    write_text(str(folder / DATA), text, request.overwrite)
    title = f"Error against run time: {source.volume.name}"
    _write(folder, series, title, Pictures(list(PICTURED), shown, ours), request.overwrite)
    console.message(f"{folder / PAGE}")
    return found


def _with_model(options: RunOptions) -> RunOptions:
    """Return the options with the shipped network if none is named and one is installed."""
    if options.model is not None:
        return options
    try:
        find_model(SHIPPED)
    except UsageError:
        return options
    return replace(options, model=SHIPPED)


def _document(request: ReportRequest, source: Any, reference: Reference, runs: list[dict[str, Any]]) -> dict[str, Any]:
    best, bend = [run["name"] for run in pareto(runs)], knee(runs)
    return {
        "command_line": request.command_line,
        "volume": volume_record(source),
        "transfer_function": tf_record(source, request.source),
        "options": asdict(request.options),
        "reference": {
            "views": len(reference.cameras), "size": request.options.size, "step": reference.step,
            "rays": reference.rays,
        },
        "front": best,
        "knee": bend["name"] if bend else None,
        "unit_costs": unit_costs(runs),
        "runs": [run | {"cost": cost(run)} for run in runs],
    }  # fmt: skip


def compare(paths: Sequence[str], output: str, overwrite: bool, console: Console | None = None) -> None:
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
    console = console or Console()
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


def _distinct(series: list[Series]) -> list[Series]:
    """Add numbers to reports that share a name, and put the report's name before those of its runs."""
    names, found = [one.name for one in series], []
    for n, one in enumerate(series):
        name = one.name if names.count(one.name) == 1 else f"{one.name} ({n + 1})"
        runs = [{"label": run["name"], **run, "name": f"{name}: {run['name']}"} for run in one.runs]
        found.append(Series(name, runs, one.document))
    return found


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


def _write(folder: Path, series: list[Series], title: str, shown: Pictures | None, overwrite: bool) -> None:
    write_text(str(folder / TABLE), table([run for one in series for run in one.runs]), overwrite)
    charts = draw(series)
    write_plots(folder, charts, overwrite)
    write_text(str(folder / PAGE), page(series, charts, title, shown), overwrite)


__all__ = ["Peer", "ReportRequest", "RunOptions", "compare", "report"]
