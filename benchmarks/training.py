"""Training data, and what a trained network gains.

    python benchmarks/training.py data DIR

`data` writes the volumes that the shipped model was trained on (`train/`) and those that it never saw (`held/`):
snapshots of turbulence at 64^3, and shapes at 96^3. About 15 minutes of one core.
"""

from __future__ import annotations

from pathlib import Path

import click

from vvgt_cli.progress import Console
from vvgt_cli.synth.analytic import volume_of
from vvgt_cli.synth.shapes import SHAPES, make_shape
from vvgt_cli.synth.turbulence import TURNOVER, Solver, fields, flow_of, run
from vvgt_cli.volume.nrrd_write import write_nrrd

GRID, SIZE = 64, 96
TRAINED, HELD = range(6), range(100, 102)  # seeds of shapes
FIRST, EVERY, SNAPSHOTS = 2.0, 0.6, 5  # turnovers
HELD_SEED = 100


@click.group()
def main() -> None:
    """Benchmarks of training."""


def shapes(folder: Path) -> None:
    """All shapes."""
    for part, seeds in (("train", TRAINED), ("held", HELD)):
        for kind in SHAPES:
            for seed in seeds:
                path = folder / part / f"{kind}_{seed}.nrrd"
                if not path.exists():
                    write_nrrd(path, make_shape(kind, SIZE, seed))


def turbulence(folder: Path, kind: str, seed: int, snapshots: int, console: Console) -> None:
    """Snapshots of one flow, every field a file; a flow that is there already is left out."""
    name = lambda field, number: folder / f"{kind}_{seed}_{number}_{field}.nrrd"  # noqa: E731
    if name("speed", snapshots - 1).exists():
        return
    solver = Solver(flow_of(kind, GRID))
    state = solver.start(seed)
    for number in range(snapshots):
        state = run(solver, state, TURNOVER * (EVERY if number else FIRST))
        console.say(f"{kind} {seed}, snapshot {number}: E {solver.energy(state):.3f}, "
                    f"dissipation {solver.dissipation(state):.3f}")  # fmt: skip
        for field, values in fields(solver, state).items():
            write_nrrd(name(field, number), volume_of(values, field), overwrite=True)


@main.command()
@click.argument("folder", type=Path)
def data(folder: Path) -> None:
    """Write the volumes."""
    for part in ("train", "held"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    shapes(folder)
    for kind in ("isotropic", "stratified"):
        turbulence(folder / "held", kind, HELD_SEED, 1, Console())
        turbulence(folder / "train", kind, 0, SNAPSHOTS, Console())


if __name__ == "__main__":
    main()
