"""`vvgt synth`."""

from __future__ import annotations

import click

from vvgt_cli.cli.options import common_options, overwrite_option
from vvgt_cli.cli.sections import SectionedCommand
from vvgt_cli.progress import Console

KINDS = ("isotropic", "stratified", "shells", "tubes", "plates", "noise", "wells", "bodies")


@click.command(
    "synth", cls=SectionedCommand, short_help="Make a synthetic volume: turbulence, or shapes like those in CT and MR."
)
@click.argument("kind", metavar="KIND", type=click.Choice(KINDS))
@click.option("-o", "--output", required=True, metavar="FILE.nrrd", help="Output file: NRRD, float32.")
@click.option(
    "--size", type=click.IntRange(8, 1024), metavar="N",
    help="Voxels along each side. Default: 64 for turbulence, else 128.",
)  # fmt: skip
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Random seed.")
@click.option(
    "--field", type=click.Choice(["speed", "vorticity", "temperature"]),
    help="Field of turbulence to write. Default: speed; temperature for stratified, which alone has it.",
)  # fmt: skip
@click.option(
    "--turnovers", type=click.FloatRange(0, 100), metavar="T",
    help="Time for turbulence to develop, in turnovers of the largest eddies. Default: 2.",
)  # fmt: skip
@overwrite_option
@common_options
def command(
    kind: str, output: str, size: int | None, seed: int, field: str | None, turnovers: float | None, overwrite: bool,
    console: Console,
) -> None:  # fmt: skip
    """Make a volume that resembles measured or simulated data, for training and experiments.

    KIND: isotropic (forced turbulence), stratified (rotating, stratified turbulence with temperature), both solved by a
    pseudo-spectral method; shells (nested bodies), tubes (vessels), plates (sharp machined parts), noise (at all
    scales), wells (smooth bumps, like molecular potentials), bodies (shells with vessels, metal and noise). Turbulence
    takes about a minute per turnover at 64 on one core, sixteen times as long at 128.

    Example:
      vvgt synth tubes --seed 3 -o tubes.nrrd
      vvgt convert tubes.nrrd -o tubes.ply
    """
    from vvgt_cli.commands.synth import SynthRequest, synthesise

    synthesise(SynthRequest(kind, output, size, seed, field, turnovers, overwrite), console)
