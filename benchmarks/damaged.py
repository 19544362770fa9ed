"""What `vvgt check` finds in a file of Gaussians, and in three damaged copies of it.

python benchmarks/damaged.py FILE --volume VOLUME --tf TF [--opacity-unit-distance D] [--name NAME] -o docs/damaged.csv
python benchmarks/damaged.py --table docs/damaged.csv

The copies: mirrored along x; a hundred rows of NaN and a hundred of sigma e^3; opacities stored as they are, not as
logits. A row a case that fails in one of them; rows of other NAMEs in the CSV stay.
"""

from __future__ import annotations

import csv
import tempfile
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import click
import numpy as np
from dvr_scenes import write_rows

from vvgt_cli.commands.check import check
from vvgt_cli.gaussians.formats import read_columns
from vvgt_cli.gaussians.formats.splats import Splats, opacities_of, ply_bytes
from vvgt_cli.library.inputs import Look

ROWS = 100  # that are damaged


def mirrored(columns: Splats) -> Splats:
    """The mirror image along x: of centres, and of covariances."""
    return replace(columns, means=columns.means * [-1, 1, 1], quaternions=columns.quaternions * [1, 1, -1, -1])


def broken_rows(columns: Splats) -> Splats:
    """NaN in some rows, and giants in others."""
    means, log_scales = columns.means.copy(), columns.log_scales.copy()
    chosen = np.random.default_rng(0).permutation(len(columns))
    means[chosen[:ROWS]], log_scales[chosen[ROWS : 2 * ROWS]] = np.nan, 3.0
    return replace(columns, means=means, log_scales=log_scales)


def plain_opacities(columns: Splats) -> Splats:
    """Opacities where logits are expected."""
    return replace(columns, logits=opacities_of(columns.logits))


DAMAGES = {"mirrored": mirrored, "broken rows": broken_rows, "opacities for logits": plain_opacities}


@click.command()
@click.argument("file", required=False)
@click.option("--volume")
@click.option("--tf")
@click.option("--opacity-unit-distance", "distance")
@click.option("--name", default="vvgt")
@click.option("--output", "-o", type=click.Path(path_type=Path))
@click.option("--table", type=click.Path(exists=True, path_type=Path))
def main(
    file: str | None, volume: str | None, tf: str | None, distance: str | None, name: str, output: Path | None,
    table: Path | None,
) -> None:  # fmt: skip
    """Check a file and its damaged copies, or print the table again."""
    if table:
        print("| file | copy | what fails |\n| --- | --- | --- |")
        with table.open(newline="") as stream:
            for key, rows in groupby(csv.DictReader(stream), lambda row: (row["file"], row["copy"])):
                said = "; ".join(f"{row['case']}: {row['found']}" if row["case"] else row["found"] for row in rows)
                print(f"| {key[0]} | {key[1]} | {said} |")
        return
    assert file
    assert volume
    assert output
    look, columns, found = Look(tf, opacity_unit_distance=distance), read_columns(file), []
    with tempfile.TemporaryDirectory() as folder:
        for damage, change in {"as it is": lambda same: same, **DAMAGES}.items():
            path = Path(folder) / f"{name}.ply"
            path.write_bytes(ply_bytes(change(columns)))
            outcomes = check(path, look, volume=volume).outcomes
            fails = [o for o in outcomes if not o.passed]
            for o in fails:
                measured = "" if o.value is None else f"{o.value:.3g} {o.what}"
                found.append({"file": name, "copy": damage, "case": f"{o.stage}: {o.name}", "found": measured})
            if not fails:
                nothing = f"none of {len(outcomes)} cases fails"
                found.append({"file": name, "copy": damage, "case": "", "found": nothing})
    kept = []
    if output.exists():
        with output.open(newline="") as stream:
            kept = [row for row in csv.DictReader(stream) if row["file"] != name]
    write_rows(output, [*kept, *found])


if __name__ == "__main__":
    main()
