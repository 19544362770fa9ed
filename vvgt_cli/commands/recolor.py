"""`vvgt recolor`: live Gaussians shown under another function, without the volume."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click

from vvgt_cli.commands import options as shared

if TYPE_CHECKING:
    from vvgt_cli.conversion.result import Result
    from vvgt_cli.library.inputs import FunctionLike, LabelsLike, LightLike, PathLike
    from vvgt_cli.progress import Console
    from vvgt_cli.score.record import Run


def recolor(
    ply: PathLike, tf: FunctionLike | None = None, output: PathLike | None = None, *,
    tf_range: str | Sequence[float] = "data", opacity_unit_distance: str | float | None = None,
    labels: LabelsLike | None = None, light: LightLike = None, layers: Sequence[str] | Mapping[int | str, Any] = (),
    iso: float | str | Sequence[float | str] = (),
    overwrite: bool = False, progress: bool | Console = False,
) -> Result:  # fmt: skip
    """Show a live ``.ply`` under another function, without its volume: ``vvgt recolor``.

    Args:
        ply: file of ``vvgt convert --live``; "-" is standard input.
        tf: function as in `Look`; None: the file's own.
        output: file to write, of any format; "-" is standard output, None writes nothing.
        tf_range: as in `Look`.
        opacity_unit_distance: as in `Look`.
        labels: table of a label map as in `Look`; None: the file's own.
        light: as in `Look`; None: that of the function's file, else that of the file.
        iso: levels in place of a function, as in `Look`.
        layers: for several layers or channels, values of ``--layer``, or functions or label tables by number or name.
        overwrite: replace the output if it exists.
        progress: print messages on standard error.

    Returns:
        Ordinary Gaussians.

    Raises:
        DataError: the Gaussians carry no values, or the function shows nothing of them.
        UsageError: an invalid range, distance or light, or an output that may not be written.
    """
    from dataclasses import replace

    from vvgt_cli.conversion.gaussian_files import open_gaussians
    from vvgt_cli.conversion.recolored import layer_look, recolored
    from vvgt_cli.conversion.result import Result
    from vvgt_cli.field.source import SourceRequest
    from vvgt_cli.gaussians.formats import SUFFIXES
    from vvgt_cli.library.inputs import Look, live_look, written

    name, listed = os.fspath(ply), () if isinstance(layers, Mapping) else layers
    look = live_look(Look(tf, tf_range, opacity_unit_distance, light, labels, listed, iso)) or SourceRequest("")

    def make(run: Run) -> Result:
        with run.stage("read") as stage:
            gaussians, header = open_gaussians(name)
            stage.note = f"{len(gaussians)} Gaussians"
        with run.stage("recolor") as stage:
            own = layers.items() if isinstance(layers, Mapping) else ()
            named = tuple(layer_look(header, key, one) for key, one in own)
            visible, options = recolored(name, gaussians, header, replace(look, layers=look.layers + named))
            stage.note = f"{len(visible)} of them visible under {options.function}"
        return Result(visible, run.report, options)

    inputs = [name, *look.paths()]
    return written(make, "recolor", inputs, output, overwrite=overwrite, progress=progress, suffixes=SUFFIXES)


@shared.command("recolor", short_help="Show a live .ply under another function or light.")
@click.argument("ply", metavar="LIVE.ply")
@click.option(
    "--tf", metavar="TF",
    help="Transfer function: a file or the name of a matplotlib colour map. Default: the file's own.",
)  # fmt: skip
@shared.iso_option
@shared.output_option
@click.option(
    "--labels", metavar="TABLE|auto",
    help="Table of labels, for a file of a label map; opacity 0 hides a label. Default: the file's own.",
)  # fmt: skip
@shared.layer_looks_option
@shared.tf_range_option
@shared.unit_distance_option
@shared.light_options
@shared.overwrite_option
@shared.common_options
def command(console: Console, **options: Any) -> None:
    """Write LIVE.ply, made by 'vvgt convert --live', as an ordinary file under another function, table or light.

    The volume is not needed. Gaussians that TF hides are omitted. LIVE.ply may be "-".

    Examples:
      vvgt recolor head-live.ply --tf bone.json -o bone.ply
      vvgt recolor head-live.ply --tf skin.json --light headlight -o skin.html
      vvgt recolor cells-live.ply --layer 1,tf=magenta.json -o cells.ply
    """
    recolor(**options, progress=console)
