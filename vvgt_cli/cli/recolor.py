"""`vvgt recolor`."""

from __future__ import annotations

import click

from vvgt_cli.cli.options import common_options, overwrite_option, tf_range_option, unit_distance_option
from vvgt_cli.progress import Console


@click.command("recolor", short_help="Show a live .ply under another transfer function.")
@click.argument("ply", metavar="LIVE.ply")
@click.option(
    "--tf", required=True, metavar="TF", help="Transfer function: a file or the name of a matplotlib colour map."
)
@click.option(
    "-o", "--output", required=True, metavar="OUT.ply",
    help="Output file; its ending selects the format, - is standard output.",
)  # fmt: skip
@tf_range_option
@unit_distance_option
@overwrite_option
@common_options
def command(
    ply: str, tf: str, output: str, tf_range: str, opacity_unit_distance: str | None, overwrite: bool, console: Console
) -> None:
    """Write what LIVE.ply, made by 'vvgt convert --live', is under the transfer function TF, as an ordinary file.

    The volume is not needed. Gaussians that TF hides are left out. LIVE.ply may be "-".

    \b
    Examples:
      vvgt recolor head-live.ply --tf bone.json -o bone.ply
      vvgt recolor head-live.ply --tf skin.json -o skin.html
    """
    from vvgt_cli.commands.recolor import RecolorRequest, recolor
    from vvgt_cli.conversion.recolored import FunctionRequest

    function = FunctionRequest(tf, tf_range, opacity_unit_distance)
    recolor(RecolorRequest(ply, function, output, overwrite), console)
