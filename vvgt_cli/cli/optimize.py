"""`vvgt optimize`."""

from __future__ import annotations

from typing import Any

import click

from vvgt_cli.cli.fit import rule_option
from vvgt_cli.cli.options import SECONDS, Measure, common_options, device_option, overwrite_option
from vvgt_cli.cli.sections import SectionedCommand
from vvgt_cli.progress import Console


@click.command("optimize", cls=SectionedCommand, short_help="Refine a .ply by gradient descent on views.")
@click.argument("ply", metavar="IN.ply")
@click.option("--views", required=True, metavar="DIR", help="Views of the volume, written by 'vvgt render-views'.")
@click.option("-o", "--output", required=True, metavar="OUT.ply", help="Output file; - is standard output.")
@click.option(
    "--steps", type=click.IntRange(0, 10_000_000), metavar="N", help="Maximum number of steps, one view each."
)
@click.option(
    "--time-budget", type=Measure("time", SECONDS), metavar="TIME",
    help="Time for the descent, such as 90 or 10m, instead of --steps.",
)  # fmt: skip
@click.option(
    "--target-psnr", type=click.FloatRange(0, 150), metavar="DB", help="Stop when the check views reach this PSNR."
)
@click.option(
    "--method", type=click.Choice(["frame", "adam", "3dgs"]), default="frame", show_default=True,
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
    "--size", type=click.IntRange(16, 8192), metavar="PX",
    help="Screen size to optimise for, in pixels. Default: the size recorded in IN.ply, or that of the views.",
)  # fmt: skip
@rule_option("Viewer to optimise for. Default: the one recorded in IN.ply, or inria.")
@click.option(
    "--sh-degree", type=click.IntRange(0, 3), metavar="N",
    help="Degree of the spherical harmonics to refine; missing ones start at 0. Default: that of IN.ply.",
)  # fmt: skip
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Random seed for the order of views."
)
@click.option("--report", metavar="R.json", help="Save times and errors of all stages as JSON; - is standard output.")
@device_option("steps of --method frame are taken")
@overwrite_option
@common_options
def command(
    ply: str, views: str, output: str, report: str | None, overwrite: bool, console: Console, **options: Any
) -> None:
    """Refine IN.ply so that its pictures match the views in DIR.

    Training views are fitted, check views decide what is kept, and test views only score the result. The best state
    on the check views is written, never worse than IN.ply. If the folder has no check views, every 8th training view
    is used instead. Ctrl-C ends the descent early and writes the result.

    Examples:
      vvgt render-views head.nrrd --tf bone.json -o views
      vvgt optimize head.ply --views views --steps 200 -o better.ply
      vvgt optimize head.ply --views views --time-budget 60 --target-psnr 40 -o better.ply
    """
    from vvgt_cli.commands.optimize import OptimizeRequest, budget, optimize_file
    from vvgt_cli.errors import UsageError
    from vvgt_cli.refine import OptimizeOptions

    method, most = options["method"], options["max_gaussians"]
    if most is not None and method != "3dgs":
        raise UsageError(f"--max-gaussians applies to --method 3dgs; --method {method} does not change the number")
    how = OptimizeOptions.of(
        method, max_gaussians=most, target_psnr=options["target_psnr"], seed=options["seed"],
        checkpoint=options["checkpoint"], device=options["device"],
        **budget(options["steps"], options["time_budget"]),
    )  # fmt: skip
    optimize_file(
        OptimizeRequest(
            ply, views, output, how, options["size"], options["rule"], options["sh_degree"], report, overwrite
        ),
        console,
    )
