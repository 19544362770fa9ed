"""`vvgt merge`."""

from __future__ import annotations

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.progress import Console


@shared.command("merge", short_help="Merge the blocks of 'init --shard' into a .ply.")
@click.argument("folder")
@click.option(
    "-o", "--output", required=True, metavar="OUT.ply",
    help="Output file, or FOLDER/lod-meta.json for streamed levels; - is standard output.",
)  # fmt: skip
@shared.overwrite_option
@shared.common_options
def command(folder: str, output: str, overwrite: bool, console: Console) -> None:
    """Merge the blocks that 'vvgt init --shard I/N' has written to FOLDER into a .ply.

    The volume is no longer needed. FOLDER is left as it is.

    Example:
      vvgt merge huge.blocks -o huge.ply
      vvgt merge huge.blocks -o huge/lod-meta.json
    """
    from vvgt_cli.conversion.merge import merge

    merge(folder, output, overwrite, console)
