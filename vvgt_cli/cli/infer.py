"""`vvgt infer`."""

from __future__ import annotations

import click

from vvgt_cli.cli.options import common_options, overwrite_option
from vvgt_cli.progress import Console


@click.command("infer", short_help="Improve a .ply by an exported network.")
@click.argument("ply", metavar="IN.ply")
@click.option("--views", required=True, metavar="DIR", help="Views of the volume: a folder of 'vvgt render-views'.")
@click.option("--model", required=True, metavar="NAME", help="Folder of 'vvgt export', or the name of a shipped model.")
@click.option("-o", "--output", required=True, metavar="OUT.ply", help="File to write; - for standard output.")
@click.option(
    "--provider", type=click.Choice(["cpu", "cuda"]), default="cpu", show_default=True, help="What onnxruntime runs on."
)
@click.option("--report", metavar="FILE.json", help="Write stages, times and scores as JSON.")
@overwrite_option
@common_options
def command(
    ply: str, views: str, model: str, output: str, provider: str, report: str | None, overwrite: bool, console: Console
) -> None:
    """Put the Gaussians of IN.ply and views of their volume through a network, and write what it makes of them.

    The network reads as many of the training views as it is made for, those that stand farthest apart. Up to four
    views that it does not read judge: where their PSNR does not rise, the Gaussians of IN.ply are written as they
    are, and the run says so. IN.ply may be "-".

    \b
    Example:
      vvgt render-views head.nrrd --tf bone.json -o views
      vvgt init head.nrrd --tf bone.json -o - | vvgt infer - --views views --model small -o head.ply
    """
    from vvgt_cli.tasks.infer import InferRequest, infer_file

    infer_file(InferRequest(ply, views, model, output, provider, report, overwrite), console)
