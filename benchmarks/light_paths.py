"""A volume lit on a grid against paths traced from the eye: a CSV row a scene and sky.

    PYTHONPATH=. python benchmarks/light_paths.py SCENES.tsv DATA_DIR TF_DIR --size 64 --paths 4096 -o light-paths.csv

`grid_db`: dB over RGB of the ray-cast view (test view 3, 3 x 3 rays a pixel) against the picture of paths; `noise_db`:
of the latter, from its halves; `light_seconds`: processor time of the grid. Repeat `--paths` for a curve over the
paths from the eye, and `--effort` for one over those that make the grid, whose number it multiplies.
With `--gaussians K`, `ply_db` of a conversion for a screen of this size, and `ply_grid_db` beside the view, too; all
are then without the noise of the paths: the mean of the product of the differences from the two halves.
With `--pictures DIR` no rows, but a JPEG a scene: unlit, under a headlight, and under the first sky.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import click
import numpy as np
from dvr_scenes import commit, read_scenes, write_rows
from floors import machine

import vvgt_cli as vvgt
from tests.paths_twin import path_view
from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.dvr import RenderSettings, Scene, render_view, traced
from vvgt_cli.dvr.sky import sky_of
from vvgt_cli.field.source import StyledVolume
from vvgt_cli.library.inputs import Look
from vvgt_cli.look.lighting import SKIES, LightOptions
from vvgt_cli.splat.render import render

EFFORT = {
    "POINTS": lambda effort: traced.POINTS * effort,
    "MOST_PATHS": lambda effort: round(traced.MOST_PATHS * effort),
}


def decibels(error: np.ndarray, other: np.ndarray | None = None) -> float:
    """PSNR of an error, or of what two have in common."""
    other = error if other is None else other
    return float(-10 * np.log10(np.mean(error[..., :3].astype(float) * other[..., :3])))


def converted(source: StyledVolume, light: str, size: int, gaussians: int, camera: Camera) -> np.ndarray:
    """A conversion's picture; its seconds are those of the whole, with scores."""
    look = Look(source.tf, opacity_unit_distance=source.unit_distance, light=light)
    result = vvgt.convert(source.volume, look, max_gaussians=gaussians, screen=size, progress=True)
    return render(result.gaussians, camera)


def measure(
    source: StyledVolume,
    name: str,
    size: int,
    counts: tuple[int, ...],
    efforts: tuple[float, ...],
    gaussians: int | None,
) -> Iterator[dict[str, Any]]:
    """A row for each effort and number of paths a pixel."""
    scene = source.scene()
    lighting = LightOptions((name,)).lighting(None, scene.volume.space)
    assert lighting is not None
    camera = default_views("test", size=size)[3]
    sky = sky_of(name, np.array(lighting.directions[0]), scene.volume.axes)
    pairs = [
        [path_view(scene.scattering(), sky, scene.half, camera, n // 2, seed) for seed in (1, 1 << 20)] for n in counts
    ]
    for effort in efforts:
        began = time.process_time()
        with mock.patch.multiple(traced, **{key: value(effort) for key, value in EFFORT.items()}):
            lit = scene.lit(lighting)
        spent = time.process_time() - began
        image = render_view(lit, camera, RenderSettings(samples=3))
        shown = {"grid_db": image}
        if gaussians:
            shown["ply_db"] = converted(source, name, size, gaussians, camera)
        for paths, halves in zip(counts, pairs, strict=True):
            traced_view, noise = (halves[0] + halves[1]) / 2, decibels((halves[0] - halves[1]) / 2)
            row: dict[str, Any] = {"effort": effort, "paths": paths}
            for key, one in shown.items():
                first, second = (one - half for half in halves) if gaussians else (one - traced_view,) * 2
                row[key] = decibels(first, second)
            if gaussians:
                row["ply_grid_db"] = decibels(shown["ply_db"] - image)
            yield row | {"noise_db": noise, "light_seconds": spent}


def picture(scene: Scene, sky: str, size: int, target: Path) -> None:
    """Draw test view 4 unlit, under a headlight, and under a sky whose viewer is the camera, side by side."""
    from PIL import Image

    camera = default_views("test", size=size)[4]
    toward = scene.volume.axes @ camera.position
    lights = [
        LightOptions(names).lighting(None, None) for names in (("headlight",), (sky, f"{toward[0]},{toward[1]},0"))
    ]
    lit = [scene, *(scene.lit(light) for light in lights if light)]
    sheet = np.hstack([render_view(one, camera, RenderSettings(samples=3))[..., :3] for one in lit])
    Image.fromarray(np.rint(255 * sheet.clip(0, 1)).astype(np.uint8)).save(target, quality=88)


@click.command(help=__doc__)
@click.argument("places", nargs=3, type=click.Path(exists=True))
@click.option("--scene", "scenes", multiple=True)
@click.option("--size", type=int, default=64)
@click.option("--sky", "skies", multiple=True, default=SKIES)
@click.option("--paths", type=int, multiple=True, default=(512,))
@click.option("--effort", "efforts", type=float, multiple=True, default=(1.0,))
@click.option("--gaussians", type=int)
@click.option("-o", "--output", type=click.Path())
@click.option("--pictures", type=click.Path(file_okay=False))
def main(
    places: tuple[str, str, str], scenes: tuple[str, ...], size: int, skies: tuple[str, ...], paths: tuple[int, ...],
    efforts: tuple[float, ...], gaussians: int | None, output: str | None, pictures: str | None,
) -> None:  # fmt: skip
    rows: list[dict[str, Any]] = []
    for name, source in read_scenes(*places, scenes or None):
        if pictures:
            picture(source.scene(), skies[0], size, Path(pictures) / f"{name}-{skies[0]}.jpg")
            continue
        for sky in skies:
            for row in measure(source, sky, size, paths, efforts, gaussians):
                rows.append({"scene": name, "sky": sky, **row, "size": size, "commit": commit()})
                rows[-1]["machine"] = machine().split(", load")[0]
                print(rows[-1], flush=True)
    if rows:
        write_rows(output, rows)


if __name__ == "__main__":
    main()
