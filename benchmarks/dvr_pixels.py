"""Adaptive grids of rays against 8 x 8 rays in every pixel: a CSV row a scene, and docs/dvr.md's table.

    PYTHONPATH=. python benchmarks/dvr_pixels.py SCENES.tsv DATA_DIR TF_DIR -o docs/dvr-pixels.csv
    PYTHONPATH=. python benchmarks/dvr_pixels.py --table docs/dvr-pixels.csv

400 px, two test views, half-voxel steps on both sides. Errors are of RGB in dB: of one ray a pixel, of 3 x 3 rays where
neighbours differ (the default), of 3 x 3 everywhere. `refined` is the share of pixels that got a grid; `missed` the
share of the others whose error is above 0.02: features that fall between the first pass's rays. `seconds_24` is the
time of the 24 training views with the settings that scores use (2 x 2 where neighbours differ, steps of a voxel).
"""

from __future__ import annotations

from typing import Any

import click
import numpy as np
from dvr_scenes import commit, print_table, read_scenes, write_rows
from floors import machine, seconds

from vvgt_cli.cameras import default_views
from vvgt_cli.dvr import RenderSettings, Scene, render_view, render_views
from vvgt_cli.dvr.render import SCORE_VIEWS, edges

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
        every = render_view(scene, camera, RenderSettings(adaptive=False))
        refined = edges(one)
        missed = (np.abs(adaptive - exact).max(axis=-1) > 0.02) & ~refined
        rows.append(
            {
                "one_ray_db": decibels(one - exact),
                "adaptive_db": decibels(adaptive - exact),
                "every_3x3_db": decibels(every - exact),
                "refined": float(refined.mean()),
                "missed": float(missed.sum() / max((~refined).sum(), 1)),
            }
        )
    row: dict[str, Any] = {key: float(np.mean([r[key] for r in rows])) for key in rows[0]}
    row["seconds_24"] = seconds(lambda: render_views(scene, default_views("train"), SCORE_VIEWS))
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
