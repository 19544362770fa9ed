"""`vvgt render`."""

from __future__ import annotations

from typing import Any

import click

from vvgt_cli.cli.fit import rule_option
from vvgt_cli.cli.options import (
    common_options,
    layer_looks_option,
    overwrite_option,
    relight_options,
    tf_range_option,
    unit_distance_option,
)
from vvgt_cli.progress import Console


@click.command("render", short_help="Render pictures or a movie of a .ply.")
@click.argument("ply", metavar="OUT.ply")
@click.option("--camera", metavar="FILE", help="Camera poses from a transforms.json, in the unit frame.")
@click.option("--orbit", type=click.IntRange(1, 10_000), metavar="N", help="N views on a circle around the up axis.")
@click.option(
    "--size",
    type=click.IntRange(1, 16384),
    metavar="PX",
    help="Image height in pixels. Default: that of the camera file, for an orbit the size recorded in the .ply, or "
    "400.",
)
@click.option(
    "-o", "--output", required=True, metavar="DIR|FILE",
    help="Output directory, created if missing, or a movie such as turn.gif or turn.mp4.",
)  # fmt: skip
@click.option("--exr", is_flag=True, help="Also write float EXR images (premultiplied RGBA).")
@click.option(
    "--background",
    type=float,
    nargs=3,
    metavar="R G B",
    help="Background colour, 0 to 1. Default: transparent for PNG, black for movies.",
)
@click.option("--labels", metavar="TABLE|auto", help="Table of labels to show a live .ply of a label map under.")
@click.option("--tf", metavar="TF", help="Transfer function to show a .ply of 'vvgt convert --live' under.")
@layer_looks_option
@tf_range_option
@unit_distance_option
@relight_options
@rule_option("Viewer to imitate when drawing. Default: the one recorded in the file, or inria.")
@overwrite_option
@common_options
def command(
    ply: str,
    camera: str | None,
    orbit: int | None,
    size: int | None,
    rule: str | None,
    output: str,
    exr: bool,
    background: tuple[float, float, float] | None,
    tf: str | None,
    labels: str | None,
    layers: tuple[str, ...],
    tf_range: str,
    opacity_unit_distance: str | None,
    light: dict[str, Any],
    overwrite: bool,
    console: Console,
) -> None:
    """Render the Gaussians of OUT.ply as viewers do: one PNG per view and a transforms.json.

    Choose the views with --camera or --orbit. With -o turn.gif or turn.mp4 they become a movie at 25 frames per second,
    which loops seamlessly for an orbit. The up axis is the one recorded in OUT.ply, else +z. OUT.ply may be "-",
    or FOLDER of streamed levels: FOLDER#1 is its level 1, FOLDER#view what viewers show each camera.
    A .ply of 'vvgt convert --live' can be shown under any function (--tf) and light (--light).

    Examples:
      vvgt render frog.ply --orbit 36 --size 800 -o turn
      vvgt render frog.ply --orbit 100 --size 480 -o turn.gif
      vvgt convert example:frog -o - | vvgt render - --orbit 8 -o turn
    """
    from vvgt_cli.commands.recolor import function_of
    from vvgt_cli.commands.render import RenderRequest, render_file
    from vvgt_cli.errors import UsageError

    if (camera is None) == (orbit is None):
        raise UsageError("give the views with either --camera FILE or --orbit N")
    if background is not None and not all(0 <= c <= 1 for c in background):
        raise UsageError(f"--background {' '.join(map(str, background))}: expected three numbers in [0, 1]")
    function = function_of(tf, tf_range, opacity_unit_distance, labels, light, layers)
    render_file(RenderRequest(ply, output, camera, orbit, size, rule, exr, background, overwrite, function), console)
