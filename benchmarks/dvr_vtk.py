"""Our ray caster against VTK's CPU mapper, alternating in one run: a CSV row each, and a table of it.

    PYTHONPATH=. python benchmarks/dvr_vtk.py SCENES.tsv DATA_DIR TF_DIR -o docs/dvr-vtk.csv
    PYTHONPATH=. python benchmarks/dvr_vtk.py --table docs/dvr-vtk.csv

vtkFixedPointVolumeRayCastMapper with linear interpolation, as displayed; the same number of threads, one ray a pixel
on both sides. Volumes are padded by a transparent voxel, so that VTK's box (between the outer centres) and ours show
the same. Rows of a scene and size: the same mean distance between samples (1/2 voxel, 1 voxel), and VTK at 1/2 voxel
against the longest of our steps (1/2, 1, 1.25, 1.5, 2, 3 voxels) that has no more error. Times are medians over the
views, VTK's of a whole `Render`; `ratio` is the median over alternated pairs, `cpu_ratio` the same of processor time.
Errors are of RGB in 8 bits against our kernel at 1/16 voxel. `needed` counts the samples in visible matter before a
ray is opaque (a picture of 50 px scaled, by the float64 twin), `floor_ms` their arithmetic.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import click
import numpy as np
from dvr_scenes import commit, print_table, read_scenes, write_rows
from floors import flops

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.dvr.reference import optics, rays, trilinear
from vvgt_cli.dvr.vtk import aim, image_data, read_pixels, require_opengl, volume_property

NAMES = (
    "bonsai-tree", "embryo-shells", "embryo-opaque", "ironprot-density", "neghip-fog", "headsq-bone-skin",
    "headsq-step", "spm152-tissue",
)  # fmt: skip
VIEWS, REPEATS, SAMPLE_FLOPS = (0, 3), 5, 50
SPARSE = 50  # pixels along the edge of the views whose samples are counted
OURS, THEIRS = (0.5, 1.0, 1.25, 1.5, 2.0, 3.0), (0.5, 1.0)  # voxels between samples


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
    origin, directions = rays(camera.resized(SPARSE / camera.width), 1)
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
    return used * (camera.width / SPARSE) ** 2


def psnr8(image: np.ndarray, fine: np.ndarray) -> float:
    """PSNR of RGB in dB, both in 8 bits."""
    a, b = (np.round(255 * np.clip(i[..., :3], 0, 1)) / 255 for i in (image, fine))
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def clocks(call: Callable[[], object]) -> tuple[float, float]:
    """Seconds of wall and of processor time, of all threads."""
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - wall, time.process_time() - cpu


class Alternation:
    """Times (wall, processor) and decibels of both sides at all their steps, view by view."""

    def __init__(self, scene: Scene, size: int, threads: int) -> None:
        self.scene, self.size = scene, size
        self.window, self.renderer, self.mapper = vtk_window(scene, threads)
        self.window.SetSize(size, size)
        self.cameras = [default_views("test", size=size)[i] for i in VIEWS]
        self.times: dict[tuple[str, float], list[tuple[float, float]]] = {}
        self.errors: dict[tuple[str, float], list[float]] = {}
        for camera in self.cameras:
            fine = render_view(scene, camera, RenderSettings(step=1 / 16, samples=1))
            aim(self.renderer, camera)
            for repeat in range(-1, REPEATS):  # the first only prepares
                self._round(camera, repeat >= 0, fine)

    def _round(self, camera: Camera, kept: bool, fine: np.ndarray) -> None:
        for step in OURS:
            if step in THEIRS:
                self.mapper.SetSampleDistance(distance(self.scene, camera, step))
                self.mapper.Modified()
                self._note(("vtk", step), clocks(self.window.Render), kept)
                if not kept:
                    image = read_pixels(self.window, self.size, self.size)
                    self.errors.setdefault(("vtk", step), []).append(psnr8(image, fine))
            settings = RenderSettings(step=step, samples=1)
            self._note(("ours", step), clocks(lambda s=settings: render_view(self.scene, camera, s)), kept)
            if not kept:
                self.errors.setdefault(("ours", step), []).append(
                    psnr8(render_view(self.scene, camera, settings), fine)
                )

    def _note(self, key: tuple[str, float], value: tuple[float, float], kept: bool) -> None:
        if kept:
            self.times.setdefault(key, []).append(value)

    def row(self, theirs: float, ours: float, rate: float) -> dict[str, Any]:
        """VTK at one step against us at another."""
        a, b = np.array(self.times["ours", ours]), np.array(self.times["vtk", theirs])  # (n, 2)
        ratio, cpu_ratio = np.median(b / a, axis=0)
        needed = float(np.mean([samples_needed(self.scene, camera, ours) for camera in self.cameras]))
        return {
            "size": self.size,
            "vtk_step": theirs,
            "our_step": ours,
            "ours_ms": 1e3 * float(np.median(a[:, 0])),
            "vtk_ms": 1e3 * float(np.median(b[:, 0])),
            "ratio": float(ratio),
            "cpu_ratio": float(cpu_ratio),
            "ours_db": float(np.mean(self.errors["ours", ours])),
            "vtk_db": float(np.mean(self.errors["vtk", theirs])),
            "needed": f"{needed:.3g}",
            "floor_ms": 1e3 * needed * SAMPLE_FLOPS / rate,
        }

    def longest(self, theirs: float) -> float:
        """The longest of our steps with no more error than VTK's at ``theirs``; the shortest where all have more."""
        allowed = [s for s in OURS if np.mean(self.errors["ours", s]) >= np.mean(self.errors["vtk", theirs])]
        return max(allowed, default=OURS[0])


def measure(scene: Scene, size: int, threads: int, rate: float) -> list[dict[str, Any]]:
    """Rows of one size."""
    timed = Alternation(scene, size, threads)
    pairs = [(0.5, 0.5), (1.0, 1.0), (0.5, timed.longest(0.5))]
    return [timed.row(theirs, ours, rate) for theirs, ours in dict.fromkeys(pairs)]


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
