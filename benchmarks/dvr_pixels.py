"""Adaptive grids of rays against 8 x 8 rays in every pixel: a CSV row a scene, and a table of it.

    PYTHONPATH=. python benchmarks/dvr_pixels.py SCENES.tsv DATA_DIR TF_DIR -o docs/dvr-pixels.csv
    PYTHONPATH=. python benchmarks/dvr_pixels.py --table docs/dvr-pixels.csv

400 px, two test views, half-voxel steps on both sides. Errors are of RGB in dB: of one ray a pixel, of the default (5
rays where neighbours differ by more than 0.08, 13 by more than 0.3), of what references use (3 x 3 above 0.02), of
3 x 3 everywhere. `rays` is the mean number of rays a pixel of the default; `missed` the share of its pixels with one
ray whose error is above 0.08: features that fall between the first pass's rays. `seconds_24` is the wall time of the 24
training views by default, `one_ray_24` with one ray a pixel.
"""

from __future__ import annotations

from typing import Any

import click
import numpy as np
from dvr_scenes import commit, print_table, read_scenes, write_rows
from floors import machine, seconds

from vvgt_cli.cameras import default_views
from vvgt_cli.dvr import REFERENCE, RenderSettings, Scene, render_view, render_views
from vvgt_cli.dvr.contrast import contrast
from vvgt_cli.dvr.render import ADAPTIVE

VIEWS = (0, 5)


def decibels(error: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean(error[..., :3].astype(float) ** 2)))


def measure(scene: Scene) -> dict[str, Any]:
    """One row: means over the views."""
    rows = []
    for camera in (default_views("test")[i] for i in VIEWS):
        exact = render_view(scene, camera, RenderSettings(samples=8))
        one = render_view(scene, camera, RenderSettings(samples=1))
        adaptive = render_view(scene, camera, RenderSettings())
        nine = render_view(scene, camera, RenderSettings(tiers=REFERENCE.tiers))
        every = render_view(scene, camera, RenderSettings(samples=3))
        differ = contrast(one)
        missed = (np.abs(adaptive - exact).max(axis=-1) > ADAPTIVE[0][0]) & (differ <= ADAPTIVE[0][0])
        (low, few), (high, many) = ADAPTIVE
        rows.append(
            {
                "one_ray_db": decibels(one - exact),
                "adaptive_db": decibels(adaptive - exact),
                "reference_db": decibels(nine - exact),
                "every_3x3_db": decibels(every - exact),
                "rays": float(np.select([differ > high, differ > low], [many, few], 1).mean()),
                "missed": float(missed.sum() / max((differ <= low).sum(), 1)),
            }
        )
    row: dict[str, Any] = {key: float(np.mean([r[key] for r in rows])) for key in rows[0]}
    cameras = default_views("train")
    row["seconds_24"] = seconds(lambda: render_views(scene, cameras))
    row["one_ray_24"] = seconds(lambda: render_views(scene, cameras, RenderSettings(samples=1)))
    return row


@click.command(help=__doc__)
@click.argument("paths", nargs=-1, type=click.Path(exists=True))
@click.option("-o", "--output", type=click.Path())
@click.option("--table", type=click.Path(exists=True))
def main(paths: tuple[str, ...], output: str | None, table: str | None) -> None:
    if table:
        print_table(table)
        return
    rows = []
    for name, source in read_scenes(*paths):
        stamp = {"commit": commit(), "machine": machine().split(", load")[0]}
        rows.append({"scene": name, **measure(source.scene()), **stamp})
        print(rows[-1], flush=True)
    write_rows(output, rows)


if __name__ == "__main__":
    main()
