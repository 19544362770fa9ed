"""`optimize`: refinement of Gaussians by gradient descent on views."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from vvgt_cli.conversion.gaussian_files import file_rule, layout_of, open_gaussians, write_gaussians
from vvgt_cli.conversion.result import Result
from vvgt_cli.conversion.stages.refinement import refine
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.outputs import Output, check_outputs, claimed, write_text
from vvgt_cli.gaussians.rules import Rule
from vvgt_cli.images.files import load_views
from vvgt_cli.jit.ahead import OPTIMIZE, for_degree
from vvgt_cli.progress import Console
from vvgt_cli.refine import OptimizeOptions
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.score.views import Views, psnr_note

if TYPE_CHECKING:
    from vvgt_cli.images.metrics import Scores

HOLD_OUT = 8  # of so many training views one decides, where the folder has no check views


@dataclass(frozen=True)
class OptimizeRequest:
    """A refinement.

    Attributes:
        ply: Gaussians to start from, "-" for standard input, or a stream of them.
        views: folder that `render-views` wrote.
        output: `.ply` to write, "-" for standard output, None for none.
        options: how to descend, and when to stop.
        size: pixels along the edge of the screen that the file is made for; None: the file's, or the views'.
        rule: one of `vvgt_cli.gaussians.rules` to fit to; None: the file's, or inria.
        sh_degree: degree of the harmonics that are refined and written, 0 to 3; None: the file's.
        report: JSON to write, "-" for standard output, None for none.
        overwrite: replace files that exist.
    """

    ply: str | BinaryIO
    views: str
    output: str | None
    options: OptimizeOptions
    size: int | None = None
    rule: str | None = None
    sh_degree: int | None = None
    report: str | None = None
    overwrite: bool = False

    def outputs(self) -> list[Output]:
        """Return all files that will be written."""
        report = [Output("--report", self.report, (".json",), binary=False)] if self.report else []
        return [*([Output("-o", self.output, (".ply",))] if self.output else []), *report]

    def inputs(self) -> list[str]:
        """Return the files that are read."""
        return [self.ply] if isinstance(self.ply, str) else []


def optimize_file(request: OptimizeRequest, console: Console | None = None) -> ConversionReport:
    """Refine a `.ply` and write it: fitted to training views, selected by check views, scored on test views.

    Raises:
        UsageError: an output that may not be written; raised before anything is read.
        DataError: a `.ply` or a folder of views that is not valid.
    """
    if request.options.checkpoint:
        check_outputs([Output("--checkpoint", request.options.checkpoint, (".npz",))], request.inputs(), True)
    with claimed(request.outputs(), request.inputs(), request.overwrite):
        run = Run(console or Console(), ConversionReport("optimize"))
        result = optimized(run, request)
        assert request.output is not None
        write_gaussians(run, request.output, result.gaussians, result.ply, request.overwrite)
        run.finish()
        if request.report:
            write_text(request.report, run.report.to_json(), request.overwrite)
        return run.report


def optimized(run: Run, request: OptimizeRequest) -> Result:
    """Refine Gaussians without writing anything but the checkpoint.

    Raises:
        DataError: a `.ply` or a folder of views that is not valid.
    """
    with run.stage("read") as stage:
        start, header = open_gaussians(request.ply)
        stage.note = f"{len(start)} Gaussians, {header.frame} frame"
        start = start if request.sh_degree is None else start.of_degree(request.sh_degree)
    with run.stage("views") as stage:
        train, check, held_out = load_sets(request.views)
        test = Views(*load_views(request.views, "test")) if _has(request.views, "test") else None
        stage.note = f"{len(train)} training views, {len(check)} check views{held_out}"
    run.compile(for_degree(OPTIMIZE, start.degree))
    edge = train.cameras[0].width
    size, asked = request.size or header.screen_size or edge, file_rule(header, request.rule)
    rule = asked.at(edge / size)
    options = replace(request.options, rule=rule, judge=rule)
    run.report.options = asdict(request.options) | {
        "rule": asked.name,
        "judge": asked.name,
        "size": size,
        "sh_degree": start.degree,
    }
    gaussians = refine(run, start, train, check, options)
    if test is not None:
        _score(run, test, start, gaussians, rule)
    degree = header.sh_degree if request.sh_degree is None else request.sh_degree
    layout = replace(layout_of(header), certificate=None, screen_size=size, rule=asked.name, sh_degree=degree)
    return Result(gaussians, run.report, layout)


def load_sets(folder: str) -> tuple[Views, Views, str]:
    """Return training views, check views, and a remark if they come from the training views, or raise DataError."""
    train = Views(*load_views(folder, "train"))
    if _has(folder, "check"):
        return train, Views(*load_views(folder, "check")), ""
    count = len(train)
    if count < 2:
        raise DataError(f"{folder}: {count} training view; expected two or more, one of them to select the result")
    held = np.arange(min(HOLD_OUT, count) - 1, count, HOLD_OUT)
    rest = np.setdiff1d(np.arange(count), held)
    return train.take(rest), train.take(held), f" (every {HOLD_OUT}th training view, held out)"


def _has(folder: str, split: str) -> bool:
    return (Path(folder) / f"transforms_{split}.json").is_file()


def _score(run: Run, test: Views, start: Gaussians, gaussians: Gaussians, rule: Rule) -> None:
    with run.stage("test views") as stage:
        before, after = (_mean(test, g, rule, perceptual=last) for g, last in ((start, False), (gaussians, True)))
        run.report.scores = asdict(after)
        stage.note = f"{psnr_note(after)}, from {before.psnr:.2f} dB, {after.views} views"


def _mean(test: Views, gaussians: Gaussians, rule: Rule, perceptual: bool) -> Scores:
    from vvgt_cli.images.metrics import score_views

    return score_views(test.images, test.pictures(gaussians, rule), perceptual=perceptual)


def budget(steps: int | None, seconds: float | None) -> dict[str, int | float | None]:
    """Return the options of the budget, either steps or seconds; raise UsageError for both or neither."""
    if (steps is None) == (seconds is None):
        raise UsageError("give either --steps N or --time-budget SECONDS")
    return {"steps": steps, "time_budget": seconds}
