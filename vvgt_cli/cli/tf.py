"""`vvgt tf`."""

from __future__ import annotations

import click

from vvgt_cli.cli.options import common_options, overwrite_option, read_options, tf_range_option
from vvgt_cli.progress import Console


@click.group("tf", short_help="Look at transfer functions.")
def command() -> None:
    """Look at transfer functions."""


@command.command("show", short_help="Draw a transfer function over a histogram.")
@click.argument("tf")
@click.option("-o", "--output", required=True, metavar="OUT.png", help="File to write.")
@click.option("--volume", metavar="VOLUME", help="Draw over this volume's histogram.")
@tf_range_option
@read_options
@overwrite_option
@common_options
def show(
    tf: str, output: str, volume: str | None, tf_range: str, read: dict, overwrite: bool, console: Console
) -> None:
    """Draw the colours and the opacity of TF, over the histogram of --volume where one is given.

    \b
    Example:
      vvgt tf show bone.json -o bone.png --volume head.nrrd
    """
    from vvgt_cli.pipeline.show import show_transfer_function
    from vvgt_cli.volume import ReadOptions

    show_transfer_function(tf, output, volume, ReadOptions(**read), tf_range, overwrite)
