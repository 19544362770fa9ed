"""`vvgt evaluate`: scores of Gaussians against their volume."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Unpack

import click

from vvgt_cli.commands import options as shared

if TYPE_CHECKING:
    from vvgt_cli.commands.evaluation import Evaluation
    from vvgt_cli.conversion.result import Result
    from vvgt_cli.field.settings import BlockOptions
    from vvgt_cli.library.inputs import LookLike, PathLike, Reading, VolumeLike
    from vvgt_cli.progress import Console


def evaluate(
    ply: PathLike | Result, volume: VolumeLike, look: LookLike = None, *, screen: int | None = None,
    rule: str | None = None, target: str | None = None, conditions: bool = True, step: float = 0.125,
    preview: PathLike | None = None, blocks: int | str | BlockOptions | None = None, overwrite: bool = False,
    progress: bool | Console = False, **reading: Unpack[Reading],
) -> Evaluation:  # fmt: skip
    """Score Gaussians against their volume: ``vvgt evaluate``.

    Args:
        ply: path, "-" for standard input, or result of `convert` or `optimize`.
        volume: as in `convert`.
        look: as in `convert`.
        screen: pixels along the edge of pictures; None: the file's.
        rule: drawing rule; None: the file's.
        target: device to score it on, as ``--for``.
        conditions: also score every rule at several sizes and close up, and texture on smooth areas.
        step: step of the reference, in voxels.
        preview: PNG to write: volume, splats and difference.
        blocks: as in `convert`.
        overwrite: replace the preview if it exists.
        progress: print messages and bars on standard error.
        **reading: as in `convert`.

    Raises:
        DataError, UsageError: see `convert`.
    """
    from vvgt_cli.commands.evaluation import score
    from vvgt_cli.library.inputs import blocks_of, console_of, ply_of, source_of

    return score(
        console_of(progress), ply_of(ply), source_of(volume, look, reading), blocks_of(blocks), screen=screen,
        rule=rule, target=target, conditions=conditions, step=step, preview=preview, overwrite=overwrite,
    )  # fmt: skip


@shared.command("evaluate", short_help="Measure the error of a .ply against its volume.")
@click.argument("ply", metavar="OUT.ply")
@click.option("--volume", required=True, metavar="VOLUME", help="Volume that OUT.ply was made from.")
@click.option(
    "--screen", type=click.IntRange(16, 8192), metavar="PX",
    help="Screen size to score at, in pixels. Default: the one recorded in the file, or 400.",
)  # fmt: skip
@shared.rule_option("Viewer to imitate when drawing. Default: the one recorded in the file, or inria.")
@shared.target_option(
    "Device to score it on: by its size and rule unless given, on a headset also as both eyes see it."
)
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
@shared.json_option
@shared.tf_options
@shared.light_options
@shared.placed_read_options
@shared.block_options
@shared.overwrite_option
@shared.common_options
def command(as_json: bool, **options: Any) -> None:
    """Score OUT.ply against the volume it was made from.

    OUT.ply may be a FOLDER of streamed levels, scored as viewers show them; FOLDER#0 is the finest.

    Scores are means over ten test views. A table lists the viewing conditions, worst first: how each viewer draws
    (docs/viewers.md), at 400, 800 and 2160 px and the file's own size, and close up, in three views each. Pictures
    above 565 px are scored on a sample of blocks. A .ply of 'vvgt convert --live' is scored under --tf.

    The reference is ray-cast with steps of 1/8 voxel and up to 9 rays per pixel; its own error is printed too. Size,
    viewer, light and opacity unit distance are those recorded in the file unless given.

    Example:
      vvgt evaluate head.ply --volume head.nrrd --tf bone.json --json
    """
    scores = evaluate(**shared.arguments(**options))
    click.echo(scores.to_json() if as_json else scores.table(), nl=False)
