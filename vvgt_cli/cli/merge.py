"""`vvgt merge`."""

from __future__ import annotations

import click

from vvgt_cli.cli.blocks import levels_option
from vvgt_cli.cli.options import common_options, overwrite_option
from vvgt_cli.progress import Console


@click.command("merge", short_help="A .ply of the blocks that the shards of 'init' have left.")
@click.argument("folder")
@click.option("-o", "--output", required=True, metavar="OUT.ply", help="File to write; - is standard output.")
@levels_option
@overwrite_option
@common_options
def command(folder: str, output: str, levels: int, overwrite: bool, console: Console) -> None:
    """Make a .ply of FOLDER, in which 'vvgt init --shard I/N' has left the blocks of a volume.

    The volume is not needed any more. FOLDER stays as it is.

    \b
    Example:
      vvgt merge huge.blocks -o huge.ply
    """
    from vvgt_cli.scale.run import merge

    merge(folder, output, overwrite, console, levels)
