"""`vvgt init`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.progress import Console


@shared.command("init", short_help="Compute the closed form only, without rendering.")
@click.argument("volume")
@shared.output_option
@shared.tf_options
@shared.fit_options
@shared.light_options
@shared.overwrite_option
@shared.ply_options
@shared.placed_read_options
@click.option("--report", metavar="R.json", help="Save the times of all stages as JSON; - is standard output.")
@shared.shared_block_options
@shared.common_options
def command(volume: str, console: Console, blocks: dict[str, Any], **options: Any) -> None:
    """Compute Gaussians of VOLUME in closed form, without rendering an image.

    This is the first stage of 'vvgt convert', for a quick look or as the start of an optimisation elsewhere.

    Volumes larger than memory are processed in blocks, automatically or as set by --blocks, --workers, --scheduler
    and --shard. The output does not depend on the partition.

    Examples:
      vvgt init example:frog -o frog-init.ply --max-gaussians 20000
      vvgt init huge.zarr -o huge.ply --blocks auto --workers 4 --memory 8G
    """
    from vvgt_cli.conversion.convert_batch import convert_files

    request = shared.convert_request(volume, **options)
    fit = replace(request.fit, steps=0)
    convert_files(replace(request, blocks=shared.block_options_of(blocks), fit=fit, scored=False), console=console)
