"""Optics grids beside the scalars they are made of, in time and memory: a CSV row each.

    PYTHONPATH=. NUMBA_NUM_THREADS=1 python benchmarks/grids.py SCENES.tsv DATA_DIR TF_DIR -o grids.csv
    PYTHONPATH=. python benchmarks/grids.py --table grids.csv

The grid is the scene's own voxels, classified. Seconds are those of the processor, user and system, on one thread
(medians of alternated repeats): to lay the scene out, for a view of 400 px as it is fitted to (one ray a pixel, steps
of half a voxel), and for the closed form of 100,000 Gaussians for 1080 px. `mb` is what the scene holds in memory.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import click
from dvr_scenes import commit, print_table, read_scenes, write_rows

from vvgt_cli.cameras import default_views
from vvgt_cli.closed_form import VbmOptions, initialise
from vvgt_cli.dvr import Scene, render_view
from vvgt_cli.dvr.layers import Layer, grid_of
from vvgt_cli.dvr.render import FIT_VIEWS
from vvgt_cli.field.source import StyledVolume

K, SIZE, VIEW = 100_000, 1080, 400


def as_grid(source: StyledVolume) -> Scene:
    """The optics grid of a scalar scene's voxels."""
    layer = Layer(source.volume, source.tf, source.unit_distance)
    grid = grid_of([layer], source.volume)
    return Scene.of_grid(source.volume, source.tf, source.unit_distance, grid)


def held(scene: Scene) -> int:
    """Bytes of a scene's arrays."""
    arrays = [scene.values, scene.empty, scene.optics.nodes, scene.optics.cumulative]
    return sum(array.nbytes for array in [*arrays, *([] if scene.grid is None else [scene.grid])])


def used(call: Callable[[], object]) -> float:
    """Processor seconds of a call."""
    start = time.process_time()
    call()
    return time.process_time() - start


def measure(source: StyledVolume, repeats: int) -> list[dict[str, Any]]:
    """Rows of one scene: as scalars, and as a grid."""
    camera = default_views("test", size=VIEW)[0]
    options = VbmOptions(max_gaussians=K, size=SIZE)
    makers: dict[str, Callable[[], Scene]] = {"scalars": source.scene, "grid": lambda: as_grid(source)}
    scenes = {kind: make() for kind, make in makers.items()}
    calls: dict[tuple[str, str], Callable[[], object]] = {}
    for kind, scene in scenes.items():
        calls[kind, "scene_s"] = makers[kind]
        calls[kind, "view_s"] = lambda scene=scene: render_view(scene, camera, FIT_VIEWS)  # type: ignore[misc]
        calls[kind, "closed_form_s"] = lambda scene=scene: initialise(scene, options)  # type: ignore[misc]
    for call in calls.values():
        call()  # compiles
    times: dict[tuple[str, str], list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            times[name].append(used(call))
    columns = ("scene_s", "view_s", "closed_form_s")
    return [
        {"kind": kind, **{c: statistics.median(times[kind, c]) for c in columns}, "mb": held(scene) / 1e6}
        for kind, scene in scenes.items()
    ]


@click.command(help=__doc__)
@click.argument("paths", nargs=-1, type=click.Path(exists=True))
@click.option("-o", "--output", type=click.Path())
@click.option("--repeats", default=3)
@click.option("--table", type=click.Path(exists=True))
def main(paths: tuple[str, ...], output: str | None, repeats: int, table: str | None) -> None:
    if table:
        print_table(table)
        return
    rows: list[dict[str, Any]] = []
    for name, source in read_scenes(*paths):
        rows += [{"scene": name, **row, "commit": commit()} for row in measure(source, repeats)]
        print(rows[-2], rows[-1], sep="\n", flush=True)
        write_rows(output, rows)


if __name__ == "__main__":
    main()
