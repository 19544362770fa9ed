"""`vvgt evaluate`."""

from __future__ import annotations

from typing import Any

import click

from vvgt_cli.cli.fit import rule_option
from vvgt_cli.cli.options import common_options, light_options, overwrite_option, placed_read_options, tf_options
from vvgt_cli.progress import Console


@click.command("evaluate", short_help="How far a .ply is from its volume.")
@click.argument("ply", metavar="OUT.ply")
@click.option("--volume", required=True, metavar="VOLUME", help="The volume that the file was made from.")
@click.option(
    "--size", type=click.IntRange(16, 8192), metavar="PX",
    help="Image size to score at. Default: what the file is made for, or 400.",
)  # fmt: skip
@rule_option("How to draw: as which viewers do. Default: the file's rule, or inria.")
@click.option(
    "--no-seats", "seats", is_flag=True, default=True, flag_value=False,
    help="Leave out the table of every rule, several sizes and close-ups, and the texture of smooth areas.",
)  # fmt: skip
@click.option(
    "--step", type=click.FloatRange(0, 4, min_open=True), default=0.125, show_default=True, metavar="VOXELS",
    help="Sampling distance of the reference; 0.5 is what convert scores with.",
)  # fmt: skip
@click.option(
    "--preview", metavar="FILE.png",
    help="Reference, result and 8 times their difference, of a test view from the side and close up.",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")
@tf_options
@light_options
@placed_read_options
@overwrite_option
@common_options
def command(ply: str, volume: str, as_json: bool, console: Console, **options: Any) -> None:
    """Score OUT.ply against the volume it was made from: on the ten test views, and from every seat.

    A seat is a rule of drawing (docs/viewers.md), a size (400, 800, the file's own and 2160 px) or a close-up
    (field of view 10 degrees); three test views each, worst first. Large pictures are scored on blocks of 16 px.
    The reference is ray-cast with steps of 1/8 voxel and up to 9 rays a pixel (seats: as convert's); its own
    error is printed with the scores. Size, rule, light and --opacity-unit-distance are the file's own unless given.

    \b
    Example:
      vvgt evaluate head.ply --volume head.nrrd --tf bone.json --json
    """
    from vvgt_cli.cli.fit import source_request
    from vvgt_cli.tasks.evaluate import EvaluateRequest, evaluate

    source = source_request(volume, options["read"], options["optics"], options["light"])
    names = ("size", "rule", "step", "seats", "preview", "overwrite")
    evaluation = evaluate(EvaluateRequest(ply, source, **{name: options[name] for name in names}), console)
    click.echo(evaluation.to_json() if as_json else evaluation.table(), nl=False)
