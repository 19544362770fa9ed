"""Our shading against VTK's two volume mappers at equal steps: a CSV row each, and a table of it.

    PYTHONPATH=. python benchmarks/light_vtk.py SCENES.tsv DATA_DIR TF_DIR -o docs/light-vtk.csv
    PYTHONPATH=. python benchmarks/light_vtk.py --table docs/light-vtk.csv

Steps of a quarter voxel on both sides, one ray a pixel, RGB in 8 bits over black; `unlit` the same without light: what
the two differ by before any is shaded. The cameras are far away (a field of view of 4 degrees): VTK's CPU mapper takes
the camera's axis for the direction of all rays. Head-light: VTK's default coefficients. Fixed light: no highlights and
no ambient light, of which each mapper has its own (docs/light.md). For the GPU mapper the power of highlights is a
quarter of ours, and `gpu_mended_db` is with normals that it does not stretch (docs/light.md).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import click
import numpy as np
from dvr_scenes import commit, print_table, read_scenes, write_rows
from dvr_vtk import distance, psnr8, vtk_window

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.dvr.vtk import add_lights, aim, read_pixels, view_renderer, volume_property
from vvgt_cli.look.lighting import Lighting

NAMES = ("bonsai-tree", "embryo-shells", "headsq-bone-skin", "spm152-tissue")
STEP, FAR, VIEWS = 0.25, 10.0, (0, 3)
HEAD = Lighting()
FIXED = Lighting(headlight=False, directions=((0.6, -0.48, 0.64),), ambient=0, specular=0)


def far(camera: Camera) -> Camera:
    """The same picture of the centre from `FAR` times the distance."""
    return replace(camera, translation=FAR * camera.translation, fx=FAR * camera.fx, fy=FAR * camera.fy)


def by_cpu_mapper(scene: Scene, camera: Camera) -> np.ndarray:
    """vtkFixedPointVolumeRayCastMapper's picture."""
    window, renderer, mapper = vtk_window(scene, 1)
    renderer.GetVolumes().GetItemAsObject(0).SetProperty(volume_property(scene, 1.0))
    add_lights(renderer, scene)
    if scene.light is None or not len(scene.light.directions):
        renderer.CreateLight()
    renderer.GetLights().GetItemAsObject(0).SetAmbientColor(1, 1, 1)  # 0 by default, with which there is no ambient
    window.SetSize(camera.width, camera.height)
    aim(renderer, camera)
    mapper.SetSampleDistance(distance(scene, camera, STEP))
    window.Render()
    return read_pixels(window, camera.width, camera.height)


def row(name: str, scene: Scene, which: str, size: int) -> dict[str, Any]:
    """Decibels of one light by both mappers, means over the views."""
    settings, found = RenderSettings(step=STEP, samples=1), {}
    for mapper in ("gpu", "gpu_mended", "cpu"):
        values = []
        for n in VIEWS:
            camera = far(default_views("test", size=size)[n])
            same = replace(settings, step=distance(scene, camera, STEP) / float(scene.step.mean()))
            by_gpu = view_renderer(scene, same, mended=mapper == "gpu_mended") if mapper != "cpu" else None
            theirs = by_gpu(camera) if by_gpu else by_cpu_mapper(scene, camera)
            values.append(psnr8(theirs, render_view(scene, camera, settings)))
        found[f"{mapper}_db"] = float(np.mean(values))
    return {"scene": name, "light": which, **found}


@click.command()
@click.argument("paths", nargs=-1)
@click.option("-o", "--output")
@click.option("--table")
@click.option("--size", default=300)
def main(paths: tuple[str, ...], output: str | None, table: str | None, size: int) -> None:
    """Measure, or print a table of what was measured."""
    if table:
        print_table(table)
        return
    rows = []
    for name, source in read_scenes(*paths, NAMES):
        dark = source.scene()
        for which, lighting in (("unlit", None), ("headlight", HEAD), ("fixed", FIXED)):
            rows.append(row(name, dark if lighting is None else dark.lit(lighting), which, size) | {"commit": commit()})
            print(rows[-1], flush=True)
    write_rows(output, rows)


if __name__ == "__main__":
    main()
