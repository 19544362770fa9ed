r"""Whole commands beside VTK's CPU mapper, in turn, each a process of its own: a CSV of seconds, a table of medians.

    PYTHONPATH=. python benchmarks/whole.py measure SCENES.tsv DATA_DIR TF_DIR -o docs/whole.csv --rounds 7 --threads 2
    PYTHONPATH=. python benchmarks/whole.py table docs/whole.csv

Of each scene: `vvgt convert` with its default, the same of another state of the code (`--other CHECKOUT`, run with this
Python) and under a head-light (`--lit`); `vvgt render-views` of 24 views of 400 px as PNGs without a cloud, with its
default rays, and with one ray a pixel at the longest step that has no more error than VTK's (`dvr_vtk.py`); and `vtk`,
a process that reads the volume, draws these views with VTK's CPU mapper, one ray a pixel, half-voxel steps, and writes
PNGs. Wall and processor seconds.
"""

from __future__ import annotations

import math
import statistics
import tempfile
from pathlib import Path
from typing import Any

import click
from curve import calls, read_rows, timed
from dvr_scenes import read_scenes, write_rows

STEP = {  # voxels
    "bonsai-tree": 3.0, "embryo-shells": 3.0, "embryo-opaque": 3.0, "ironprot-density": 1.5, "neghip-fog": 2.0,
    "headsq-bone-skin": 2.0, "headsq-step": 1.5, "spm152-tissue": 3.0,
}  # fmt: skip
VIEWS, SIZE = 24, 400


@click.group(help=__doc__)
def main() -> None:
    pass


@main.command()
@click.argument("paths", nargs=3)
@click.argument("name")
@click.argument("folder")
@click.option("--threads", type=int, default=2)
def vtk(paths: tuple[str, ...], name: str, folder: str, threads: int) -> None:
    """VTK's views of one scene."""
    import numpy as np
    from dvr_vtk import distance, vtk_window
    from PIL import Image

    from vvgt_cli.cameras import default_views
    from vvgt_cli.dvr.vtk import aim, read_pixels

    ((_, source),) = read_scenes(paths[0], paths[1], paths[2], names=(name,))
    scene = source.scene()
    window, renderer, mapper = vtk_window(scene, threads)
    window.SetSize(SIZE, SIZE)
    for i, camera in enumerate(default_views("train", VIEWS, size=SIZE)):
        aim(renderer, camera)
        mapper.SetSampleDistance(distance(scene, camera, 0.5))
        mapper.Modified()
        window.Render()
        pixels = np.clip(read_pixels(window, SIZE, SIZE), 0, 1)
        Image.fromarray((255 * pixels).astype(np.uint8)).save(f"{folder}/{i}.png")


@main.command()
@click.argument("paths", nargs=3)
@click.option("-o", "--output", required=True)
@click.option("--rounds", type=int, default=7)
@click.option("--threads", type=int, default=2)
@click.option("--other")
@click.option("--lit", is_flag=True)
@click.option("--only", multiple=True)
def measure(
    paths: tuple[str, ...], output: str, rounds: int, threads: int, other: str | None, lit: bool, only: tuple[str, ...]
) -> None:
    """Add rows, a scene and a round at a time."""

    rows, paths = read_rows(output), tuple(str(Path(path).resolve()) for path in paths)
    for turn in range(rounds):
        for name, call in calls(paths, only or tuple(STEP)).items():
            with tempfile.TemporaryDirectory() as folder:
                found = commands(paths, name, call, folder, threads, other, lit)
                first = turn % len(found)  # memory that was just freed is quicker to get: each comes first in turn
                for what, checkout, command in found[first:] + found[:first]:
                    seconds = timed(command, checkout, threads)
                    row: dict[str, Any] = {"scene": name, "what": what, "threads": threads, "round": turn}
                    rows.append(row | seconds)
            write_rows(output, rows)


def commands(
    paths: tuple[str, ...], name: str, call: list[str], folder: str, threads: int, other: str | None, lit: bool
) -> list[tuple[str, str, list[str]]]:
    """What is run of a scene, from which checkout, and the arguments for Python."""
    here = str(Path.cwd())
    vvgt = ["-m", "vvgt_cli.commands.main"]
    end = ["--threads", str(threads), "-q"]
    convert = [*vvgt, "convert", *call, *end, "-o"]
    many = ["--views", str(VIEWS), "--test-views", "0", "--size", str(SIZE), "--format", "png", "--no-points"]
    views = [*vvgt, "render-views", *call, *many, *end, "-o"]
    coarse = ["--samples", "1", "--step", str(STEP[name])]
    found = [("convert", here, [*convert, f"{folder}/a.ply"])]
    if other:
        found.append(("convert, other", other, [*convert, f"{folder}/b.ply"]))
    if lit:
        found.append(("convert, lit", here, [*convert, f"{folder}/c.ply", "--light", "headlight"]))
    found += [("views", here, [*views, f"{folder}/v"]), ("views, VTK's error", here, [*views, f"{folder}/w", *coarse])]
    return [*found, ("vtk", here, [__file__, "vtk", *paths, name, folder, "--threads", str(threads)])]


@main.command()
@click.argument("path")
def table(path: str) -> None:
    """Medians of wall seconds, and in how many times VTK's."""
    taken: dict[tuple[str, str, str], list[float]] = {}
    for row in read_rows(path):
        taken.setdefault((row["scene"], row["threads"], row["what"]), []).append(float(row["wall"]))
    kinds = list(dict.fromkeys(what for _, _, what in taken))
    print(f"| scene | threads | {' | '.join(kinds)} |\n" + "| --- " * (2 + len(kinds)) + "|")
    for scene, threads in dict.fromkeys((scene, threads) for scene, threads, _ in taken):
        medians = {what: statistics.median(taken.get((scene, threads, what), [math.nan])) for what in kinds}
        shown = " | ".join(f"{value:.1f}, {value / medians['vtk']:.2f}" for value in medians.values())
        print(f"| {scene} | {threads} | {shown} |")


if __name__ == "__main__":
    main()
