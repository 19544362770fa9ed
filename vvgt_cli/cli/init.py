"""`vvgt init`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import click

from vvgt_cli.cli.blocks import shared_block_options
from vvgt_cli.cli.fit import fit_options, ply_options
from vvgt_cli.cli.options import common_options, light_options, overwrite_option, placed_read_options, tf_options
from vvgt_cli.progress import Console


@click.command("init", short_help="The closed form alone: no image is rendered.")
@click.argument("volume")
@click.option(
    "-o",
    "--output",
    required=True,
    metavar="OUT.ply",
    help="File to write, in the format of its ending; - is standard output.",
)
@fit_options
@ply_options
@tf_options
@light_options
@placed_read_options
@click.option("--report", metavar="R.json", help="Write the times of every stage as JSON; - is standard output.")
@shared_block_options
@overwrite_option
@common_options
def command(volume: str, console: Console, blocks: dict[str, Any], **options: Any) -> None:
    """Turn VOLUME into Gaussians in closed form, without rendering an image.

    The first stage of 'vvgt convert', for a quick look or as the start of an optimisation elsewhere. What
    'convert' does beyond it: gradient descent on views of the volume, and a score.

    A VOLUME that the memory does not hold is gone through in blocks, by itself or as --blocks, --workers,
    --scheduler and --shard say; the file is the same whatever the blocks and however many are at work.

    \b
    Examples:
      vvgt init example:frog -o frog-init.ply --max-gaussians 20000
      vvgt init huge.zarr -o huge.ply --blocks auto --workers 4 --memory 8G
    """
    from vvgt_cli.cli.blocks import chosen
    from vvgt_cli.cli.fit import convert_request
    from vvgt_cli.conversion.convert import initialise_only
    from vvgt_cli.field.open import automatic
    from vvgt_cli.scale.run import init_in_blocks, streams

    request = convert_request(volume, **options)
    request = replace(request, blocks=chosen(blocks) or automatic(request.source, console))
    (init_in_blocks if streams(request) else initialise_only)(request, console)
