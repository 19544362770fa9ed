"""`vvgt infer`."""

from __future__ import annotations

import click

from vvgt_cli.cli.options import common_options, overwrite_option
from vvgt_cli.cli.sections import SectionedCommand
from vvgt_cli.progress import Console


@click.command("infer", cls=SectionedCommand, short_help="Improve a .ply with an exported network.")
@click.argument("ply", metavar="IN.ply")
@click.option("--views", required=True, metavar="DIR", help="Views of the volume, written by 'vvgt render-views'.")
@click.option(
    "--model", required=True, metavar="NAME", help="Folder written by 'vvgt export', or the name of a shipped model."
)
@click.option("-o", "--output", required=True, metavar="OUT.ply", help="Output file; - is standard output.")
@click.option(
    "--provider", type=click.Choice(["cpu", "cuda"]), default="cpu", show_default=True, help="Device for onnxruntime."
)
@click.option("--report", metavar="FILE.json", help="Save stages, times and scores as JSON.")
@overwrite_option
@common_options
def command(
    ply: str, views: str, model: str, output: str, provider: str, report: str | None, overwrite: bool, console: Console
) -> None:
    """Improve the Gaussians of IN.ply with a network that looks at views of their volume.

    The network reads a fixed number of training views, chosen far apart. Up to four other views judge the result: if
    their PSNR does not rise, the Gaussians of IN.ply are written unchanged and a message says so. IN.ply may be "-".

    Example:
      vvgt render-views head.nrrd --tf bone.json -o views
      vvgt init head.nrrd --tf bone.json -o - | vvgt infer - --views views --model small -o head.ply
    """
    from vvgt_cli.commands.infer import InferRequest, infer_file

    infer_file(InferRequest(ply, views, model, output, provider, report, overwrite), console)
