"""`vvgt tf`."""

from __future__ import annotations

from typing import Any

import click

from vvgt_cli.cli.options import common_options, overwrite_option, read_options, tf_range_option
from vvgt_cli.cli.sections import SectionedCommand
from vvgt_cli.progress import Console


@click.group("tf", short_help="Show, convert and suggest transfer functions.")
def command() -> None:
    """Show, convert and suggest transfer functions."""


@command.command("show", cls=SectionedCommand, short_help="Draw a transfer function over a histogram.")
@click.argument("tf")
@click.option("-o", "--output", required=True, metavar="OUT.png", help="Output file.")
@click.option("--volume", metavar="VOLUME", help="Volume whose histogram is drawn behind the function.")
@tf_range_option
@read_options
@overwrite_option
@common_options
def show(
    tf: str, output: str, volume: str | None, tf_range: str, read: dict[str, Any], overwrite: bool, console: Console
) -> None:
    """Draw the colours and opacity of TF, over the histogram of --volume if given.

    Example:
      vvgt tf show bone.json -o bone.png --volume head.nrrd
    """
    from vvgt_cli.commands.tf import show_transfer_function
    from vvgt_cli.volume import ReadOptions

    show_transfer_function(tf, output, volume, ReadOptions(**read), tf_range, overwrite)


@command.command("convert", cls=SectionedCommand, short_help="Write a transfer function in another format.")
@click.argument("tf", metavar="IN")
@click.argument("output", metavar="OUT")
@click.option(
    "--format", "form", type=click.Choice(["minimal", "paraview"]), default="minimal", show_default=True,
    help="Minimal JSON, which stores the unit distance, or a ParaView preset, which stores midpoints and sharpness.",
)  # fmt: skip
@tf_range_option
@overwrite_option
@common_options
def convert(tf: str, output: str, form: str, tf_range: str, overwrite: bool, console: Console) -> None:
    """Convert the transfer function IN (any supported format, or the name of a colour map) to the JSON file OUT.

    Features that the format cannot store are an error. OUT may be - for standard output.

    Examples:
      vvgt tf convert CT-Bone.vp bone.json
      vvgt tf convert plasma.itf plasma.json --tf-range 0,255 --format paraview
    """
    from vvgt_cli.commands.tf import convert_transfer_function

    convert_transfer_function(tf, output, form, tf_range, overwrite, console)


@command.command("list", cls=SectionedCommand, short_help="List the named functions.")
@common_options
def list_named(console: Console) -> None:
    """Print the names of the built-in functions, which --tf and 'vvgt tf' accept, and what each shows.

    Examples:
      vvgt tf list
      vvgt tf convert ct-bone mine.json
    """
    from vvgt_cli.look.readers.names import names

    found = names()
    for name, shows in found.items():
        click.echo(f"{name:<{max(map(len, found)) + 2}}{shows}")


@command.command("suggest", cls=SectionedCommand, short_help="Suggest functions that each show one range of values.")
@click.argument("volume")
@click.option(
    "-n", "--number", type=click.IntRange(1, 100), default=10, show_default=True, metavar="N",
    help="Number of functions.",
)  # fmt: skip
@click.option("-o", "--output", required=True, metavar="DIR", help="Output directory, created if missing.")
@read_options
@overwrite_option
@common_options
def suggest(volume: str, number: int, output: str, read: dict[str, Any], overwrite: bool, console: Console) -> None:
    """Write N transfer functions for VOLUME, each showing one range of values in its own colour.

    The background is excluded and the remaining values are divided evenly, half by value and half by number of
    voxels. The files are minimal JSON, ready to use or edit; their paths are printed.

    Example:
      vvgt tf suggest head.nrrd -n 10 -o bands
    """
    from vvgt_cli.commands.tf import suggest_transfer_functions
    from vvgt_cli.volume import ReadOptions

    for path in suggest_transfer_functions(volume, number, output, ReadOptions(**read), overwrite, console):
        click.echo(path)
