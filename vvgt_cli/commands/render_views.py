"""`vvgt render-views`."""

from __future__ import annotations

from typing import Any

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.progress import Console


def _samples(ctx: click.Context, param: click.Parameter, value: str) -> int | None:
    if value == "adaptive":
        return None
    if not (value.isascii() and value.isdecimal() and 1 <= int(value) <= 16):
        raise click.BadParameter(f"{value!r}: expected 'adaptive', or 1 to 16 rays along a pixel's edge")
    return int(value)


camera_options = shared.group(
    "cameras",
    kind=click.option(
        "--cameras", "kind", default="sphere", show_default=True, metavar="sphere|orbit|FILE",
        help="Camera positions: a Fibonacci sphere, a circle around +z, or a transforms.json (in the unit frame).",
    ),
    views=click.option("--views", type=click.IntRange(1, 10_000), metavar="N",
    help="Number of training views. Default: 24."),
    test_views=click.option(
        "--test-views", type=click.IntRange(0, 10_000), metavar="N",
        help="Number of separate test views; 0 for none. Default: 10.",
    ),
    size=click.option(
        "--size", type=click.IntRange(16, 16384), metavar="PX",
        help="Image height in pixels. Default: that of the camera file, or 400."
    ),
    fov=click.option(
        "--fov", type=click.FloatRange(0, 180, min_open=True, max_open=True), metavar="DEGREES",
        help="Vertical field of view. Default: 40.",
    ),
    radius=click.option(
        "--radius", type=click.FloatRange(0, 1000, min_open=True), metavar="R",
        help="Camera distance from the centre, where the volume's longest edge is 2. Default: 3.",
    ),
)  # fmt: skip

image_options = shared.group(
    "layout",
    format=click.option(
        "--format", type=click.Choice(["both", "exr", "png"]), default="both", show_default=True,
        help="EXR (exact floats), PNG (8 bits, with a COLMAP model), or both.",
    ),
    half=click.option("--half", is_flag=True, help="Write 16-bit EXR: half the size, three significant digits."),
    background=click.option(
        "--background", type=click.FloatRange(0, 1), nargs=3, default=(0.0, 0.0, 0.0), metavar="R G B",
        help="Background of the COLMAP images and the contact sheet. Default: black.",
    ),
    points=click.option("--no-points", "points", is_flag=True, default=True, flag_value=False,
        help="Omit the initial point cloud; the COLMAP model then has no points."),
)  # fmt: skip

ray_options = shared.group(
    "rays",
    renderer=click.option(
        "--renderer", type=click.Choice(["vvgt", "vtk"]), default="vvgt", show_default=True,
        help="Ray caster: our own, or VTK's.",
    ),
    samples=click.option(
        "--samples", default="adaptive", show_default=True, callback=_samples, metavar="adaptive|N",
        help="Rays per pixel: 5 or 13 where neighbours differ and 1 elsewhere, or N x N everywhere.",
    ),
    step=click.option(
        "--step", type=click.FloatRange(0, 4, min_open=True), default=0.5, show_default=True, metavar="VOXELS",
        help="Sampling distance along a ray, in voxels.",
    ),
)  # fmt: skip


@shared.command("render-views", short_help="Render calibrated views of a volume, for trainers.")
@click.argument("volume")
@click.option("-o", "--output", required=True, metavar="DIR", help="Output directory, created if missing.")
@shared.optics_options(" Repeatable: each function gets a folder.", multiple=True)
@camera_options
@shared.light_options
@image_options
@ray_options
@shared.placed_read_options
@shared.block_options
@click.option("--shard", default="1/1", metavar="I/N", help="Render part I of N, for job arrays; I starts at 1.")
@click.option("--overwrite", is_flag=True, help="Replace the views of another run.")
@shared.device_option("views are drawn")
@shared.common_options
def command(
    volume: str, output: str, cameras: dict[str, Any], layout: dict[str, Any], rays: dict[str, Any],
    optics: dict[str, Any], light: dict[str, Any], read: dict[str, Any], blocks: dict[str, Any], shard: str,
    overwrite: bool, device: str, console: Console,
) -> None:  # fmt: skip
    """Render views of VOLUME with known cameras, and the files that 3DGS trainers start from.

    DIR gets EXR and PNG images, transforms.json (nerfstudio), transforms_train.json and transforms_test.json
    (Blender style), a COLMAP model, an initial point cloud and a contact sheet. Several --tf get DIR/NAME each.
    Running the same command again renders only what is missing or damaged.

    Examples:
      vvgt render-views head.nrrd --tf bone.json -o views
      vvgt render-views head.nrrd --tf bone.json --tf skin.json -o views --views 36 --size 800
      vvgt render-views head.nrrd --tf bone.json -o views --shard $SLURM_ARRAY_TASK_ID/8
    """
    from vvgt_cli.commands.view_files import Layout
    from vvgt_cli.commands.view_sets import CameraRequest, ViewsRequest, render_view_sets
    from vvgt_cli.conversion.manifest import parse_shard
    from vvgt_cli.errors import UsageError

    if layout["half"] and layout["format"] == "png":
        raise UsageError("--half applies to EXR, which --format png does not write; give only one of the two")
    source = shared.source_request(volume, read, optics, light)
    request = ViewsRequest(
        source, optics["tf"] or tuple(filter(None, [source.tf])), output, CameraRequest(**cameras), Layout(**layout),
        shard=parse_shard(shard), overwrite=overwrite, blocks=shared.block_options_of(blocks), device=device, **rays,
    )  # fmt: skip
    render_view_sets(request, console)
