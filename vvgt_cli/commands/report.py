"""`vvgt report`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Unpack

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.commands.words import command_line, typed
from vvgt_cli.defaults import MAX_GAUSSIANS, REPORT_STEPS, SIZE
from vvgt_cli.errors import UsageError

if TYPE_CHECKING:
    from vvgt_cli.field.settings import BlockOptions
    from vvgt_cli.library.inputs import LookLike, PathLike, Reading, VolumeLike
    from vvgt_cli.progress import Console

COMPARE_PARAMETERS = {"paths", "compare", "output", "overwrite", "threads", "quiet"}


def report(
    volume: VolumeLike, look: LookLike, output: PathLike, *, max_gaussians: int = MAX_GAUSSIANS, screen: int = SIZE,
    steps: Sequence[int] = REPORT_STEPS, model: str | None = None, seed: int = 0, peers: Sequence[str] = (),
    picture_size: int = 400, blocks: int | str | BlockOptions | None = None, overwrite: bool = False,
    progress: bool | Console = False, command: str | None = None, **reading: Unpack[Reading],
) -> dict[str, Any]:  # fmt: skip
    """Convert a volume in increasingly expensive ways, and write what each costs and gains: ``vvgt report``.

    Args:
        volume: as in `convert`.
        look: as in `convert`.
        output: folder to write, created if missing.
        max_gaussians: maximum number of Gaussians; the closed form also runs with 1/64, 1/16 and 1/4 of it.
        screen: pixels along the edge of the screen that files are made for and scored at.
        steps: numbers of gradient descent steps, one run each.
        model: network: a folder, or the name of a shipped one; None: the shipped one, if any.
        seed: random seed.
        peers: other trainers, ``NAME=COMMAND`` each.
        picture_size: largest edge of the pictures on the page, in pixels.
        blocks: as in `convert`.
        overwrite: replace files that exist.
        progress: print messages and bars on standard error.
        command: command line that the report records.
        **reading: as in `convert`.

    Returns:
        The content of the folder's ``report.json`` (docs/report.md).

    Raises:
        UsageError, DataError: see `convert`.
    """
    from vvgt_cli.commands.peers import Peer
    from vvgt_cli.commands.report_runs import report_on
    from vvgt_cli.conversion.request import FitOptions
    from vvgt_cli.library.inputs import console_of, requests_of

    fit = FitOptions(max_gaussians, screen, seed=seed, model=model)
    requests, _ = requests_of(
        volume, look, reading, output=output, fit=fit, blocks=blocks, overwrite=overwrite, command=command
    )
    return report_on(requests[""], steps, [Peer.of(one) for one in peers], picture_size, console_of(progress))


@shared.command("report", short_help="Plot error against run time, as an HTML page and tables.")
@click.argument("paths", nargs=-1, required=True, metavar="VOLUME | A.json B.json ...")
@click.option("-o", "--output", required=True, metavar="DIR", help="Output folder, created if missing.")
@click.option(
    "--compare", is_flag=True, help="Overlay existing reports: report.json files, or JSON of 'vvgt convert --report'."
)
@click.option(
    "--max-gaussians", type=click.IntRange(1, 100_000_000), default=MAX_GAUSSIANS, show_default=True, metavar="K",
    help="Maximum number of Gaussians; the closed form also runs with 1/64, 1/16 and 1/4 of it.",
)  # fmt: skip
@click.option(
    "--screen", type=click.IntRange(16, 2048), default=SIZE, show_default=True, metavar="PX",
    help="Screen size that files are optimised for and scored at.",
)  # fmt: skip
@click.option(
    "--steps", type=click.IntRange(1, 10_000_000), multiple=True, default=REPORT_STEPS, show_default=True,
    metavar="N", help="Number of gradient descent steps. Repeatable, one run each; the baselines use the largest.",
)  # fmt: skip
@click.option(
    "--peer", "peers", multiple=True, metavar="NAME=COMMAND",
    help="Another trainer to run and score: {views} in COMMAND is a folder of 'vvgt render-views', {out} the .ply that "
    "it writes. Repeatable.",
)  # fmt: skip
@click.option(
    "--picture-size", type=click.IntRange(16, 2048), default=400, show_default=True, metavar="PX",
    help="Maximum size of the pictures on the page.",
)  # fmt: skip
@click.option(
    "--model", metavar="MODEL",
    help="Network: a folder written by 'vvgt export', or the name of a shipped model. Default: the shipped one, if "
    "any.",
)  # fmt: skip
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Random seed.")
@shared.tf_options
@shared.light_options
@shared.read_options
@shared.block_options
@shared.overwrite_option
@shared.common_options
@click.pass_context
def command(ctx: click.Context, /, paths: tuple[str, ...], compare: bool, **options: Any) -> None:
    """Convert VOLUME in increasingly expensive ways and show what each costs and gains.

    Runs the closed form with several budgets, a network if there is one, gradient descent of several lengths, and two
    baselines: 3DGS from random points, and the iVR-GS setting (3DGS from samples of the volume). Each run is timed
    separately, including its views, and scored on the same ten test views. DIR gets report.html (one file, works
    offline), report.json, report.csv and four PNG plots.

    Examples:
      vvgt report head.nrrd --tf bone.json -o head-report
      vvgt report example:frog --screen 200 --max-gaussians 20000 --steps 25 --steps 100 -o frog-report
      vvgt report --compare head-report/report.json other/report.json -o both
    """
    if compare:
        from vvgt_cli.commands.report_runs import compare as overlay

        other = [p.opts[-1] for p in typed(ctx) if p.name not in COMPARE_PARAMETERS]
        if other:
            raise UsageError(f"{', '.join(other)}: not with --compare, which only overlays reports")
        overlay(paths, options["output"], options["overwrite"], options["console"])
        return
    if len(paths) != 1:
        raise UsageError(f"{len(paths)} volumes; expected one (reports to overlay need --compare)")
    report(paths[0], command=command_line(ctx), **shared.arguments(**options))
