"""`vvgt optimize`: Gaussians refined by gradient descent on views."""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.errors import DataError, UsageError

if TYPE_CHECKING:
    from vvgt_cli.conversion.result import Result
    from vvgt_cli.gaussians import Gaussians
    from vvgt_cli.gaussians.rules import Rule
    from vvgt_cli.library.inputs import PathLike
    from vvgt_cli.progress import Console
    from vvgt_cli.refine import OptimizeOptions
    from vvgt_cli.score.record import Run
    from vvgt_cli.score.views import Views

HOLD_OUT = 8  # of so many training views one decides, where the folder has no check views


def optimize(
    ply: PathLike | Result, views: PathLike, output: PathLike | None = None, *, steps: int | None = None,
    time_budget: float | None = None, target_psnr: float | None = None, method: str = "axes",
    max_gaussians: int | None = None, checkpoint: PathLike | None = None, screen: int | None = None,
    rule: str | None = None, sh_degree: int | None = None, seed: int = 0, report: PathLike | None = None,
    device: str = "cpu", overwrite: bool = False, progress: bool | Console = False,
) -> Result:  # fmt: skip
    """Refine Gaussians by gradient descent on views: ``vvgt optimize``.

    Args:
        ply: path, "-" for standard input, or result of `convert`.
        views: folder of ``vvgt render-views``.
        output: ``.ply`` to write; "-" is standard output, None writes nothing.
        steps: number of steps, of one view each; or give ``time_budget``.
        time_budget: seconds; or give ``steps``.
        target_psnr: dB on the check views at which to stop.
        method: "axes", "adam" or "3dgs".
        max_gaussians: maximal number of Gaussians, for "3dgs".
        checkpoint: ``.npz`` to save progress in, from which the same call goes on.
        screen: pixels along the edge of the target screen; None: the file's.
        rule: drawing rule; None: the file's.
        sh_degree: degree of the spherical harmonics that are refined, 0 to 3; None: the file's.
        seed: seed of the order of views.
        report: JSON to write.
        device: "cpu", or "cuda" for the steps of "axes".
        overwrite: replace files that exist.
        progress: print messages and bars on standard error.

    Returns:
        The best Gaussians by the check views.

    Raises:
        DataError: an invalid ``.ply`` or folder of views.
        UsageError: both of steps and time_budget, or neither; an output that may not be written.
    """
    from vvgt_cli.gaussians.outputs import Output, check_outputs
    from vvgt_cli.library.inputs import ply_of, written
    from vvgt_cli.refine import OptimizeOptions

    if max_gaussians is not None and method != "3dgs":
        raise UsageError(f"--max-gaussians applies to --method 3dgs; --method {method} does not change the number")
    if (steps is None) == (time_budget is None):
        raise UsageError("give either --steps N or --time-budget SECONDS")
    kept = None if checkpoint is None else os.fspath(checkpoint)
    how = OptimizeOptions.of(
        method, steps=steps, time_budget=time_budget, target_psnr=target_psnr, max_gaussians=max_gaussians, seed=seed,
        checkpoint=kept, device=device,
    )  # fmt: skip
    start = ply_of(ply)
    inputs = [start] if isinstance(start, str) else []
    check_outputs(Output.of("--checkpoint", kept, (".npz",)), inputs, True)
    make = partial(_refined, start, os.fspath(views), how, screen, rule, sh_degree)
    return written(make, "optimize", inputs, output, report, overwrite=overwrite, progress=progress)


@shared.command("optimize", short_help="Refine a .ply by gradient descent on views.")
@click.argument("ply", metavar="IN.ply")
@click.option("--views", required=True, metavar="DIR", help="Views of the volume, written by 'vvgt render-views'.")
@click.option("-o", "--output", required=True, metavar="OUT.ply", help="Output file; - is standard output.")
@click.option(
    "--steps", type=click.IntRange(0, 10_000_000), metavar="N", help="Maximum number of steps, one view each."
)
@click.option(
    "--time-budget", type=shared.Measure("time", shared.SECONDS), metavar="TIME",
    help="Time for the descent, such as 90 or 10m, instead of --steps.",
)  # fmt: skip
@click.option(
    "--target-psnr", type=click.FloatRange(0, 150), metavar="DB", help="Stop when the check views reach this PSNR."
)
@click.option(
    "--method", type=click.Choice(["axes", "adam", "3dgs"]), default="axes", show_default=True,
    help="Steps in each Gaussian's own frame or, for comparison, plain Adam or Adam with 3DGS' density control.",
)  # fmt: skip
@click.option(
    "--max-gaussians", type=click.IntRange(1, 100_000_000), metavar="K",
    help="Maximum number of Gaussians with --method 3dgs. Default: as many as IN.ply has.",
)  # fmt: skip
@click.option(
    "--checkpoint", metavar="FILE.npz",
    help="Save progress here, so that the same command resumes after an interruption.",
)  # fmt: skip
@click.option(
    "--screen", type=click.IntRange(16, 8192), metavar="PX",
    help="Screen size to optimise for, in pixels. Default: the one recorded in IN.ply, or that of the views.",
)  # fmt: skip
@shared.rule_option("Viewer to optimise for. Default: the one recorded in IN.ply, or inria.")
@click.option(
    "--sh-degree", type=click.IntRange(0, 3), metavar="N",
    help="Degree of the spherical harmonics to refine; missing ones start at 0. Default: that of IN.ply.",
)  # fmt: skip
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Random seed for the order of views."
)
@shared.report_option
@shared.device_option("steps of --method axes are taken")
@shared.overwrite_option
@shared.common_options
def command(console: Console, **options: Any) -> None:
    """Refine IN.ply so that its pictures match the views in DIR.

    Training views are fitted, check views decide what is kept, and test views only score the result. The best state
    on the check views is written, never worse than IN.ply. If the folder has no check views, every 8th training view
    is used instead. Ctrl-C ends the descent early and writes the result.

    Examples:
      vvgt render-views head.nrrd --tf bone.json -o views
      vvgt optimize head.ply --views views --steps 200 -o better.ply
      vvgt optimize head.ply --views views --time-budget 60 --target-psnr 40 -o better.ply
    """
    optimize(**options, progress=console)


def _refined(
    ply: str | BinaryIO, folder: str, how: OptimizeOptions, screen: int | None, rule: str | None, sh_degree: int | None,
    run: Run,
) -> Result:  # fmt: skip
    """Refine Gaussians without writing anything but the checkpoint."""
    from vvgt_cli.conversion.gaussian_files import file_rule, layout_of, open_gaussians
    from vvgt_cli.conversion.result import Result
    from vvgt_cli.conversion.stages.refinement import refine
    from vvgt_cli.images.files import load_views
    from vvgt_cli.jit.ahead import OPTIMIZE, for_degree
    from vvgt_cli.score.views import Views

    with run.stage("read") as stage:
        start, header = open_gaussians(ply)
        stage.note = f"{len(start)} Gaussians, {header.frame} frame"
        start = start if sh_degree is None else start.of_degree(sh_degree)
    with run.stage("views") as stage:
        train, check, held_out = load_sets(folder)
        test = Views(*load_views(folder, "test")) if _has(folder, "test") else None
        stage.note = f"{len(train)} training views, {len(check)} check views{held_out}"
    run.compile(for_degree(OPTIMIZE, start.degree))
    edge = train.cameras[0].width
    screen, asked = screen or header.screen_size or edge, file_rule(header, rule)
    fitted = asked.at(edge / screen)
    named = {"rule": asked.name, "check_rule": asked.name, "screen": screen, "sh_degree": start.degree}
    run.report.options = asdict(how) | named
    gaussians = refine(run, start, train, check, replace(how, rule=fitted, check_rule=fitted))
    if test is not None:
        _score(run, test, start, gaussians, fitted)
    degree = header.sh_degree if sh_degree is None else sh_degree
    layout = replace(layout_of(header), certificate=None, screen_size=screen, rule=asked.name, sh_degree=degree)
    return Result(gaussians, run.report, layout)


def load_sets(folder: str) -> tuple[Views, Views, str]:
    """Return training views, check views, and a remark if they come from the training views, or raise DataError."""
    import numpy as np

    from vvgt_cli.images.files import load_views
    from vvgt_cli.score.views import Views

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
    from vvgt_cli.images.metrics import score_views
    from vvgt_cli.score.views import psnr_note

    with run.stage("test views") as stage:
        before, after = (
            score_views(test.images, test.pictures(g, rule), perceptual=last)
            for g, last in ((start, False), (gaussians, True))
        )
        run.report.scores = asdict(after)
        stage.note = f"{psnr_note(after)}, from {before.psnr:.2f} dB, {after.views} views"
