"""`synth`: a synthetic volume, written as NRRD."""

from __future__ import annotations

from dataclasses import dataclass

from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.outputs import Output, claimed
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.volume.types import Volume

TURBULENCE_SIZE, SHAPE_SIZE, DEVELOPED = 64, 128, 2.0


@dataclass(frozen=True)
class SynthRequest:
    """A volume to make.

    Attributes:
        kind: "isotropic", "stratified", or a name of `vvgt_cli.volume.shapes.SHAPES`.
        output: .nrrd to write.
        size: voxels along an edge; None for the kind's default.
        seed: random seed.
        field, turnovers: of turbulence; None for the kind's default.
        overwrite: replace a file that exists.
    """

    kind: str
    output: str
    size: int | None = None
    seed: int = 0
    field: str | None = None
    turnovers: float | None = None
    overwrite: bool = False


def synthesise(request: SynthRequest, console: Console | None = None) -> ConversionReport:
    """Make the volume and write it.

    Raises:
        UsageError: options that the kind does not have, or an output that may not be written.
        DataError: a volume too large for memory.
    """
    from vvgt_cli.volume.shapes import SHAPES

    shape = request.kind in SHAPES
    if shape and (request.field or request.turnovers is not None):
        raise UsageError(f"synth {request.kind}: --field and --turnovers apply only to turbulence")
    if request.field == "temperature" and request.kind != "stratified":
        raise UsageError(f"synth {request.kind}: --field temperature applies only to stratified turbulence")
    with claimed([Output("-o", request.output, (".nrrd",))], [], request.overwrite):
        return _make(request, Run(console or Console(), ConversionReport("synth")), shape)


def _make(request: SynthRequest, run: Run, shape: bool) -> ConversionReport:
    from vvgt_cli.volume.medical.nrrd import write_nrrd
    from vvgt_cli.volume.shapes import make_shape

    with run.stage(request.kind) as stage:
        if shape:
            volume = make_shape(request.kind, request.size or SHAPE_SIZE, request.seed)
        else:
            volume, stage.note = _turbulence(request, run.console)
    with run.stage("write") as stage:
        run.report.bytes = write_nrrd(request.output, volume, request.overwrite)
        stage.note = f"{request.output}: {' x '.join(map(str, volume.dims))} float32"
    return run.finish()


def _turbulence(request: SynthRequest, console: Console) -> tuple[Volume, str]:
    """Return the volume, and a note about the flow."""
    from vvgt_cli.volume.shapes import volume_of
    from vvgt_cli.volume.turbulence import TURNOVER, Solver, advance, fields, flow_of

    solver = Solver(flow_of(request.kind, request.size or TURBULENCE_SIZE))
    turnovers = DEVELOPED if request.turnovers is None else request.turnovers
    state = advance(solver, solver.start(request.seed), turnovers * TURNOVER, console.bar(request.kind))
    field = request.field or ("temperature" if request.kind == "stratified" else "speed")
    values = fields(solver, state)[field]
    energy, loss = solver.energy(state), solver.dissipation(state)
    note = f"{field} after {turnovers:g} turnovers, energy {energy:.3g}, dissipation {loss:.3g}"
    return volume_of(values, f"{request.kind}-{field}-{request.seed}"), note
