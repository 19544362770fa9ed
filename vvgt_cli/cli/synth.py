"""`vvgt synth`."""

from __future__ import annotations

import click

from vvgt_cli.cli.options import common_options, overwrite_option
from vvgt_cli.progress import Console

KINDS = ("isotropic", "stratified", "shells", "tubes", "plates", "noise", "wells", "bodies")


@click.command("synth", short_help="Make a volume: turbulence, or shapes as CT and MR show them.")
@click.argument("kind", metavar="KIND", type=click.Choice(KINDS))
@click.option("-o", "--output", required=True, metavar="FILE.nrrd", help="File to write: NRRD, float32.")
@click.option(
    "--size", type=click.IntRange(8, 1024), metavar="N", help="Voxels a side. Default: 64 for turbulence, else 128."
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Another seed, another volume.")
@click.option(
    "--field", type=click.Choice(["speed", "vorticity", "temperature"]),
    help="Of turbulence. Default: speed; temperature for stratified, which alone has it.",
)  # fmt: skip
@click.option(
    "--turnovers", type=click.FloatRange(0, 100), metavar="T",
    help="Of turbulence: time that it is given to develop, in turnovers of the largest eddies. Default: 2.",
)  # fmt: skip
@overwrite_option
@common_options
def command(
    kind: str, output: str, size: int | None, seed: int, field: str | None, turnovers: float | None, overwrite: bool,
    console: Console,
) -> None:  # fmt: skip
    """Make a volume with the structure of measured or computed data, for training and for trials.

    KIND: isotropic (forced turbulence) and stratified (rotating, stratified turbulence with its temperature), solved
    by a pseudo-spectral method; shells (nested bodies), tubes (vessels), plates (sharp machined parts), noise (of all
    scales), wells (smooth bumps, as molecules' potentials), bodies (shells with vessels, metal and noise). Turbulence
    takes about a minute a turnover at 64 on a core, sixteen times as long at 128.

    \b
    Example:
      vvgt synth tubes --seed 3 -o tubes.nrrd
      vvgt convert tubes.nrrd -o tubes.ply
    """
    from vvgt_cli.tasks.synth import SynthRequest, synthesise

    synthesise(SynthRequest(kind, output, size, seed, field, turnovers, overwrite), console)
