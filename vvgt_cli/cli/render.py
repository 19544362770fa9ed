"""`vvgt render`."""

from __future__ import annotations

import click

from vvgt_cli.cli.fit import rule_option
from vvgt_cli.cli.options import common_options, overwrite_option
from vvgt_cli.progress import Console


@click.command("render", short_help="Pictures of a .ply, or a movie.")
@click.argument("ply", metavar="OUT.ply")
@click.option("--camera", metavar="FILE", help="Views of a transforms.json (in the unit frame).")
@click.option("--orbit", type=click.IntRange(1, 10_000), metavar="N", help="N views on a circle around the way up.")
@click.option(
    "--size",
    type=click.IntRange(1, 16384),
    metavar="PX",
    help="Image height. Default: the view set's, for an orbit what the .ply is made for, or 400.",
)
@click.option(
    "-o", "--output", required=True, metavar="DIR|FILE",
    help="Directory for the images, made if it is not there; or a movie: turn.gif, turn.mp4.",
)  # fmt: skip
@click.option("--exr", is_flag=True, help="Write float EXR (premultiplied RGBA) beside each PNG.")
@click.option(
    "--background",
    type=float,
    nargs=3,
    metavar="R G B",
    help="Put pictures over this colour. Default: transparent PNG, black movies.",
)
@rule_option("How to draw: as which viewers do. Default: the file's rule, or inria.")
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
    overwrite: bool,
    console: Console,
) -> None:
    """Render the Gaussians of OUT.ply as the standard viewers do, one PNG a view, and a transforms.json.

    With -o turn.gif or turn.mp4 the views are the pictures of a movie, 25 a second; that of an orbit goes on from its
    last picture to its first without a jump. OUT.ply may be "-" for standard input. Give the views with --camera or
    with --orbit. The way up is the one that OUT.ply was made with (--up), else +z.

    \b
    Examples:
      vvgt render frog.ply --orbit 36 --size 800 -o turn
      vvgt render frog.ply --orbit 100 --size 480 -o turn.gif
      vvgt convert example:frog -o - | vvgt render - --orbit 8 -o turn
    """
    from vvgt_cli.errors import UsageError
    from vvgt_cli.tasks.render import RenderRequest, render_file

    if (camera is None) == (orbit is None):
        raise UsageError("give the views with either --camera FILE or --orbit N")
    if background is not None and not all(0 <= c <= 1 for c in background):
        raise UsageError(f"--background {' '.join(map(str, background))}: expected three numbers in [0, 1]")
    render_file(RenderRequest(ply, output, camera, orbit, size, rule, exr, background, overwrite), console)
