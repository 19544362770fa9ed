r"""Error against seconds of refinement, of one state of the code beside another: CSV and plot.

    PYTHONPATH=. NUMBA_NUM_THREADS=1 python benchmarks/curve.py measure SCENES.tsv DATA_DIR TF_DIR \
        --label after -o docs/curve.csv
    PYTHONPATH=. python benchmarks/curve.py plot docs/curve.csv -o docs/curve.png

`measure` converts each scene up to its views and cells, then refines from there with each number of steps in turn. For
the other state, run the same program with `PYTHONPATH` at its checkout and another `--label`: rows are added to the
file. Seconds are those of the processor: before the steps, and of them with their looks at the check views, whose mean
dB is given. `--only SCENE` measures one scene; what follows `--` are options of `vvgt convert`.
"""

from __future__ import annotations

import csv
import shlex
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import click
from closed_form import scene_rows
from dvr_scenes import write_rows

from vvgt_cli.cli.main import run
from vvgt_cli.conversion.stage import Work
from vvgt_cli.conversion.stages import refinement

STEPS = (28, 56, 112, 240)
TITLE = "dB on check views against processor seconds, one thread"


def curve(call: list[str], counts: tuple[int, ...]) -> list[dict[str, Any]]:
    """Rows of the conversion ``vvgt convert CALL``, refined with each of ``counts`` steps."""
    rows: list[dict[str, Any]] = []
    began = time.process_time()
    usual = refinement.Refinement.run

    def each(stage: refinement.Refinement, work: Work) -> None:
        start, before = work.made(), time.process_time() - began
        rows.append({"steps": 0, "before": before, "seconds": 0.0, "psnr": work.psnr(start)})
        usual(replace(stage, most=1), work)  # loads kernels
        for count in counts:
            work.gaussians = start
            since = time.process_time()
            usual(replace(stage, most=count), work)
            seconds = time.process_time() - since
            rows.append({"steps": count, "before": before, "seconds": seconds, "psnr": work.psnr(work.made())})

    with tempfile.TemporaryDirectory() as folder, mock.patch.object(refinement.Refinement, "run", each):
        if run(["convert", *call, "-o", str(Path(folder) / "a.ply"), "-q"]):
            raise SystemExit(1)
    return rows


def read_rows(path: str) -> list[dict[str, Any]]:
    """Of a CSV, nothing where there is none."""
    return list(csv.DictReader(Path(path).read_text("utf-8").splitlines())) if Path(path).exists() else []


@click.group(help=__doc__)
def main() -> None:
    pass


@main.command()
@click.argument("paths", nargs=-1)
@click.option("-o", "--output", required=True)
@click.option("--label", required=True)
@click.option("--only", multiple=True)
@click.option("--steps", multiple=True, type=int, default=STEPS)
def measure(paths: tuple[str, ...], output: str, label: str, only: tuple[str, ...], steps: tuple[int, ...]) -> None:
    """Add rows of one state of the code."""
    listing, data, functions = map(Path, paths[:3])
    rows = read_rows(output)
    for name, volume, reading, function in scene_rows(listing):
        if only and name not in only:
            continue
        call = [str(data / volume), *shlex.split(reading), "--tf", str(functions / function)]
        call += ["--opacity-unit-distance", "mean-spacing", *paths[3:]]
        rows += [{"scene": name, "label": label, **row} for row in curve(call, steps)]
        write_rows(output, rows)


@main.command()
@click.argument("path")
@click.option("-o", "--output", required=True)
def plot(path: str, output: str) -> None:
    """A panel a scene, a line a label; seconds include those before the steps, the same for both."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = read_rows(path)
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    wide = min(len(scenes), 4)
    high = -(-len(scenes) // wide)
    figure, panels = pyplot.subplots(high, wide, figsize=(max(3 * wide, 5), 2.5 * high + 0.5), squeeze=False)
    for panel in panels.flat[len(scenes) :]:
        panel.set_axis_off()
    for panel, scene in zip(panels.flat, scenes, strict=False):
        before = min(float(row["before"]) for row in rows if row["scene"] == scene)
        for label in dict.fromkeys(row["label"] for row in rows):
            own = [row for row in rows if (row["scene"], row["label"]) == (scene, label)]
            seconds = [before + float(row["seconds"]) for row in own]
            panel.plot(seconds, [float(row["psnr"]) for row in own], "o-", ms=3, label=label)
        panel.set_title(scene, fontsize=9)
    panels[0, 0].legend()
    figure.suptitle(TITLE, fontsize=10)
    figure.tight_layout()
    figure.savefig(output, dpi=100)


if __name__ == "__main__":
    main()
