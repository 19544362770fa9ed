"""Training data, and what a trained network gains.

    python benchmarks/training.py data DIR
    PYTHONPATH=. python benchmarks/training.py gain SCENES DATA_DIR TF_DIR -o CSV --model MODEL [--gaussians K]
    PYTHONPATH=. python benchmarks/training.py held DIR CONFIG.yaml -o CSV --model MODEL

`data` writes the volumes that the shipped model was trained on (`train/`) and those that it never saw (`held/`):
snapshots of turbulence at 64^3, and shapes at 96^3 to 160^3. About 10 minutes of one core, half of that on two.

`gain` takes the closed form of each scene through the model, through 25 and 100 steps of refinement, 36 steps on views
half the size, and through model and 100 steps: PSNR and SSIM on the ten test views (400 px, half-voxel steps, 2 x 2
rays where neighbours differ, as the 24 training and 4 check views), and processor seconds of one thread, of the closed
form and from there on. SCENES is a table as in `closed_form.py`. `held` does the same on the scenes that training holds
out, at their own size, scored on the views that losses are taken on.
"""

from __future__ import annotations

import csv
import os
import pickle
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import click
import numba
import numpy as np
from closed_form import read_options, scene_rows

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.closed_form import VbmOptions, initialise
from vvgt_cli.dvr import RenderSettings, Scene, render_views
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.images.metrics import score_views, ssim
from vvgt_cli.network.card import find_model
from vvgt_cli.network.prepare import halved
from vvgt_cli.network.runtime import Model
from vvgt_cli.network.training.config import read_config
from vvgt_cli.network.training.scenes import as_float, prepare_scenes
from vvgt_cli.progress import Console
from vvgt_cli.refine import OptimizeOptions, optimize
from vvgt_cli.splat import render
from vvgt_cli.volume.shapes import make_shape, volume_of
from vvgt_cli.volume.turbulence import TURNOVER, Solver, advance, fields, flow_of
from vvgt_cli.volume.writers import write_nrrd

GRID, SIZES = 64, (96, 128, 160)
KINDS = ("shells", "tubes", "plates", "noise", "wells", "bodies", "bodies")  # the last twice, other seeds
TRAINED, HELD = range(6), range(100, 102)  # seeds of shapes
FIRST, EVERY, SNAPSHOTS = 2.0, 0.6, 5  # turnovers
HELD_SEED, MORE = 100, 1000


@click.group()
def main() -> None:
    """Benchmarks of training."""


def shapes(folder: Path, kinds: tuple[str, ...], sizes: tuple[int, ...], seeds: range) -> None:
    """Shapes of all kinds and seeds."""
    for number, kind in enumerate(kinds):
        for seed in seeds:
            own = seed + MORE * kinds[:number].count(kind)
            path = folder / f"{kind}_{own}.nrrd"
            if not path.exists():
                write_nrrd(path, make_shape(kind, sizes[own % len(sizes)], own))


def turbulence(folder: Path, kind: str, grid: int, seed: int, turnovers: list[float]) -> None:
    """Snapshots of one flow that many ``turnovers`` apart, every field a file; a flow that is there is left out."""
    name = lambda field, number: folder / f"{kind}_{seed}_{number}_{field}.nrrd"  # noqa: E731
    if name("speed", len(turnovers) - 1).exists():
        return
    solver = Solver(flow_of(kind, grid))
    state = solver.start(seed)
    for number, turnover in enumerate(turnovers):
        state = advance(solver, state, TURNOVER * turnover)
        Console().message(f"{kind} {seed}, snapshot {number}: E {solver.energy(state):.3f}, "
                    f"dissipation {solver.dissipation(state):.3f}")  # fmt: skip
        for field, values in fields(solver, state).items():
            write_nrrd(name(field, number), volume_of(values, field), overwrite=True)


@main.command()
@click.argument("folder", type=Path)
def data(folder: Path) -> None:
    """Write the volumes."""
    train, held = folder / "train", folder / "held"
    for part in (train, held):
        part.mkdir(parents=True, exist_ok=True)
    later = [EVERY] * (SNAPSHOTS - 1)
    # new processes read this file anew: what they make is named in full
    with ProcessPoolExecutor(len(os.sched_getaffinity(0)), get_context("spawn")) as pool:
        jobs = []
        for kind in ("isotropic", "stratified"):
            jobs.append(pool.submit(turbulence, train, kind, GRID, 0, [FIRST, *later]))
            jobs.append(pool.submit(turbulence, held, kind, GRID, HELD_SEED, [FIRST]))
        jobs += [pool.submit(shapes, part, KINDS, SIZES, seeds) for part, seeds in ((train, TRAINED), (held, HELD))]
        for job in jobs:
            job.result()


SETTINGS, SETS = RenderSettings(step=0.5, samples=2), ("train", "check", "test")
Refine = Callable[[Gaussians], Gaussians]


def listed(scenes: str, data: str, functions: str) -> Iterator[tuple[str, Callable[[], Scene]]]:
    """Names of the scenes, and what makes each."""
    for name, volume, options, function in scene_rows(scenes):
        request = SourceRequest(
            volume=str(Path(data) / volume), tf=str(Path(functions) / function), read=read_options(options),
            unit_distance="mean-spacing",
        )  # fmt: skip
        yield name, lambda request=request: load(request).scene()


def kept(place: Path | None, make: Callable[[], object]) -> object:
    """What ``make`` gives, from the file ``place`` where it is there."""
    if place and place.exists():
        return pickle.loads(place.read_bytes())
    found = make()
    if place:
        place.parent.mkdir(exist_ok=True)
        place.write_bytes(pickle.dumps(found))
    return found


def all_views(make: Callable[[], Scene]) -> dict[str, np.ndarray]:
    """Views by set."""
    scene = make()
    return {name: render_views(scene, default_views(name), SETTINGS) for name in SETS}


def begun(make: Callable[[], Scene], budget: int, method: str) -> tuple[Gaussians, float]:
    """The closed form, and its processor seconds."""
    scene, start = make(), time.process_time()
    return initialise(scene, VbmOptions(max_gaussians=budget, method=method)).gaussians, time.process_time() - start


@dataclass
class Case:
    """A scene to compare on: where to start, views to fit to, to check by (None: the end is returned) and to score."""

    start: Gaussians
    cameras: list[Camera]
    images: np.ndarray
    check: tuple[list[Camera], np.ndarray] | None
    test: tuple[list[Camera], np.ndarray]


def ways(case: Case, model: Model | None) -> dict[str, list[Refine]]:
    """What is compared: names, and the stages after the closed form."""

    def steps(count: int) -> Refine:
        options = OptimizeOptions(steps=count)
        return lambda g: optimize(g, case.cameras, case.images, options, case.check)[0]

    def half_steps(g: Gaussians) -> Gaussians:
        cameras, images, rule = halved(case.cameras, case.images)
        return optimize(g, cameras, images, OptimizeOptions(steps=36, rule=rule), case.check)[0]

    found: dict[str, list[Refine]] = {
        "closed form": [], "25 steps": [steps(25)], "36 steps on half views": [half_steps], "100 steps": [steps(100)]
    }  # fmt: skip
    if model is None:
        return found
    network: Refine = lambda g: model.improve(g, case.cameras, case.images)  # noqa: E731
    return found | {"network": [network], "network + 100 steps": [network, steps(100)]}


def compare(case: Case, model: Model | None, wanted: tuple[str, ...]) -> Iterator[dict[str, str]]:
    """A row a way."""
    for way, stages in ways(case, model).items():
        if wanted and way not in wanted:
            continue
        gaussians, start = case.start, time.process_time()
        for stage in stages:
            gaussians = stage(gaussians)
        spent = time.process_time() - start
        pictures = [render(gaussians, camera) for camera in case.test[0]]
        found = score_views(case.test[1], pictures, perceptual=False).psnr
        alike = [ssim(view[..., :3], ours[..., :3]) for view, ours in zip(case.test[1], pictures, strict=True)]
        yield {
            "gaussians": str(len(gaussians)), "way": way, "psnr": f"{found:.3f}", "ssim": f"{np.mean(alike):.4f}",
            "cpu_seconds": f"{spent:.2f}",
        }  # fmt: skip


def write(output: str, rows: list[dict[str, str]]) -> None:
    """Print the last row, and write all."""
    print(rows[-1], flush=True)
    with open(output, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


@main.command()
@click.argument("folder", type=Path)
@click.argument("config")
@click.option("-o", "--output", required=True, help="CSV to write.")
@click.option("--model", required=True, help="Folder or name of a model.")
@click.option("--ways", "wanted", multiple=True, help="Of what is compared (default: all).")
def held(folder, config, output, model, wanted):
    """The scenes that training with CONFIG on FOLDER holds out."""
    numba.set_num_threads(1)
    opened, rows = Model.open(find_model(model), threads=1), []
    for part, scenes in prepare_scenes(folder, read_config(config).scenes, Console(quiet=True)).items():
        for scene in scenes if part != "train" else []:
            test = (list(scene.targets), as_float(scene.target_images))
            case = Case(scene.gaussians, list(scene.cameras), as_float(scene.images), None, test)
            for row in compare(case, opened, wanted):
                rows.append({"part": part, "scene": scene.name, **row})
                write(output, rows)


@main.command()
@click.argument("scenes")
@click.argument("folders", nargs=2)
@click.option("-o", "--output", required=True, help="CSV to write.")
@click.option("--model", help="Folder or name of a model; without it only its rivals run.")
@click.option("--gaussians", "budget", default=50_000)
@click.option("--init", "method", default="moments", help="moments or wavelet.")
@click.option("--only", multiple=True, help="Scenes to measure (default: all).")
@click.option("--ways", "wanted", multiple=True, help="Of what is compared (default: all).")
@click.option("--cache", type=Path, help="Folder for views and closed forms, which a second run takes from there.")
def gain(scenes, folders, output, model, budget, method, only, wanted, cache):
    """PSNR, SSIM and processor seconds, a row a scene and way."""
    numba.set_num_threads(1)
    opened = Model.open(find_model(model), threads=1) if model else None
    rows = []
    for name, make in listed(scenes, *folders):
        if only and name not in only:
            continue
        at = lambda rest, name=name: cache / (name + rest) if cache else None  # noqa: E731
        render_all = partial(all_views, make)
        views = kept(at(".views"), render_all)
        closed, seconds = kept(at(f"-{budget}-{method}.g"), partial(begun, make, budget, method))
        sets = {name: (default_views(name), images) for name, images in views.items()}
        case = Case(closed, *sets["train"], sets["check"], sets["test"])
        for row in compare(case, opened, wanted):
            if row["way"] == "closed form":
                row["cpu_seconds"] = f"{seconds:.2f}"
            rows.append({"scene": name, "init": method, **row})
            write(output, rows)


if __name__ == "__main__":
    main()
