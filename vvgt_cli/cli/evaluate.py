"""`vvgt evaluate`."""

from __future__ import annotations

from typing import Any

import click

from vvgt_cli.cli.blocks import block_options
from vvgt_cli.cli.fit import rule_option, target_option
from vvgt_cli.cli.options import common_options, light_options, overwrite_option, placed_read_options, tf_options
from vvgt_cli.cli.sections import SectionedCommand
from vvgt_cli.progress import Console


@click.command("evaluate", cls=SectionedCommand, short_help="Measure the error of a .ply against its volume.")
@click.argument("ply", metavar="OUT.ply")
@click.option("--volume", required=True, metavar="VOLUME", help="Volume that OUT.ply was made from.")
@click.option(
    "--size", type=click.IntRange(16, 8192), metavar="PX",
    help="Image size to score at. Default: the size recorded in the file, or 400.",
)  # fmt: skip
@rule_option("Viewer to imitate when drawing. Default: the one recorded in the file, or inria.")
@target_option("Device to score it on: by its size and rule unless given, on a headset also as both eyes see it.")
@click.option(
    "--no-conditions", "conditions", is_flag=True, default=True, flag_value=False,
    help="Skip the table of viewing conditions (viewers, sizes, close-ups) and the texture of smooth areas.",
)  # fmt: skip
@click.option(
    "--step", type=click.FloatRange(0, 4, min_open=True), default=0.125, show_default=True, metavar="VOXELS",
    help="Sampling distance of the reference, in voxels; 'vvgt convert' uses 0.5.",
)  # fmt: skip
@click.option(
    "--preview", metavar="FILE.png",
    help="Save volume, splats and difference side by side, from the side and close up.",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")
@tf_options
@light_options
@placed_read_options
@block_options
@overwrite_option
@common_options
def command(ply: str, volume: str, as_json: bool, blocks: dict[str, Any], console: Console, **options: Any) -> None:
    """Score OUT.ply against the volume it was made from.

    OUT.ply may be a FOLDER of streamed levels, scored at the finest level; FOLDER#1 is level 1.

    Scores are means over ten test views. A table lists the viewing conditions, worst first: how each viewer draws
    (docs/viewers.md), at 400, 800 and 2160 px and the file's own size, and close up, in three views each. Pictures
    above 565 px are scored on a sample of blocks. A .ply of 'vvgt convert --live' is scored under --tf.

    The reference is ray-cast with steps of 1/8 voxel and up to 9 rays per pixel; its own error is printed too. Size,
    viewer, light and opacity unit distance are those recorded in the file unless given.

    Example:
      vvgt evaluate head.ply --volume head.nrrd --tf bone.json --json
    """
    from vvgt_cli.cli.blocks import block_options_of
    from vvgt_cli.cli.fit import source_request
    from vvgt_cli.commands.evaluate import EvaluateRequest, evaluate

    source = source_request(volume, options["read"], options["optics"], options["light"])
    names = ("size", "rule", "step", "conditions", "preview", "overwrite", "target")
    asked = {name: options[name] for name in names}
    evaluation = evaluate(EvaluateRequest(ply, source, blocks=block_options_of(blocks), **asked), console)
    click.echo(evaluation.to_json() if as_json else evaluation.table(), nl=False)
