"""Cost of the network in onnxruntime: time, processor time and memory over Gaussians, views and threads.

    python benchmarks/network.py checkpoint small.pt [--config small]     # random weights; needs torch
    vvgt export small.pt -o small
    PYTHONPATH=. python benchmarks/network.py measure small -o docs/network.csv
    PYTHONPATH=. python benchmarks/network.py profile small [--gaussians K]
    python benchmarks/network.py flops [--config small]                   # arithmetic of a pass; needs torch
    PYTHONPATH=. python benchmarks/network.py table docs/network.csv

Gaussians are the closed form's of `example:frog`, views their own pictures of 400 px: weights are random, so nothing
but cost is measured. `lines` is the worst that the grid can meet: points on two lines, of which every pool keeps nearly
half. Each case runs in a process of its own, after one run that is not counted; the row holds the median wall and
processor seconds (user and system, all threads) of the repeats, which are alternated over the cases, and the process'
largest resident memory.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import click
import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.network import NAMED
from vvgt_cli.network.prepare import prepare

VOLUME = "example:frog"
CASES = [
    ("frog", 50_000, 8, 2), ("frog", 50_000, 8, 1), ("frog", 50_000, 4, 2), ("frog", 50_000, 2, 2),
    ("frog", 10_000, 8, 2), ("frog", 150_000, 8, 2), ("frog", 300_000, 8, 2), ("lines", 160_000, 8, 2),
]  # fmt: skip


def closed_form(count: int) -> Gaussians:
    """About ``count`` Gaussians of the closed form."""
    from vvgt_cli.closed_form import VbmOptions, initialise
    from vvgt_cli.dvr import Scene
    from vvgt_cli.look import from_histogram
    from vvgt_cli.volume import read_volume
    from vvgt_cli.volume import statistics as volume_statistics

    volume = read_volume(VOLUME)
    scene = Scene.build(volume, from_histogram(volume_statistics(volume)), float(np.mean(volume.spacing)))
    return initialise(scene, VbmOptions(max_gaussians=count, size=800)).gaussians


def lines(count: int) -> Gaussians:
    """``count`` Gaussians on two lines."""
    place = np.linspace(-1, 1, count // 2)
    means = np.concatenate([np.column_stack([place, 0 * place + y, 0 * place]) for y in (-0.5, 0.5)])
    count = len(means)
    turned = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return Gaussians(means, np.full((count, 3), -6.0), turned, np.zeros(count), np.full((count, 3), 0.5))


def save(folder: Path, scene: str, count: int, views: int) -> Path:
    """Gaussians and their pictures in a file, so that the measured process does not make them."""
    from vvgt_cli.splat import render

    path = folder / f"{scene}-{count}-{views}.npz"
    g = lines(count) if scene == "lines" else closed_form(count)
    images = np.stack([render(g, camera) for camera in default_views("train", views)])
    np.savez(path, g.means, g.log_scales, g.quaternions, g.opacity_logits, g.colors, images)
    return path


def load(path: Path) -> tuple[Gaussians, np.ndarray]:
    arrays = list(np.load(path).values())
    return Gaussians(*arrays[:5]), arrays[5]


def peak_gib() -> float:
    """Largest resident memory of this process; what getrusage tells would begin with the parent's."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 2**20


def processor_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def measured(call: Any) -> tuple[Any, float, float]:
    """Result, wall seconds and processor seconds of a call."""
    wall, used = time.perf_counter(), processor_seconds()
    result = call()
    return result, time.perf_counter() - wall, processor_seconds() - used


@click.group(help=__doc__)
def main() -> None:
    pass


@main.command()
@click.argument("path")
@click.option("--config", default="small")
def checkpoint(path: str, config: str) -> None:
    import torch

    from vvgt_cli.network.checkpoint import NetworkCheckpoint, save_checkpoint
    from vvgt_cli.network.export import randomised
    from vvgt_cli.network.model import Vvgt

    torch.manual_seed(0)
    save_checkpoint(path, NetworkCheckpoint(randomised(Vvgt(NAMED[config]))))


@main.command()
@click.argument("model")
@click.argument("data")
@click.argument("threads", type=int)
def one(model: str, data: str, threads: int) -> None:
    """A case, one counted run; called by `measure`."""
    from vvgt_cli.network.runtime import POINTS, Model

    gaussians, images = load(Path(data))
    cameras = default_views("train", len(images))
    opened, wall, _ = measured(lambda: Model.open(Path(model), threads))
    row: dict[str, Any] = {"load": wall}
    config, run = opened.card.network, opened._run
    parts: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])

    def timed(graph: str, feed: dict[str, np.ndarray]) -> list[np.ndarray]:
        out, seconds, used = measured(lambda: run(graph, feed))
        parts[graph][0] += seconds
        parts[graph][1] += used
        return out

    opened._run = timed  # type: ignore[method-assign]
    opened.improve(gaussians, cameras, images)
    parts.clear()
    _, wall, used = measured(lambda: opened.improve(gaussians, cameras, images))
    row |= {"wall": wall, "cpu": used, "image": parts["image"][0], "geometry": parts["geometry"][0]}
    row |= {"image_cpu": parts["image"][1], "geometry_cpu": parts["geometry"][1]}
    row["peak_gib"] = peak_gib()
    first = prepare(gaussians, cameras, images, config).part(0, min(len(gaussians), POINTS))
    row["points"] = "/".join(str(len(first[f"neighbours_{i}"])) for i in range(1, 5))
    print(json.dumps(row))


@main.command()
@click.argument("model")
@click.option("-o", "--output")
@click.option("--repeats", default=3)
def measure(model: str, output: str | None, repeats: int) -> None:
    from dvr_scenes import commit, write_rows
    from floors import machine

    found: dict[tuple[str, int, int, int], list[dict[str, Any]]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as scratch:
        data = {key: save(Path(scratch), *key) for key in {case[:3] for case in CASES}}
        for _ in range(repeats):
            for case in CASES:
                call = [sys.executable, __file__, "one", model, str(data[case[:3]]), str(case[3])]
                environment = os.environ | {"NUMBA_NUM_THREADS": str(case[3]), "OMP_NUM_THREADS": str(case[3])}
                done = subprocess.run(call, capture_output=True, text=True, check=True, env=environment)
                found[case].append(json.loads(done.stdout.splitlines()[-1]) | {"cpu_load": os.getloadavg()[0]})
                print(case, found[case][-1], file=sys.stderr, flush=True)
    rows = []
    for (scene, count, views, threads), runs in found.items():
        row: dict[str, Any] = {"scene": scene, "gaussians": count, "views": views, "threads": threads}
        for key in ("wall", "cpu", "image", "image_cpu", "geometry", "geometry_cpu", "load", "peak_gib", "cpu_load"):
            row[key] = statistics.median(run[key] for run in runs)
        row |= {"points": runs[0]["points"], "commit": commit(), "machine": machine().split(",")[0]}
        rows.append(row)
    write_rows(output, rows)


@main.command()
@click.argument("model")
@click.option("--gaussians", default=50_000)
@click.option("--threads", default=2)
def profile(model: str, gaussians: int, threads: int) -> None:
    """Processor milliseconds of each kind of node."""
    import onnxruntime

    from vvgt_cli.network.runtime import Model

    with tempfile.TemporaryDirectory() as scratch:
        given, images = load(save(Path(scratch), "frog", gaussians, 8))
        cameras = default_views("train", 8)
        opened = Model.open(Path(model), threads)
        for name, record in opened.card.graphs.items():
            options = opened.sessions[name].get_session_options()
            options.enable_profiling = True
            options.profile_file_prefix = f"{scratch}/{name}"
            opened.sessions[name] = onnxruntime.InferenceSession(str(Path(model) / record["file"]), options)
        _, wall, used = measured(lambda: prepare(given, cameras, images, opened.card.network).arrays())
        print(f"prepare: {1e3 * wall:.0f} ms wall, {1e3 * used:.0f} ms of processors")
        opened.improve(given, cameras, images)
        for name, session in opened.sessions.items():
            kinds: dict[str, float] = defaultdict(float)
            for event in json.loads(Path(session.end_profiling()).read_text()):
                if event.get("cat") == "Node" and event["name"].endswith("kernel_time"):
                    kinds[event["args"]["op_name"]] += event["dur"] / 1e3
            total = sum(kinds.values())
            print(f"{name}: {total:.0f} ms")
            for kind, spent in sorted(kinds.items(), key=lambda item: -item[1])[:10]:
                print(f"  {kind:<20}{spent:8.1f} ms  {100 * spent / total:4.0f} %")


@main.command()
@click.option("--config", default="small")
def flops(config: str) -> None:
    """Multiplications and additions of matrix products and convolutions, by torch's own count."""
    import torch
    from floors import flops as rate
    from torch.nn.attention import SDPBackend, sdpa_kernel
    from torch.utils.flop_counter import FlopCounterMode

    from vvgt_cli.network.model import Vvgt

    network = Vvgt(NAMED[config]).eval()
    best = rate(np.float32)
    print(f"{best / 1e9:.0f} Gflop/s in a matrix product of 1024 x 1024, all threads")
    for count in (50_000, 150_000):
        gaussians, views = closed_form(count), 8
        images = np.zeros((views, 224, 224, 4), np.float32)
        arrays = prepare(gaussians, default_views("train", views, size=224), images, NAMED[config]).arrays()
        counter = FlopCounterMode(display=False)
        # the fused kernel of attention is not counted, the plain one is
        with counter, sdpa_kernel(SDPBackend.MATH), torch.no_grad():
            network({name: torch.from_numpy(np.array(array)) for name, array in arrays.items()})
        counts = counter.get_flop_counts()
        for side in ("Vvgt.image", "Vvgt.geometry", "Vvgt.geometry.transformer.vgf"):
            work = sum(counts[side].values())
            print(f"{count} x {views} {side}: {work / 1e9:.1f} Gflop, {work / best:.2f} s at that rate")


@main.command()
@click.argument("path")
def table(path: str) -> None:
    """The CSV as Markdown."""
    from dvr_scenes import print_table

    print_table(path)


if __name__ == "__main__":
    main()
