"""A volume lit on a grid against paths traced from the eye: a CSV row a scene and sky.

    PYTHONPATH=. python benchmarks/light_paths.py SCENES.tsv DATA_DIR TF_DIR --size 64 --paths 512 -o light-paths.csv

`grid_db`: dB over RGB of the ray-cast view (test view 3, 3 x 3 rays a pixel) against the picture of paths; `noise_db`:
of the latter, from its halves; `light_seconds`: processor time of the grid.
"""

from __future__ import annotations

import time
from typing import Any

import click
import numpy as np
from dvr_scenes import commit, read_scenes, write_rows
from floors import machine

from tests.paths_twin import path_view
from vvgt_cli.cameras import default_views
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.dvr.sky import sky_of
from vvgt_cli.look.lighting import SKIES, LightOptions


def decibels(error: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean(error[..., :3].astype(float) ** 2)))


def measure(scene: Scene, name: str, size: int, paths: int) -> dict[str, Any]:
    """One row."""
    lighting = LightOptions((name,)).lighting(None, scene.volume.space)
    assert lighting is not None
    began = time.process_time()
    lit = scene.lit(lighting)
    spent, camera = time.process_time() - began, default_views("test", size=size)[3]
    image = render_view(lit, camera, RenderSettings(samples=3))
    sky = sky_of(name, np.array(lighting.directions[0]), scene.volume.axes)
    halves = [path_view(scene.scattering(), sky, scene.half, camera, paths // 2, seed) for seed in (1, 1 << 20)]
    traced = (halves[0] + halves[1]) / 2
    return {
        "grid_db": decibels(image - traced),
        "noise_db": decibels((halves[0] - halves[1]) / 2),
        "light_seconds": spent,
    }


@click.command(help=__doc__)
@click.argument("places", nargs=3, type=click.Path(exists=True))
@click.option("--scene", "scenes", multiple=True)
@click.option("--size", type=int, default=64)
@click.option("--paths", type=int, default=512)
@click.option("-o", "--output", type=click.Path())
def main(places: tuple[str, str, str], scenes: tuple[str, ...], size: int, paths: int, output: str | None) -> None:
    rows = []
    for name, source in read_scenes(*places, scenes or None):
        for sky in SKIES:
            row = {"scene": name, "sky": sky, **measure(source.scene(), sky, size, paths), "size": size, "paths": paths}
            rows.append({**row, "commit": commit(), "machine": machine().split(", load")[0]})
            print(rows[-1], flush=True)
    write_rows(output, rows)


if __name__ == "__main__":
    main()
