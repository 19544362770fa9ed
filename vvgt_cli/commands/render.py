"""`vvgt render`: pictures or a movie of Gaussians as viewers draw them, or of a volume by the ray caster."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Unpack

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.errors import UsageError

if TYPE_CHECKING:
    from vvgt_cli.field.settings import BlockOptions
    from vvgt_cli.field.source import SourceRequest
    from vvgt_cli.library.inputs import LookLike, PathLike, Reading, VolumeLike
    from vvgt_cli.progress import Console


def render(
    file: VolumeLike, output: PathLike, look: LookLike = None, *, camera: PathLike | None = None,
    orbit: int | None = None, size: int | None = None, rule: str | None = None, exr: bool = False,
    background: Sequence[float] | None = None, blocks: int | str | BlockOptions | None = None, overwrite: bool = False,
    progress: bool | Console = False, **reading: Unpack[Reading],
) -> int:  # fmt: skip
    """Write pictures or a movie of Gaussians or of a volume, and return the number of views: ``vvgt render``.

    Args:
        file: Gaussians ("-" for standard input, a glob or an index for several), or a volume as in `convert`.
        output: directory for pictures, one picture (``.png``), numbered ones ("{:04d}.png"), or a movie by its ending.
        look: of a volume, as in `convert`, or of live Gaussians; None: their own.
        camera: view-set file.
        orbit: number of views on a circle around the up axis.
        size: image height in pixels; None: the view set's, the one that the Gaussians are made for, or 400.
        rule: drawing rule of Gaussians, "mip" or "xray", also of a volume; None: the file's.
        exr: also write float EXR.
        background: (r, g, b) in [0, 1]; None: transparent pictures and black movies.
        blocks: as in `convert`.
        overwrite: replace files that exist.
        progress: print messages and bars on standard error.
        **reading: of a volume, as in `convert`.

    Raises:
        UsageError: an output exists or cannot be made; views or an output that do not suit the frames.
        DataError: Gaussians, a volume or a view set that are not valid, or a missing library for movies.
    """
    from vvgt_cli.commands.pictures import Drawing, draw_files
    from vvgt_cli.conversion.index import movie_frames
    from vvgt_cli.gaussians.formats import is_splats
    from vvgt_cli.library.inputs import Look, blocks_of, console_of, live_look, source_of
    from vvgt_cli.score.record import ConversionReport, Run
    from vvgt_cli.volume import ReadOptions

    if background is not None and not all(0 <= c <= 1 for c in background):
        raise UsageError(f"--background {' '.join(map(str, background))}: expected three numbers in [0, 1]")
    frames = movie_frames(os.fspath(file)) if isinstance(file, str | os.PathLike) else ()
    given: tuple[str | None, ...] | SourceRequest = frames
    function: SourceRequest | None = None
    if any(map(is_splats, filter(None, frames))) or (file == "-" and reading.get("dims") is None):
        if source_of(file, None, reading).read != ReadOptions() or blocks is not None:
            raise UsageError(f"{file} holds Gaussians; reading options and --blocks are for volumes only: omit them")
        function = live_look(Look.of(look))
    elif rule not in (None, "mip", "xray"):
        raise UsageError(f"--rule {rule}: is for Gaussians, {file} is a volume; expected mip or xray, or none")
    else:
        given = source_of(file, look, reading)
    how = (os.fspath(output), camera, orbit, size, rule, exr, background, overwrite)
    run = Run(console_of(progress), ConversionReport("render"))
    return draw_files(run, Drawing(given, function, blocks_of(blocks), *how))


@shared.command("render", short_help="Render pictures or a movie of Gaussians or a volume.")
@click.argument("file", metavar="FILE")
@click.option("--camera", metavar="FILE", help="Camera poses from a transforms.json, in the unit frame.")
@click.option("--orbit", type=click.IntRange(1, 10_000), metavar="N", help="N views on a circle around the up axis.")
@click.option(
    "--size", type=click.IntRange(1, 16384), metavar="PX",
    help="Image height in pixels. Default: that of the camera file, else the size recorded in the .ply, or 400.",
)  # fmt: skip
@click.option(
    "-o", "--output", required=True, metavar="DIR|FILE",
    help="One picture such as out.png, a directory for several, created if missing, numbered ones such as "
    "'out_{:04d}.png' (of a series also {step}, {time} or {stem}), or a movie such as turn.gif or turn.mp4.",
)  # fmt: skip
@click.option("--exr", is_flag=True, help="Also write float EXR images (premultiplied RGBA).")
@click.option(
    "--background", type=float, nargs=3, metavar="R G B",
    help="Background colour, 0 to 1. Default: transparent for PNG, black for movies.",
)  # fmt: skip
@shared.tf_options
@shared.light_options
@shared.rule_option(
    "Viewer to imitate when drawing Gaussians; mip and xray show the values of a volume or a live file in grey. "
    "Default: the one recorded in the file, or inria.",
    more=("mip", "xray"),
)
@shared.placed_read_options
@shared.block_options
@shared.overwrite_option
@shared.common_options
def command(**options: Any) -> None:
    """Render Gaussians as viewers do, or a volume by ray casting: one PNG per view and a transforms.json.

    Choose the views with --camera or --orbit; -o out.png without them is the first view of an orbit. With -o turn.gif
    or turn.mp4 they become a movie at 25 frames per second, which loops seamlessly for an orbit. A quoted glob of
    volumes or of Gaussians, a file of several time steps, or an index of 'vvgt convert' becomes a movie over time, or
    numbered pictures: 5 frames per second from one view, or several views shared among the frames. The up axis is the
    one recorded in a .ply, else +z, superior in anatomical volumes. FILE may be "-", or FOLDER of streamed levels:
    FOLDER#1 is its level 1, FOLDER#view what viewers show each camera. A .ply of 'vvgt convert --live' can be shown
    under any function (--tf) and light (--light); its layers as --layer LAYER,tf=TF, by number or name. Of a volume of
    values, and of its live .ply, --rule mip shows the greatest value along each ray, from black for the least value of
    the volume to white for the greatest, and --rule xray the sum of extinction under the function, both opaque and
    unlit.

    Examples:
      vvgt render head.nrrd --tf ct-bone --size 800 -o head.png
      vvgt render frog.ply --orbit 36 --size 800 -o turn
      vvgt render frog.ply --orbit 100 --size 480 -o turn.gif
      vvgt render 'run_*.vti' --tf viridis -o time.mp4
      vvgt convert example:frog -o - | vvgt render - --orbit 8 -o turn
    """
    render(**shared.arguments(**options))
