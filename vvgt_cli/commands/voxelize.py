"""`vvgt voxelize`: Gaussians back on a grid of voxels."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import click

from vvgt_cli.commands import options as shared

if TYPE_CHECKING:
    from vvgt_cli.library.inputs import PathLike, VolumeLike
    from vvgt_cli.progress import Console
    from vvgt_cli.volume import Volume


def voxelize(
    file: PathLike, output: PathLike | None = None, *, dims: tuple[int, int, int] | None = None,
    spacing: tuple[float, float, float] | None = None, like: VolumeLike | None = None, layer: int | str | None = None,
    density: bool = False, overwrite: bool = False, progress: bool | Console = False,
) -> Volume | None:  # fmt: skip
    """Put the values or labels of live Gaussians, or the density of any, on a grid of voxels: ``vvgt voxelize``.

    Args:
        file: Gaussians; "-" is a ``.ply`` on standard input.
        output: volume to write, whose ending selects the format; None returns it.
        dims: voxels along x, y and z in the file's box; None: those of its volume.
        spacing: edges of a voxel, world lengths.
        like: volume whose grid is taken.
        layer: number or name, of several layers.
        density: extinction per world length and RGB of any Gaussians; of a volume in memory, extinction alone.
        overwrite: replace the output if it exists.
        progress: print messages on standard error.

    Returns:
        The volume, with its ``affine``; None if it was written.

    Raises:
        DataError: Gaussians without values, or a grid too large for memory or disk.
        UsageError: options that contradict each other, no grid, or an output that may not be written.
    """
    from vvgt_cli.conversion.gaussian_files import open_gaussians
    from vvgt_cli.conversion.voxelize import array_of, planes_of
    from vvgt_cli.gaussians.outputs import Output, claimed
    from vvgt_cli.library.inputs import console_of, volume_of
    from vvgt_cli.score.record import ConversionReport, Run
    from vvgt_cli.volume.writers import SUFFIXES, write_volume

    run, name = Run(console_of(progress), ConversionReport("voxelize")), os.fspath(file)
    inputs = [name, like if isinstance(like, str) else None]
    with claimed(Output.of("-o", output, SUFFIXES), inputs, overwrite):
        with run.stage("read") as stage:
            gaussians, header = open_gaussians(name)
            other = None if like is None else volume_of(like, {})
            stage.note = f"{len(gaussians)} Gaussians"
        with run.stage("values") as stage:
            planes = planes_of(name, header, gaussians, dims, spacing, other, layer, density)
            stage.note = " x ".join(map(str, planes.grid.dims)) + " voxels"
            made = header.certificate
            if not density and made is not None and made.values_psnr is not None:
                stage.note += f"; on the volume's own grid {made.values_psnr:g} dB, at most {made.values_error:g} off"
        if output is None:
            found = array_of(planes)
            run.finish()
            return found
        with run.stage("write") as stage:
            run.report.bytes = write_volume(output, planes, overwrite)
            stage.note = f"{output}: {planes.dtype.name}, {run.report.bytes / 1e6:.1f} MB"
    run.finish()
    return None


@shared.command("voxelize", short_help="Put live values, or any splats' density, on a grid of voxels.")
@click.argument("file", metavar="FILE")
@click.option(
    "-o", "--output", required=True, metavar="VOLUME",
    help="Output: .nii.gz, .nii, .nrrd, .mha, .vti, .npy, .zarr or .vdb.",
)  # fmt: skip
@click.option(
    "--dims", nargs=3, type=click.IntRange(1), metavar="X Y Z",
    help="Voxels along x, y and z, in the file's box. Default: those of the volume that FILE was made from.",
)  # fmt: skip
@click.option("--spacing", nargs=3, type=float, metavar="X Y Z", help="Edges of a voxel, in the unit of FILE's world.")
@click.option("--like", metavar="OTHER", help="Volume whose grid is taken.")
@click.option("--layer", metavar="LAYER", help="Layer or channel of several, by number or name.")
@click.option(
    "--density", is_flag=True,
    help="Write extinction per length, and red, green and blue (without harmonics), of any splats.",
)  # fmt: skip
@shared.overwrite_option
@shared.common_options
def command(console: Console, **options: Any) -> None:
    """Write the values, or labels, of FILE, made by 'vvgt convert --live', as a volume; with --density, any splats.

    The grid is that of the volume that FILE was made from, in its place.

    Examples:
      vvgt voxelize head-live.ply -o head.nii.gz
      vvgt voxelize head-live.ply --like other.nrrd -o moved.nrrd
      vvgt voxelize any.spz --density --dims 256 256 256 -o smoke.vdb
    """
    voxelize(**options, progress=console)
