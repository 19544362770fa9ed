"""`vvgt recolor`."""

from __future__ import annotations

from typing import Any

import click

from vvgt_cli.cli.options import (
    common_options,
    iso_option,
    layer_looks_option,
    output_option,
    overwrite_option,
    relight_options,
    tf_range_option,
    unit_distance_option,
)
from vvgt_cli.cli.sections import SectionedCommand
from vvgt_cli.progress import Console


@click.command("recolor", cls=SectionedCommand, short_help="Show a live .ply under another function or light.")
@click.argument("ply", metavar="LIVE.ply")
@click.option(
    "--tf", metavar="TF",
    help="Transfer function: a file or the name of a matplotlib colour map. Default: the file's own.",
)  # fmt: skip
@iso_option
@output_option
@click.option(
    "--labels", metavar="TABLE|auto",
    help="Table of labels, for a file of a label map; opacity 0 hides a label. Default: the file's own.",
)  # fmt: skip
@layer_looks_option
@tf_range_option
@unit_distance_option
@relight_options
@overwrite_option
@common_options
def command(
    ply: str, tf: str | None, labels: str | None, layers: tuple[str, ...], output: str, tf_range: str,
    opacity_unit_distance: str | None, light: dict[str, Any], overwrite: bool, console: Console,
) -> None:  # fmt: skip
    """Write LIVE.ply, made by 'vvgt convert --live', as an ordinary file under another function, table or light.

    The volume is not needed. Gaussians that TF hides are omitted. LIVE.ply may be "-".

    Examples:
      vvgt recolor head-live.ply --tf bone.json -o bone.ply
      vvgt recolor head-live.ply --tf skin.json --light headlight -o skin.html
      vvgt recolor cells-live.ply --layer 1,tf=magenta.json -o cells.ply
    """
    from vvgt_cli.commands.recolor import RecolorRequest, function_of, recolor
    from vvgt_cli.conversion.recolored import FunctionRequest

    function = function_of(tf, tf_range, opacity_unit_distance, labels, light, layers) or FunctionRequest()
    recolor(RecolorRequest(ply, function, output, overwrite), console)
