"""`vvgt synth`: a synthetic volume, written as NRRD."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.errors import UsageError

if TYPE_CHECKING:
    from vvgt_cli.library.inputs import PathLike
    from vvgt_cli.progress import Console
    from vvgt_cli.volume import Volume

KINDS = ("isotropic", "stratified", "shells", "tubes", "plates", "noise", "wells", "bodies")
TURBULENCE_SIZE, SHAPE_SIZE, DEVELOPED = 64, 128, 2.0


def synth(
    kind: str, output: PathLike | None = None, *, size: int | None = None, seed: int = 0, field: str | None = None,
    turnovers: float | None = None, overwrite: bool = False, progress: bool | Console = False,
) -> Volume:  # fmt: skip
    """Make a volume that resembles measured or simulated data: ``vvgt synth``.

    >>> import vvgt_cli as vvgt
    >>> vvgt.synth("tubes", size=16).dims
    (16, 16, 16)

    Args:
        kind: "isotropic", "stratified", or a name of `vvgt_cli.volume.shapes.SHAPES`.
        output: ``.nrrd`` to write, None for none.
        size: voxels along an edge; None: 64 for turbulence, else 128.
        seed: random seed.
        field: of turbulence: "speed", "vorticity" or "temperature"; None for the kind's default.
        turnovers: of the largest eddies, in which turbulence develops; None: 2.
        overwrite: replace a file that exists.
        progress: print messages and bars on standard error.

    Raises:
        UsageError: options that the kind does not have, or an output that may not be written.
        DataError: a volume too large for memory.
    """
    from vvgt_cli.gaussians.outputs import Output, claimed
    from vvgt_cli.library.inputs import console_of
    from vvgt_cli.score.record import ConversionReport, Run
    from vvgt_cli.volume.shapes import SHAPES, make_shape
    from vvgt_cli.volume.writers import write_nrrd

    shape, run = kind in SHAPES, Run(console_of(progress), ConversionReport("synth"))
    if shape and (field or turnovers is not None):
        raise UsageError(f"synth {kind}: --field and --turnovers apply only to turbulence")
    if field == "temperature" and kind != "stratified":
        raise UsageError(f"synth {kind}: --field temperature applies only to stratified turbulence")
    with claimed(Output.of("-o", output, (".nrrd",)), [], overwrite):
        with run.stage(kind) as stage:
            if shape:
                volume = make_shape(kind, size or SHAPE_SIZE, seed)
            else:
                volume, stage.note = _turbulence(kind, size, seed, field, turnovers, run.console)
        if output is not None:
            with run.stage("write") as stage:
                run.report.bytes = write_nrrd(output, volume, overwrite)
                stage.note = f"{output}: {' x '.join(map(str, volume.dims))} float32"
    run.finish()
    return volume


@shared.command("synth", short_help="Make a synthetic volume: turbulence, or shapes like those in CT and MR.")
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
@shared.overwrite_option
@shared.common_options
def command(console: Console, **options: Any) -> None:
    """Make a volume that resembles measured or simulated data, for training and experiments.

    KIND: isotropic (forced turbulence), stratified (rotating, stratified turbulence with temperature), both solved by a
    pseudo-spectral method; shells (nested bodies), tubes (vessels), plates (sharp machined parts), noise (at all
    scales), wells (smooth bumps, like molecular potentials), bodies (shells with vessels, metal and noise). Turbulence
    takes about a minute per turnover at 64 on one core, sixteen times as long at 128.

    Example:
      vvgt synth tubes --seed 3 -o tubes.nrrd
      vvgt convert tubes.nrrd -o tubes.ply
    """
    synth(**options, progress=console)


def _turbulence(
    kind: str, size: int | None, seed: int, field: str | None, turnovers: float | None, console: Console
) -> tuple[Volume, str]:
    """Return the volume, and a note about the flow."""
    from vvgt_cli.volume.shapes import volume_of
    from vvgt_cli.volume.turbulence import TURNOVER, Solver, advance, fields, flow_of

    solver, turned = Solver(flow_of(kind, size or TURBULENCE_SIZE)), DEVELOPED if turnovers is None else turnovers
    state = advance(solver, solver.start(seed), turned * TURNOVER, console.bar(kind))
    field = field or ("temperature" if kind == "stratified" else "speed")
    energy, loss = solver.energy(state), solver.dissipation(state)
    note = f"{field} after {turned:g} turnovers, energy {energy:.3g}, dissipation {loss:.3g}"
    return volume_of(fields(solver, state)[field], f"{kind}-{field}-{seed}"), note
