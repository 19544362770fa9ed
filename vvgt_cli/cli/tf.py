"""`vvgt tf`."""

from __future__ import annotations

from typing import Any

import click

from vvgt_cli.cli.options import common_options, overwrite_option, read_options, tf_range_option
from vvgt_cli.progress import Console


@click.group("tf", short_help="Look at transfer functions, convert them, or have some made.")
def command() -> None:
    """Look at transfer functions, convert them, or have some made."""


@command.command("show", short_help="Draw a transfer function over a histogram.")
@click.argument("tf")
@click.option("-o", "--output", required=True, metavar="OUT.png", help="File to write.")
@click.option("--volume", metavar="VOLUME", help="Draw over this volume's histogram.")
@tf_range_option
@read_options
@overwrite_option
@common_options
def show(
    tf: str, output: str, volume: str | None, tf_range: str, read: dict[str, Any], overwrite: bool, console: Console
) -> None:
    """Draw the colours and the opacity of TF, over the histogram of --volume where one is given.

    \b
    Example:
      vvgt tf show bone.json -o bone.png --volume head.nrrd
    """
    from vvgt_cli.tasks.show import show_transfer_function
    from vvgt_cli.volume import ReadOptions

    show_transfer_function(tf, output, volume, ReadOptions(**read), tf_range, overwrite)


@command.command("convert", short_help="Write a transfer function in another format.")
@click.argument("tf", metavar="IN")
@click.argument("output", metavar="OUT")
@click.option(
    "--format", "form", type=click.Choice(["minimal", "paraview"]), default="minimal", show_default=True,
    help="Minimal JSON, which holds the unit distance, or a ParaView preset, which holds midpoints and sharpness.",
)  # fmt: skip
@tf_range_option
@overwrite_option
@common_options
def convert(tf: str, output: str, form: str, tf_range: str, overwrite: bool, console: Console) -> None:
    """Write the transfer function IN (any format that is read, or the name of a colour map) as the JSON file OUT.

    What the format cannot hold is refused, and named. OUT may be - for standard output.

    \b
    Examples:
      vvgt tf convert CT-Bone.vp bone.json
      vvgt tf convert plasma.itf plasma.json --tf-range 0,255 --format paraview
    """
    from vvgt_cli.tasks.tf_convert import convert_transfer_function

    convert_transfer_function(tf, output, form, tf_range, overwrite, console)


@command.command("suggest", short_help="Make functions that show a range of values each.")
@click.argument("volume")
@click.option(
    "-n", "--number", type=click.IntRange(1, 100), default=10, show_default=True, metavar="N", help="Functions to make."
)
@click.option("-o", "--output", required=True, metavar="DIR", help="Directory for the files; made if it is not there.")
@read_options
@overwrite_option
@common_options
def suggest(volume: str, number: int, output: str, read: dict[str, Any], overwrite: bool, console: Console) -> None:
    """Write N transfer functions for VOLUME, each of which shows one range of its values in a colour of its own.

    The ranges follow from the histogram: the background is left out, the rest is shared evenly, half by value
    and half by number of voxels. The files are minimal JSON, to be used as they are or edited; their paths go
    to standard output.

    \b
    Example:
      vvgt tf suggest head.nrrd -n 10 -o bands
    """
    from vvgt_cli.tasks.suggest import suggest_transfer_functions
    from vvgt_cli.volume import ReadOptions

    for path in suggest_transfer_functions(volume, number, output, ReadOptions(**read), overwrite, console):
        click.echo(path)
