"""Our ray caster against VTK's CPU mapper, alternating in one run: a CSV row each, and docs/dvr.md's table.

    PYTHONPATH=. python benchmarks/dvr_vtk.py SCENES.tsv DATA_DIR TF_DIR -o docs/dvr-vtk.csv
    PYTHONPATH=. python benchmarks/dvr_vtk.py --table docs/dvr-vtk.csv

vtkFixedPointVolumeRayCastMapper with linear interpolation, as displayed; the same number of threads, one ray a pixel
on both sides, the same mean distance between samples. Volumes are padded by a transparent voxel, so that VTK's box
(between the outer centres) and ours show the same. Times are medians over the views, VTK's of a whole `Render`; `ratio`
is the median over alternated pairs. Errors are of RGB in 8 bits against our kernel at 1/16 voxel. `needed` counts the
samples in visible matter before a ray is opaque (every eighth pixel, by the float64 twin), `floor_ms` their arithmetic.
"""

from __future__ import annotations

import platform
import statistics
from dataclasses import replace
from typing import Any

import click
import numpy as np
from dvr_scenes import commit, print_table, read_scenes, write_rows
from floors import flops, seconds

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.dvr.reference import optics, rays, trilinear
from vvgt_cli.dvr.vtk import aim, image_data, read_pixels, require_opengl, volume_property

NAMES = ("bonsai-tree", "embryo-shells", "headsq-bone-skin", "spm152-tissue")
VIEWS, REPEATS, SAMPLE_FLOPS = (0, 3, 6), 5, 50


def distance(scene: Scene, camera: Camera, step: float) -> float:
    """Mean distance (unit frame) between samples that are ``step`` voxels apart along the ray, over the pixels."""
    directions = rays(camera.resized(0.1), 1)[1].reshape(-1, 3)
    return step / float(np.linalg.norm(directions / scene.step, axis=1).mean())


def vtk_window(scene: Scene, threads: int) -> tuple[Any, Any, Any]:
    """Window, renderer and CPU mapper showing the scene."""
    import vtkmodules.vtkRenderingOpenGL2
    import vtkmodules.vtkRenderingVolumeOpenGL2  # noqa: F401
    from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow, vtkVolume
    from vtkmodules.vtkRenderingVolume import vtkFixedPointVolumeRayCastMapper

    mapper = vtkFixedPointVolumeRayCastMapper()
    mapper.SetInputData(image_data(scene, padded=False))
    mapper.SetAutoAdjustSampleDistances(False)
    mapper.SetLockSampleDistanceToInputSpacing(False)
    mapper.SetImageSampleDistance(1)
    mapper.SetNumberOfThreads(threads)
    volume, renderer, window = vtkVolume(), vtkRenderer(), vtkRenderWindow()
    volume.SetMapper(mapper)
    volume.SetProperty(volume_property(scene))
    renderer.SetBackground(0, 0, 0)
    renderer.SetBackgroundAlpha(0)
    renderer.AddVolume(volume)
    window.SetOffScreenRendering(True)
    window.SetAlphaBitPlanes(True)
    window.SetMultiSamples(0)
    window.AddRenderer(renderer)
    return window, renderer, mapper


def samples_needed(scene: Scene, camera: Camera, step: float) -> float:
    """Samples of a view that lie in visible matter and before transmittance 1e-3."""
    origin, directions = rays(camera.resized(0.125), 1)
    d = directions.reshape(-1, 3)
    ds = distance(scene, camera, step)
    near = max(np.linalg.norm(origin) - np.linalg.norm(scene.half), 0.0)
    depth, used = np.zeros(len(d)), 0
    for t in np.arange(near, np.linalg.norm(origin) + np.linalg.norm(scene.half), ds):
        points = origin + t * d
        inside = (np.abs(points) < scene.half).all(axis=1) & (depth < 6.9)
        tau = optics(scene, trilinear(scene.volume, (points[inside] + scene.half) / scene.step - 0.5))[0]
        used += int((tau > 0).sum())
        depth[inside] += tau * ds
    return used * 64.0


def psnr8(image: np.ndarray, fine: np.ndarray) -> float:
    """PSNR of RGB in dB, both in 8 bits."""
    a, b = (np.round(255 * np.clip(i[..., :3], 0, 1)) / 255 for i in (image, fine))
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def measure(scene: Scene, size: int, threads: int, rate: float) -> list[dict[str, Any]]:
    """One row a step."""
    window, renderer, mapper = vtk_window(scene, threads)
    window.SetSize(size, size)
    rows = []
    for step in (0.5, 1.0):
        ours_s, vtk_s, ours_db, vtk_db, needed = [], [], [], [], []
        for camera in (default_views("test", size=size)[i] for i in VIEWS):
            settings = RenderSettings(step=step, samples=1)
            fine = render_view(scene, camera, RenderSettings(step=1 / 16, samples=1))
            aim(renderer, camera)
            mapper.SetSampleDistance(distance(scene, camera, step))
            for repeat in range(-1, REPEATS):  # the first only prepares
                mapper.Modified()
                a, b = seconds(window.Render), seconds(lambda c=camera, s=settings: render_view(scene, c, s))
                if repeat >= 0:
                    vtk_s.append(a)
                    ours_s.append(b)
            ours_db.append(psnr8(render_view(scene, camera, settings), fine))
            vtk_db.append(psnr8(read_pixels(window, size, size), fine))
            needed.append(samples_needed(scene, camera, step))
        row: dict[str, Any] = {"size": size, "step": step}
        row |= {"ours_ms": 1e3 * statistics.median(ours_s), "vtk_ms": 1e3 * statistics.median(vtk_s)}
        row["ratio"] = statistics.median(b / a for a, b in zip(ours_s, vtk_s, strict=True))
        row |= {
            "ours_db": float(np.mean(ours_db)),
            "vtk_db": float(np.mean(vtk_db)),
            "needed": f"{np.mean(needed):.3g}",
        }
        row["floor_ms"] = 1e3 * float(np.mean(needed)) * SAMPLE_FLOPS / rate
        rows.append(row)
    return rows


@click.command(help=__doc__)
@click.argument("paths", nargs=-1, type=click.Path(exists=True))
@click.option("-o", "--output", type=click.Path())
@click.option("--sizes", default="400,800")
@click.option("--table", type=click.Path(exists=True))
def main(paths: tuple[str, ...], output: str | None, sizes: str, table: str | None) -> None:
    if table:
        print_table(table)
        return
    import numba

    require_opengl()
    rows, threads, rate = [], numba.get_num_threads(), flops(np.float32)
    for name, source in read_scenes(*paths, names=NAMES):
        clear = source.volume.data.min()
        padded = replace(source.volume, data=np.pad(source.volume.data, 1, constant_values=clear))
        scene = replace(source, volume=padded).scene()
        for size in map(int, sizes.split(",")):
            for row in measure(scene, size, threads, rate):
                rows.append(
                    {"scene": name, **row, "threads": threads, "commit": commit(), "machine": platform.machine()}
                )
                print(rows[-1], flush=True)
    write_rows(output, rows)


if __name__ == "__main__":
    main()
