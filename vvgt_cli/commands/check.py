"""`vvgt check`: this installation, cases and stiffness of one scene, or a file of Gaussians."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, Unpack

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.errors import DataError, UsageError

if TYPE_CHECKING:
    from vvgt_cli.checks.report import CheckReport
    from vvgt_cli.library.inputs import LookLike, Reading, VolumeLike
    from vvgt_cli.progress import Console

TOLERANCE = 0.002  # RMS of RGBA


def check(
    file: VolumeLike | None = None, look: LookLike = None, *, volume: VolumeLike | None = None,
    tolerance: float | None = None, progress: bool | Console = False, **reading: Unpack[Reading],
) -> CheckReport:  # fmt: skip
    """Check this installation, the scene of a volume and its look, or a file of Gaussians: ``vvgt check``.

    Args:
        file: a volume as in `convert`, or a file of Gaussians; None: the installation.
        look: of the volume, as in `convert`.
        volume: that the Gaussians were made from; None checks the file alone.
        tolerance: RMS error in [0, 1] that a scene's views or pictures of Gaussians may have; None: 0.002, or 0.056.
        progress: print messages and bars on standard error.
        **reading: of the volume, as in `convert`.

    Raises:
        UsageError, DataError: a volume or Gaussians that cannot be read.
    """
    from vvgt_cli.checks.report import CheckReport, measure_stiffness, run_cases
    from vvgt_cli.checks.self_test import scene_cases, self_test_cases
    from vvgt_cli.commands.check_splats import check_splats
    from vvgt_cli.field.source import describe_source, load, tf_record, volume_record
    from vvgt_cli.gaussians.formats import is_splats
    from vvgt_cli.library.inputs import console_of, source_of

    console = console_of(progress)
    if isinstance(file, str | os.PathLike) and is_splats(os.fspath(file)):
        compared = None if volume is None else source_of(volume, look, reading)
        return check_splats(os.fspath(file), compared, tolerance, console)
    if volume is not None:
        raise UsageError(f"--volume {volume}: expected a file of Gaussians to compare it with, not {file or 'nothing'}")
    if file is None:
        return CheckReport(run_cases(list(self_test_cases()), console))
    source = source_of(file, look, reading)
    loaded = load(source)
    console.message(describe_source(loaded))
    scene = loaded.scene()
    stiffness = measure_stiffness(scene, tolerance or TOLERANCE, console.bar("stiffness"))
    outcomes = run_cases(list(scene_cases(scene)), console)
    return CheckReport(outcomes, volume_record(loaded), tf_record(loaded, source), stiffness)


@shared.command("check", short_help="Test this installation, how stiff a scene is, or a file of Gaussians.")
@click.argument("file", metavar="VOLUME|GAUSSIANS", required=False)
@click.option("--volume", metavar="VOLUME", help="Volume that GAUSSIANS were made from.")
@click.option(
    "--tolerance", type=click.FloatRange(0, 1, min_open=True), metavar="RMS",
    help="RMS error of VOLUME's views (RGBA) that the sampling step is chosen for, default 0.002; or that the pictures "
    "of GAUSSIANS may have, default 0.056 (25 dB).",
)  # fmt: skip
@shared.json_option
@shared.tf_options
@shared.light_options
@shared.read_options
@shared.common_options
def command(file: str | None, volume: str | None, as_json: bool, **options: Any) -> None:
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
    from vvgt_cli.gaussians.formats import is_splats

    asked = options["optics"] | options["read"] | options["light"]
    given = [key for key, value in asked.items() if value and (key, value) != ("tf_range", "data")]
    if given and volume is None and (file is None or is_splats(file)):
        names = ", ".join(f"--{'light' if key == 'lights' else key.replace('_', '-')}" for key in given)
        raise UsageError(f"{names}: only with a volume; expected {'--volume' if file else 'VOLUME'} too")
    report = check(file, volume=volume, **shared.arguments(**options))
    click.echo(report.to_json() if as_json else report.table(), nl=False)
    if report.failed:
        names = "; ".join(f"{o.stage}: {o.name}" for o in report.failed[:3])
        more = f" and {len(report.failed) - 3} more" if len(report.failed) > 3 else ""
        raise DataError(f"{len(report.failed)} of {len(report.outcomes)} cases failed ({names}{more})")
