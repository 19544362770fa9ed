"""`vvgt evaluate`."""

from __future__ import annotations

from typing import Any

import click

from vvgt_cli.cli.options import common_options, placed_read_options, tf_options
from vvgt_cli.progress import Console


@click.command("evaluate", short_help="How far a .ply is from its volume.")
@click.argument("ply", metavar="OUT.ply")
@click.option("--volume", required=True, metavar="VOLUME", help="The volume that the file was made from.")
@click.option(
    "--size", type=click.IntRange(16, 4096), default=400, show_default=True, metavar="PX", help="Image size at 1x."
)
@click.option(
    "--scale",
    "scales",
    type=click.IntRange(1, 8),
    multiple=True,
    metavar="N",
    default=(1, 2, 4),
    show_default=True,
    help="Score at N times the size; may be repeated.",
)
@click.option(
    "--step", type=click.FloatRange(0, 4, min_open=True), default=0.125, show_default=True, metavar="VOXELS",
    help="Sampling distance of the reference; 0.5 is what convert scores with.",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")
@tf_options
@placed_read_options
@common_options
def command(ply: str, volume: str, as_json: bool, console: Console, **options: Any) -> None:
    """Score OUT.ply against the volume it was made from, on the ten test views, at 1x, 2x and 4x the size.

    The reference is ray-cast with steps of 1/8 voxel and up to 9 rays a pixel; its own error (against half
    the step and up to 36 rays, on the middle of one view) is printed with the scores. Without
    --opacity-unit-distance the one that the file's header records is taken.

    \b
    Example:
      vvgt evaluate head.ply --volume head.nrrd --tf bone.json --scale 1 --scale 2
    """
    from vvgt_cli.cli.fit import source_request
    from vvgt_cli.pipeline.evaluate import EvaluateRequest, evaluate

    source = source_request(volume, options["read"], options["optics"])
    evaluation = evaluate(EvaluateRequest(ply, source, options["size"], options["scales"], options["step"]), console)
    click.echo(evaluation.to_json() if as_json else evaluation.table(), nl=False)
