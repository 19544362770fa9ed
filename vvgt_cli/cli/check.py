"""`vvgt check`."""

from __future__ import annotations

from typing import Any

import click

from vvgt_cli.cli.options import common_options, light_options, read_options, tf_options
from vvgt_cli.cli.sections import SectionedCommand
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.progress import Console


@click.command(
    "check", cls=SectionedCommand, short_help="Test this installation, how stiff a scene is, or a file of Gaussians."
)
@click.argument("file", metavar="VOLUME|GAUSSIANS", required=False)
@click.option("--volume", metavar="VOLUME", help="Volume that GAUSSIANS were made from.")
@click.option(
    "--tolerance", type=click.FloatRange(0, 1, min_open=True), metavar="RMS",
    help="RMS error of VOLUME's views (RGBA) that the sampling step is chosen for, default 0.002; or that the pictures "
    "of GAUSSIANS may have, default 0.056 (25 dB).",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")
@tf_options
@light_options
@read_options
@common_options
def command(
    file: str | None, volume: str | None, tolerance: float | None, as_json: bool, console: Console, **options: Any
) -> None:
    """Test this installation and print a table; exit status 1 if a case fails.

    Compiles missing kernels, compares renderer, splatter and gradients with float64 twins, converts three tiny volumes,
    and writes and reads every format. Takes some seconds, a minute or two the first time.

    With VOLUME, examines that scene: four cases, its stiffness, and the sampling step that its views need.

    With GAUSSIANS (.ply, .spz, .sog, .glb, ... by any program), examines that file: its values; with --volume and
    its look also position, orientation, errors of pictures, differences between viewers, and texture.

    Examples:
      vvgt check
      vvgt check head.nrrd --tf bone.json --tolerance 0.001
      vvgt check trained.ply --volume head.nrrd --tf bone.json
      vvgt check trained.ply --json | jq '.outcomes[] | select(.passed | not)'
    """
    from vvgt_cli.cli.fit import source_request
    from vvgt_cli.commands.check import check
    from vvgt_cli.gaussians.formats import is_splats

    splats = file if file is not None and is_splats(file) else None
    if volume is not None and splats is None:
        raise UsageError(f"--volume {volume}: expected a file of Gaussians to compare it with, not {file or 'nothing'}")
    scene = volume if splats else file
    asked = options["optics"] | options["read"] | options["light"]
    flags = {"lights": "light", "occlusion": "ambient-occlusion"}
    given = [f"--{flags.get(key, key).replace('_', '-')}" for key, value in asked.items() if value]
    given = [name for name in given if name != "--tf-range" or options["optics"]["tf_range"] != "data"]
    if scene is None and given:
        raise UsageError(f"{', '.join(given)}: only with a volume; expected {'--volume' if splats else 'VOLUME'} too")
    source = None if scene is None else source_request(scene, options["read"], options["optics"], options["light"])
    report = check(source, tolerance, console, splats)
    click.echo(report.to_json() if as_json else report.table(), nl=False)
    if report.failed:
        names = "; ".join(f"{o.stage}: {o.name}" for o in report.failed[:3])
        more = f" and {len(report.failed) - 3} more" if len(report.failed) > 3 else ""
        raise DataError(f"{len(report.failed)} of {len(report.outcomes)} cases failed ({names}{more})")
