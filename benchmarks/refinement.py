"""Refinement against error and seconds: at plain Adam's time, and curves with the baselines.

    PYTHONPATH=. python benchmarks/refinement.py equal SCENES.tsv DATA_DIR TF_DIR -o docs/refine-equal.csv
    PYTHONPATH=. python benchmarks/refinement.py curve SCENES.tsv DATA_DIR TF_DIR -o docs/refine-curve.csv
    PYTHONPATH=. python benchmarks/refinement.py table docs/refine-equal.csv

400 px, K = 100,000, RGB dB on the ten test views (half-voxel steps, adaptive rays), wall seconds. `equal` starts both
from the back-projected closed form: 100 steps of Adam on the file's fields with 3DGS' loss (SSIM included) on 24 views
of one ray a pixel and steps of a voxel, and our steps on 120 views, as `convert` renders them (of 200 or 300 px),
for as long as those took, views included on both sides. `curve`: every point is a run of its own from the
prepared scene on, views and closed form included. `ours` starts from the closed form as it is (without steps:
back-projected), `adam` from the back-projected one; `3dgs` from 10,000 uniform samples that grow as in 3DGS, `ivr-gs`
from as many uniform samples as the limit, with the function's colours, none added; both with 3DGS' loss and Adam, on 72
views.
"""

from __future__ import annotations

import time
from typing import Any

import click
import numpy as np
from dvr_scenes import commit, print_table, read_scenes, write_rows
from floors import machine

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.closed_form import VbmOptions, backproject, initialise
from vvgt_cli.conversion.stages.views import LARGE, MAX_VIEWS, ray_settings, suits_small_views, view_count
from vvgt_cli.dvr import Scene, render_views
from vvgt_cli.dvr.render import FIT_VIEWS
from vvgt_cli.field.workload import view_edge
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import INRIA, Rule
from vvgt_cli.images.metrics import score_views
from vvgt_cli.refine import LOSS_3DGS, OptimizeOptions, optimize
from vvgt_cli.score.views import Views
from vvgt_cli.splat import render

K, SIZE, ADAM_STEPS, BASE_VIEWS = 100_000, 400, 100, 72
STEPS = {"ours": (0, 24, 48, 96, 144, 400), "adam": (25, 100, 200), "3dgs": (300, 1000), "ivr-gs": (300, 1000)}


class Judged:
    """A scene with its check and test views."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.cameras = {name: default_views(name) for name in ("train", "check", "test")}
        self.check = Views(self.cameras["check"], render_views(scene, self.cameras["check"]))
        self.test = render_views(scene, self.cameras["test"])

    def psnr(self, gaussians: Gaussians) -> float:
        pictures = (render(gaussians, camera) for camera in self.cameras["test"])
        return score_views(self.test, pictures, perceptual=False).psnr

    def refined(self, start: Gaussians, cameras: list[Camera], images: np.ndarray, options: OptimizeOptions) -> Any:
        return optimize(start, cameras, images, options, (self.check.cameras, self.check.images))

    def closed_form(self) -> Gaussians:
        images = render_views(self.scene, self.cameras["train"], FIT_VIEWS)
        return backproject(initialise(self.scene, VbmOptions(K)), self.cameras["train"], images)[0]


def equal_row(judged: Judged) -> dict[str, Any]:
    """Our steps in the time of plain Adam's."""
    start, train = judged.closed_form(), judged.cameras["train"]
    began = time.perf_counter()
    images = render_views(judged.scene, train, FIT_VIEWS)
    adam, _ = judged.refined(start, train, images, OptimizeOptions(steps=ADAM_STEPS, method="adam", **LOSS_3DGS))
    budget = time.perf_counter() - began
    began = time.perf_counter()
    cameras, images, rule = training_views(judged, start, MAX_VIEWS)
    views = time.perf_counter() - began
    options = OptimizeOptions(steps=None, time_budget=max(budget - views, 0.0), rule=rule)
    ours, record = judged.refined(start, cameras, images, options)
    return {
        "closed_form": judged.psnr(start), "adam": judged.psnr(adam), "ours": judged.psnr(ours), "adam_s": budget,
        "ours_s": views + record.seconds, "views": len(cameras), "views_s": views, "steps": record.steps,
    }  # fmt: skip


def training_views(judged: Judged, start: Gaussians, count: int) -> tuple[list[Camera], np.ndarray, Rule]:
    """As `convert` makes them: cameras, images, rule."""
    edge = view_edge(SIZE, suits_small_views(start, SIZE))
    cameras, share = default_views("train", count, size=edge), edge / SIZE
    rule = INRIA.at(share)
    settings = ray_settings(judged.scene, start, edge, rule, 1.0 if share >= LARGE else share)
    return cameras, render_views(judged.scene, cameras, settings), rule


def begin(judged: Judged, method: str, steps: int) -> Gaussians:
    if method == "ours" and steps:  # as `convert` does
        return initialise(judged.scene, VbmOptions(K)).gaussians
    if method in ("ours", "adam"):
        return judged.closed_form()
    count = 10_000 if method == "3dgs" else K
    return initialise(judged.scene, VbmOptions(count, method="uniform")).gaussians


def point(judged: Judged, method: str, steps: int) -> dict[str, Any]:
    """One run, from the prepared scene on."""
    began = time.perf_counter()
    start = begin(judged, method, steps)
    if steps:
        if method == "ours":
            cameras, images, rule = training_views(judged, start, view_count(steps, suits_small_views(start, SIZE)))
            options = OptimizeOptions(steps=steps, rule=rule)
        else:
            cameras = default_views("train", 24 if method == "adam" else BASE_VIEWS)
            images = render_views(judged.scene, cameras, FIT_VIEWS)
            name = "adam" if method == "ivr-gs" else method
            options = OptimizeOptions(steps=steps, method=name, max_gaussians=K, **LOSS_3DGS)
        start, _ = judged.refined(start, cameras, images, options)
    seconds = time.perf_counter() - began
    return {"method": method, "steps": steps, "seconds": seconds, "psnr": judged.psnr(start), "gaussians": len(start)}


@click.group(help=__doc__)
def main() -> None:
    pass


@main.command()
@click.argument("paths", nargs=3)
@click.option("-o", "--output", required=True)
@click.option("--only", multiple=True, help="Scenes (default: all).")
def equal(paths: tuple[str, str, str], output: str, only: tuple[str, ...]) -> None:
    """Our steps in the time of plain Adam's."""
    rows: list[dict[str, Any]] = []
    for name, source in read_scenes(*paths, names=only or None):
        rows.append({"scene": name, **equal_row(Judged(source.scene())), "commit": commit(), "machine": machine()[:20]})
        print(rows[-1], flush=True)
        write_rows(output, rows)


@main.command()
@click.argument("paths", nargs=3)
@click.option("-o", "--output", required=True)
@click.option("--only", multiple=True, help="Scenes (default: all).")
def curve(paths: tuple[str, str, str], output: str, only: tuple[str, ...]) -> None:
    """Error against seconds, ours and the baselines."""
    rows: list[dict[str, Any]] = []
    for name, source in read_scenes(*paths, names=only or None):
        judged = Judged(source.scene())
        for method, all_steps in STEPS.items():
            for steps in all_steps:
                rows.append({"scene": name, **point(judged, method, steps), "commit": commit()})
                print(rows[-1], flush=True)
                write_rows(output, rows)


@main.command()
@click.argument("path")
def table(path: str) -> None:
    """A CSV as Markdown."""
    print_table(path)


if __name__ == "__main__":
    main()
