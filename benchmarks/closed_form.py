"""Closed form against the volume renderer on a list of scenes: a CSV row each, and a table of it.

    PYTHONPATH=. python benchmarks/closed_form.py SCENES.tsv DATA_DIR TF_DIR -o docs/closed-form.csv
    PYTHONPATH=. python benchmarks/closed_form.py --table docs/closed-form.csv

SCENES.tsv has the columns scene, volume in DATA_DIR, options of `vvgt convert`, function in TF_DIR. Unit distance:
mean-spacing. References are pixel-integrated (3 x 3 rays where neighbours differ) at `--step` voxels, on the test views
at 1x and every third of them at 2x.
"""

from __future__ import annotations

import csv
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.closed_form import VbmOptions, backproject, initialise
from vvgt_cli.dvr import RenderSettings, Scene, render_views
from vvgt_cli.dvr.render import FIT_VIEWS
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.images.metrics import score_views
from vvgt_cli.splat import render
from vvgt_cli.volume import ReadOptions

FIELDS = ["psnr", "psnr_foreground", "psnr_white", "psnr_alpha", "ssim", "psnr_2x", "init_psnr", "gaussians"]
SECONDS = ["closed_form_s", "views_s", "back_projection_s"]


def scene_rows(listing: str | Path, only: Sequence[str] = ()) -> list[list[str]]:
    """Scene, volume, options and function of each line of a list, or of ``only`` some scenes."""
    lines = [line for line in Path(listing).read_text("utf-8").splitlines() if line.strip() and line[0] != "#"]
    rows = [[word.strip() for word in line.split("\t")[:4]] for line in lines]
    return [row for row in rows if row[0] != "scene" and (not only or row[0] in only)]


def read_options(text: str) -> ReadOptions:
    """The options that the list may hold: --spacing X Y Z."""
    words = shlex.split(text)
    if not words:
        return ReadOptions()
    if words[0] != "--spacing" or len(words) != 4:
        raise click.UsageError(f"options {text!r}; expected --spacing X Y Z or nothing")
    return ReadOptions(spacing=tuple(float(w) for w in words[1:]))  # type: ignore[arg-type]


def measure(scene: Scene, method: str, budget: int, step: float) -> dict[str, float]:
    """Scores and seconds of one scene."""
    clock = [time.perf_counter()]
    start = initialise(scene, VbmOptions(max_gaussians=budget, method=method))
    clock.append(time.perf_counter())
    train = default_views("train")
    images = render_views(scene, train, FIT_VIEWS)
    clock.append(time.perf_counter())
    gaussians, how = backproject(start, train, images)
    clock.append(time.perf_counter())
    print(f"   {how}", file=sys.stderr)
    test = default_views("test")
    reference = render_views(scene, test, RenderSettings(step=step))
    scores = score_views(reference, np.stack([render(gaussians, c) for c in test]))
    before = score_views(reference, np.stack([render(start.gaussians, c) for c in test]), perceptual=False)
    large = [c.resized(2) for c in test[::3]]
    twice = score_views(
        render_views(scene, large, RenderSettings(step=0.5)),
        np.stack([render(gaussians, c) for c in large]),
        perceptual=False,
    )
    row = {name: getattr(scores, name) for name in FIELDS[:5]}
    row |= {"psnr_2x": twice.psnr, "init_psnr": before.psnr, "gaussians": len(gaussians)}
    return row | dict(zip(SECONDS, np.diff(clock), strict=True))


def table(path: str) -> str:
    """The CSV as a Markdown table."""
    rows = list(csv.DictReader(Path(path).read_text().splitlines()))
    columns = ["scene", "method", *FIELDS, *SECONDS]
    lines = ["| " + " | ".join(columns) + " |", "| --- " * len(columns) + "|"]
    lines += ["| " + " | ".join(row[c] for c in columns) + " |" for row in rows]
    for method in dict.fromkeys(row["method"] for row in rows):
        values = [float(row["psnr"]) for row in rows if row["method"] == method]
        lines.append(f"\nMean PSNR, {method}: {np.mean(values):.2f} dB.")
    lines.append(f"\nCommit {rows[0]['commit']}, {rows[0]['machine']}.")
    return "\n".join(lines)


@click.command()
@click.argument("paths", nargs=-1)
@click.option("-o", "--output", help="CSV to write.")
@click.option("--table", "stored", help="CSV to print as a Markdown table instead of measuring.")
@click.option("--only", multiple=True, help="Scenes to measure (default: all).")
@click.option("--method", multiple=True, default=("moments",), help="moments, wavelet, uniform.")
@click.option("--max-gaussians", default=100_000)
@click.option("--step", default=0.25, help="Step of the reference in voxels.")
def main(paths, output, stored, only, method, max_gaussians, step):
    """Measure SCENES.tsv DATA_DIR TF_DIR, or print a stored CSV as a table."""
    if stored:
        print(table(stored))
        return
    if len(paths) != 3 or not output:
        raise click.UsageError("expected SCENES.tsv DATA_DIR TF_DIR -o CSV")
    scenes, data, functions = map(Path, paths)
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    rows = []
    for name, volume, options, function in scene_rows(scenes, only):
        for how in method:
            request = SourceRequest(
                volume=str(data / volume),
                tf=str(functions / function),
                read=read_options(options),
                unit_distance="mean-spacing",
            )
            print(f"{name} {how}", file=sys.stderr)
            measured = measure(load(request).scene(), how, max_gaussians, step)
            texts = {k: str(v) if isinstance(v, int) else f"{v:.3f}" for k, v in measured.items() if v is not None}
            rows.append({"scene": name, "method": how, **texts, "commit": commit, "machine": machine})
            with open(output, "w", newline="") as file:
                writer = csv.DictWriter(file, list(rows[0]))
                writer.writeheader()
                writer.writerows(rows)


if __name__ == "__main__":
    main()
