"""`vvgt optimize`."""

from __future__ import annotations

from typing import Any

import click

from vvgt_cli.cli.fit import rule_option
from vvgt_cli.cli.options import common_options, overwrite_option
from vvgt_cli.progress import Console


@click.command("optimize", short_help="Refine a .ply by gradient descent on views.")
@click.argument("ply", metavar="IN.ply")
@click.option("--views", required=True, metavar="DIR", help="Folder that 'vvgt render-views' wrote.")
@click.option("-o", "--output", required=True, metavar="OUT.ply", help="File to write; - is standard output.")
@click.option("--steps", type=click.IntRange(0, 10_000_000), metavar="N", help="Steps of one view each, at most.")
@click.option(
    "--time-budget", type=click.FloatRange(0, min_open=True), metavar="SECONDS",
    help="In place of --steps: wall time of the descent.",
)  # fmt: skip
@click.option(
    "--target-psnr", type=click.FloatRange(0, 150), metavar="DB", help="End where the check views have this PSNR."
)
@click.option(
    "--method", type=click.Choice(["frame", "adam", "3dgs"]), default="frame", show_default=True,
    help="Steps in each Gaussian's own frame; or, to compare with: plain Adam, Adam with 3DGS' density control.",
)  # fmt: skip
@click.option(
    "--max-gaussians", type=click.IntRange(1, 100_000_000), metavar="K",
    help="Of --method 3dgs: grow to no more than this. Default: as many as IN.ply has.",
)  # fmt: skip
@click.option(
    "--checkpoint", metavar="FILE.npz",
    help="For long runs: written at every look at the check views and at the end; the same command goes on there.",
)  # fmt: skip
@click.option(
    "--size", type=click.IntRange(16, 8192), metavar="PX",
    help="Screen that the file is made for, of which the views are samples. Default: the file's, or the views' size.",
)  # fmt: skip
@rule_option("Viewers to fit to: how they draw a Gaussian. Default: the file's rule, or inria.")
@click.option(
    "--sh-degree", type=click.IntRange(0, 3), metavar="N",
    help="Of the spherical harmonics that are refined: those above it are left out, those that are missing begin with "
    "0. Default: that of IN.ply.",
)  # fmt: skip
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the order of views.")
@click.option("--report", metavar="R.json", help="Write times and errors of every stage as JSON; - is standard output.")
@overwrite_option
@common_options
def command(
    ply: str, views: str, output: str, report: str | None, overwrite: bool, console: Console, **options: Any
) -> None:
    """Refine IN.ply until its pictures match the views in DIR.

    Fitted to the training views, decided by the check views, and scored on the test views, which are used for
    nothing else. What is written is the best that the check views have seen: never worse than IN.ply. A folder
    without check views gives every 8th training view for them. Ctrl-C ends the descent and writes what there is.

    \b
    Examples:
      vvgt render-views head.nrrd --tf bone.json -o views
      vvgt optimize head.ply --views views --steps 200 -o better.ply
      vvgt optimize head.ply --views views --time-budget 60 --target-psnr 40 -o better.ply
    """
    from vvgt_cli.descent import OptimizeOptions
    from vvgt_cli.errors import UsageError
    from vvgt_cli.tasks.optimize import OptimizeRequest, budget, optimize_file

    method, most = options["method"], options["max_gaussians"]
    if most is not None and method != "3dgs":
        raise UsageError(f"--max-gaussians is of --method 3dgs; --method {method} keeps the number as it is")
    how = OptimizeOptions.of(
        method, max_gaussians=most, target_psnr=options["target_psnr"], seed=options["seed"],
        checkpoint=options["checkpoint"],
        **budget(options["steps"], options["time_budget"]),
    )  # fmt: skip
    optimize_file(
        OptimizeRequest(
            ply, views, output, how, options["size"], options["rule"], options["sh_degree"], report, overwrite
        ),
        console,
    )
