"""`vvgt init`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Unpack

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.defaults import INIT

if TYPE_CHECKING:
    from vvgt_cli.conversion.clouds import Clouds
    from vvgt_cli.conversion.result import Conversion
    from vvgt_cli.field.settings import BlockOptions
    from vvgt_cli.library.inputs import LookLike, PathLike, Reading, VolumeLike
    from vvgt_cli.progress import Console


def init(
    volume: VolumeLike, look: LookLike = None, output: PathLike | None = None, *, max_gaussians: int | None = None,
    screen: int | None = None, init: str = INIT, seed: int = 0, frame: str = "unit", up: str = "auto",
    camera: tuple[float, ...] | None = None, sh_degree: int | None = None, comments: bool = True,
    report: PathLike | None = None, blocks: int | str | BlockOptions | None = None, overwrite: bool = False,
    progress: bool | Console = False, **reading: Unpack[Reading],
) -> Conversion | Clouds | str | None:  # fmt: skip
    """Compute the Gaussians of a volume in closed form, without views and scores: ``vvgt init``.

    Arguments, result and errors are those of `convert`.
    """
    from vvgt_cli.conversion.convert_batch import convert_all
    from vvgt_cli.conversion.request import FitOptions
    from vvgt_cli.gaussians import PlyOptions
    from vvgt_cli.library.inputs import console_of, requests_of

    fit = FitOptions.of(max_gaussians=max_gaussians, screen=screen, init=init, seed=seed, steps=0)
    ply = PlyOptions(frame=frame, camera=camera, sh_degree=sh_degree, comments=comments)
    requests, _ = requests_of(
        volume, look, reading, output=output, fit=fit, ply=ply, up=up, report=report, blocks=blocks,
        overwrite=overwrite, scored=False,
    )  # fmt: skip
    return convert_all(requests, console=console_of(progress))


@shared.command("init", short_help="Compute the closed form only, without rendering.")
@click.argument("volume")
@shared.output_option
@shared.tf_options
@shared.fit_options
@shared.light_options
@shared.overwrite_option
@shared.ply_options
@shared.placed_read_options
@shared.report_option
@shared.shared_block_options
@shared.common_options
def command(**options: Any) -> None:
    """Compute Gaussians of VOLUME in closed form, without rendering an image.

    This is the first stage of 'vvgt convert', for a quick look or as the start of an optimisation elsewhere.

    Volumes larger than memory are processed in blocks, automatically or as set by --blocks, --workers, --scheduler
    and --shard. The output does not depend on the partition.

    Examples:
      vvgt init example:frog -o frog-init.ply --max-gaussians 20000
      vvgt init huge.zarr -o huge.ply --blocks auto --workers 4 --memory 8G
    """
    init(**shared.arguments(**options))
