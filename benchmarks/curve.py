r"""Error against seconds of conversions with more and more steps, of states of the code in turn: CSV and plot.

    PYTHONPATH=. python benchmarks/curve.py measure SCENES.tsv DATA_DIR TF_DIR FOLDER --state before=CHECKOUT
    PYTHONPATH=. python benchmarks/curve.py score SCENES.tsv DATA_DIR TF_DIR FOLDER -o docs/curve.csv
    PYTHONPATH=. python benchmarks/curve.py plot docs/curve.csv -o docs/curve.png

`measure` runs `vvgt convert --steps N` for each scene and number of steps, with one thread, by this checkout (`after`)
and the others in turn, and leaves the files in FOLDER with the processor's seconds of each process; its scores, 1 to
2 s, are in them. `score` judges the files of all states alike: dB of ten test views, cast at 1/8 voxel. `--only SCENE`
measures one scene; what follows `--` are options of `vvgt convert`.
"""

from __future__ import annotations

import csv
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import click
from closed_form import scene_rows
from dvr_scenes import read_scenes, write_rows

STEPS, SIZE = (28, 56, 112, 152, 240), 1080
TITLE = "dB on test views against processor seconds of a conversion, one thread"


def calls(paths: tuple[str, ...], only: tuple[str, ...] = ()) -> dict[str, list[str]]:
    """Volume and options of each scene."""
    found = {}
    for name, volume, reading, function in scene_rows(Path(paths[0])):
        if not only or name in only:
            look = ["--tf", str(Path(paths[2]).resolve() / function), "--opacity-unit-distance", "mean-spacing"]
            found[name] = [str(Path(paths[1]).resolve() / volume), *shlex.split(reading), *look]
    return found


def read_rows(path: str) -> list[dict[str, Any]]:
    """Of a CSV, nothing where there is none."""
    return list(csv.DictReader(Path(path).read_text("utf-8").splitlines())) if Path(path).exists() else []


@click.group(help=__doc__)
def main() -> None:
    pass


def timed(call: list[str], checkout: str, threads: int) -> dict[str, float]:
    """Wall and processor seconds of a Python process that imports from a checkout."""
    counts = {name: str(threads) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
    before, began = os.times(), time.perf_counter()
    subprocess.run(
        [sys.executable, *call], cwd=checkout, env=os.environ | counts | {"PYTHONPATH": checkout}, check=True,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    wall, after = time.perf_counter() - began, os.times()
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return {"wall": round(wall, 3), "processor": round(used, 3)}


@main.command()
@click.argument("paths", nargs=3)
@click.argument("folder")
@click.argument("more", nargs=-1)
@click.option("--state", "states", multiple=True, metavar="LABEL=CHECKOUT")
@click.option("--only", multiple=True)
@click.option("--steps", "counts", multiple=True, type=int, default=STEPS)
def measure(
    paths: tuple[str, ...],
    folder: str,
    more: tuple[str, ...],
    states: tuple[str, ...],
    only: tuple[str, ...],
    counts: tuple[int, ...],
) -> None:
    """Files and seconds."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    for name, call in calls(paths, only).items():
        for count in counts:
            for label, checkout in [("after", str(Path.cwd())), *(state.split("=", 1) for state in states)]:
                file = (Path(folder) / f"{name}.{label}.{count}.ply").resolve()
                options = ["--steps", str(count), "--up", "none", "--threads", "1", "--overwrite", "-q", *more]
                convert = ["-m", "vvgt_cli.commands.main", "convert", *call, *options, "-o", str(file)]
                file.with_suffix(".txt").write_text(f"{timed(convert, checkout, 1)['processor']:.4g}")


@main.command()
@click.argument("paths", nargs=3)
@click.argument("folder")
@click.option("-o", "--output", required=True)
def score(paths: tuple[str, ...], folder: str, output: str) -> None:
    """The CSV of all that was measured."""
    from vvgt_cli.cameras import default_views, spread_blocks
    from vvgt_cli.dvr import RenderSettings, render_view
    from vvgt_cli.gaussians import read_ply
    from vvgt_cli.gaussians.rules import INRIA
    from vvgt_cli.images.metrics import mean_scores
    from vvgt_cli.score.views import score_drawn_view
    from vvgt_cli.splat import render

    fine = RenderSettings(step=1 / 8)
    rows: list[dict[str, Any]] = []
    parts = [(camera, spread_blocks(SIZE, SIZE, i)) for i, camera in enumerate(default_views("test", size=SIZE))]
    for name, source in read_scenes(paths[0], paths[1], paths[2]):
        scene = source.scene()
        seen = [(camera, part, render_view(scene, camera, fine, part)) for camera, part in parts]
        files = sorted(Path(folder).glob(f"{name}.*.ply"), key=lambda file: int(file.suffixes[-2][1:]))
        for file in sorted(files, key=lambda file: file.suffixes[-3]):
            made, _ = read_ply(file)
            views = [
                score_drawn_view(there, render(made, camera, INRIA, blocks=part), part, whole=False)
                for camera, part, there in seen
            ]
            label, steps = (suffix[1:] for suffix in file.suffixes[-3:-1])
            row = {
                "scene": name,
                "label": label,
                "steps": steps,
                "seconds": float(file.with_suffix(".txt").read_text()),
            }
            rows.append(row | {"psnr": mean_scores(views).psnr})
            write_rows(output, rows)


@main.command()
@click.argument("path")
@click.option("-o", "--output", required=True)
def plot(path: str, output: str) -> None:
    """A panel a scene, a line a label."""
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
        for label in dict.fromkeys(row["label"] for row in rows):
            own = [row for row in rows if (row["scene"], row["label"]) == (scene, label)]
            values = [float(row["psnr"]) for row in own]
            panel.plot([float(row["seconds"]) for row in own], values, "o-", ms=3, label=label)
        panel.set_title(scene, fontsize=9)
    panels[0, 0].legend()
    figure.suptitle(TITLE, fontsize=10)
    figure.tight_layout()
    figure.savefig(output, dpi=100)


if __name__ == "__main__":
    main()
