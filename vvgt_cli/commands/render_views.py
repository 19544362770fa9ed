"""`vvgt render-views`: calibrated views of a volume, in memory or written for trainers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Unpack

import click

from vvgt_cli.commands import options as shared

if TYPE_CHECKING:
    import numpy as np

    from vvgt_cli.cameras import Camera
    from vvgt_cli.field.settings import BlockOptions
    from vvgt_cli.library.inputs import LooksLike, PathLike, Reading, VolumeLike
    from vvgt_cli.progress import Console


def render_views(
    volume: VolumeLike, look: LooksLike = None, output: PathLike | None = None, *,
    cameras: PathLike | Sequence[Camera] = "sphere", views: int | None = None, test_views: int | None = None,
    size: int | None = None, fov: float | None = None, radius: float | None = None, format: str = "both",
    half: bool = False, background: Sequence[float] = (0.0, 0.0, 0.0), points: bool = True, renderer: str = "vvgt",
    samples: int | str = "adaptive", step: float = 0.5, shard: str = "1/1", overwrite: bool = False,
    device: str = "cpu", blocks: int | str | BlockOptions | None = None, progress: bool | Console = False,
    **reading: Unpack[Reading],
) -> tuple[list[Camera], np.ndarray | None]:  # fmt: skip
    """Render views of a volume with known cameras, in memory or for trainers: ``vvgt render-views``.

    Args:
        volume: as in `convert`.
        look: as in `convert`; several get a folder each.
        output: folder to write, or to complete; None returns the training views.
        cameras: "sphere", "orbit", a ``transforms.json``, or cameras in the unit frame.
        views: number of training views; None: 24.
        test_views: number of test views in a folder; None: 10.
        size: image height in pixels; None: that of the cameras, or 400.
        fov: vertical field of view in degrees; None: 40.
        radius: distance from the centre, in the unit frame; None: 3.
        format: "exr", "png" or "both", of a folder.
        half: EXR in 16 bits.
        background: RGB in [0, 1] behind the opaque images for COLMAP and the contact sheet.
        points: include a point cloud to start from.
        renderer: "vvgt" or "vtk".
        samples: rays along a pixel's edge everywhere, or "adaptive": 5 or 13 where neighbours differ, else 1.
        step: sampling distance in voxels.
        shard: part "I/N" of the views of a folder.
        overwrite: replace the views of another run.
        device: "cpu" or "cuda", where our own renderer casts the rays of a volume in memory.
        blocks: as in `convert`.
        progress: print messages and bars on standard error.
        **reading: as in `convert`.

    Returns:
        cameras, images: (n, h, w, 4) float32, premultiplied RGBA; None with an output.

    Raises:
        UsageError: a folder with another run's views or unknown files, or options that do not fit.
        DataError: invalid input, or a function that shows nothing.
    """
    from vvgt_cli.commands.view_sets import Rays, camera_views, render_looks
    from vvgt_cli.library.inputs import blocks_of, console_of, looks_of, source_of, with_look

    made = camera_views(cameras, views, test_views, size, fov, radius)
    source, looks = source_of(volume, None, reading), looks_of(look)[0]
    requests = {name: with_look(source, one) for name, one in looks.items()}
    rays, files = Rays(renderer, samples, step, device), (output, shard, overwrite, format, half, background, points)
    return render_looks(console_of(progress), requests, made, rays, blocks_of(blocks), *files)


def _samples(ctx: click.Context, param: click.Parameter, value: str) -> int | str:
    if value == "adaptive":
        return value
    if not (value.isascii() and value.isdecimal() and 1 <= int(value) <= 16):
        raise click.BadParameter(f"{value!r}: expected 'adaptive', or 1 to 16 rays along a pixel's edge")
    return int(value)


@shared.command("render-views", short_help="Render calibrated views of a volume, for trainers.")
@click.argument("volume")
@click.option("-o", "--output", required=True, metavar="DIR", help="Output directory, created if missing.")
@shared.optics_options(" Repeatable: each function gets a folder.", multiple=True)
@click.option(
    "--cameras", default="sphere", show_default=True, metavar="sphere|orbit|FILE",
    help="Camera positions: a Fibonacci sphere, a circle around +z, or a transforms.json (in the unit frame).",
)  # fmt: skip
@click.option("--views", type=click.IntRange(1, 10_000), metavar="N", help="Number of training views. Default: 24.")
@click.option(
    "--test-views", type=click.IntRange(0, 10_000), metavar="N",
    help="Number of separate test views; 0 for none. Default: 10.",
)  # fmt: skip
@click.option(
    "--size", type=click.IntRange(16, 16384), metavar="PX",
    help="Image height in pixels. Default: that of the camera file, or 400.",
)  # fmt: skip
@click.option(
    "--fov", type=click.FloatRange(0, 180, min_open=True, max_open=True), metavar="DEGREES",
    help="Vertical field of view. Default: 40.",
)  # fmt: skip
@click.option(
    "--radius", type=click.FloatRange(0, 1000, min_open=True), metavar="R",
    help="Camera distance from the centre, where the volume's longest edge is 2. Default: 3.",
)  # fmt: skip
@shared.light_options
@click.option(
    "--format", type=click.Choice(["both", "exr", "png"]), default="both", show_default=True,
    help="EXR (exact floats), PNG (8 bits, with a COLMAP model), or both.",
)  # fmt: skip
@click.option("--half", is_flag=True, help="Write 16-bit EXR: half the size, three significant digits.")
@click.option(
    "--background", type=click.FloatRange(0, 1), nargs=3, default=(0.0, 0.0, 0.0), metavar="R G B",
    help="Background of the COLMAP images and the contact sheet. Default: black.",
)  # fmt: skip
@click.option(
    "--no-points", "points", is_flag=True, default=True, flag_value=False,
    help="Omit the initial point cloud; the COLMAP model then has no points.",
)  # fmt: skip
@click.option(
    "--renderer", type=click.Choice(["vvgt", "vtk"]), default="vvgt", show_default=True,
    help="Ray caster: our own, or VTK's.",
)  # fmt: skip
@click.option(
    "--samples", default="adaptive", show_default=True, callback=_samples, metavar="adaptive|N",
    help="Rays per pixel: 5 or 13 where neighbours differ and 1 elsewhere, or N x N everywhere.",
)  # fmt: skip
@click.option(
    "--step", type=click.FloatRange(0, 4, min_open=True), default=0.5, show_default=True, metavar="VOXELS",
    help="Sampling distance along a ray, in voxels.",
)  # fmt: skip
@shared.placed_read_options
@shared.block_options
@click.option("--shard", default="1/1", metavar="I/N", help="Render part I of N, for job arrays; I starts at 1.")
@click.option("--overwrite", is_flag=True, help="Replace the views of another run.")
@shared.device_option("views are drawn")
@shared.common_options
def command(**options: Any) -> None:
    """Render views of VOLUME with known cameras, and the files that 3DGS trainers start from.

    DIR gets EXR and PNG images, transforms.json (nerfstudio), transforms_train.json and transforms_test.json
    (Blender style), a COLMAP model, an initial point cloud and a contact sheet. Several --tf get DIR/NAME each.
    Running the same command again renders only what is missing or damaged.

    Examples:
      vvgt render-views head.nrrd --tf bone.json -o views
      vvgt render-views head.nrrd --tf bone.json --tf skin.json -o views --views 36 --size 800
      vvgt render-views head.nrrd --tf bone.json -o views --shard $SLURM_ARRAY_TASK_ID/8
    """
    render_views(**shared.arguments(**options))
