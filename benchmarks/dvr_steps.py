"""Error against time of pre-integrated and of plain stepping: a CSV row each, and a table of it.

    PYTHONPATH=. python benchmarks/dvr_steps.py SCENES.tsv DATA_DIR TF_DIR -o docs/dvr-steps.csv
    PYTHONPATH=. python benchmarks/dvr_steps.py --table docs/dvr-steps.csv

`plain` classifies each sample at the middle of its step (post-classification), by the same interpolation, tables, empty
bricks and end of rays as the kernel. One ray a pixel, 200 px, one view; errors are of premultiplied RGBA in dB against
the kernel at 1/256 voxel; times are medians of alternated repeats. `thin-shell` is made here.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import click
import numba as nb
import numpy as np
from dvr_scenes import commit, print_table, read_scenes, write_rows
from floors import alternate, machine

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.dvr.kernel import FLAGS, OPAQUE, absorbed, box_span, inverse, leap, mean_optics, sample, table_coordinate
from vvgt_cli.dvr.layout import BRICK_BITS
from vvgt_cli.dvr.reference import rays
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.volume import read_volume

NAMES = ("ironprot-density", "bonsai-tree", "embryo-opaque", "headsq-step")
STEPS = {"pre-integrated": (1, 1 / 2, 1 / 4, 1 / 8), "plain": (1, 1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32, 1 / 64)}


@nb.njit(parallel=True, fastmath=FLAGS, error_model="numpy")
def _plain(voxels, optics, empty, eye, directions, step, out):
    values = voxels.values
    nz, ny, nx = values.shape
    px, py, pz = eye
    for ray in nb.prange(len(directions)):
        dx, dy, dz = directions[ray]
        t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
        if not t1 > t0:
            continue
        count = max(math.ceil((t1 - t0) * math.sqrt(dx * dx + dy * dy + dz * dz) / step), 1)
        dt = (t1 - t0) / count
        red = green = blue = 0.0
        trans = 1.0
        i = 0
        while i < count and trans >= OPAQUE * min(step * step, 1.0):
            t = t0 + (i + 0.5) * dt
            x, y, z = px + t * dx, py + t * dy, pz + t * dz
            bi = min(max(int(x), 0), nx - 1) >> BRICK_BITS
            bj = min(max(int(y), 0), ny - 1) >> BRICK_BITS
            bk = min(max(int(z), 0), nz - 1) >> BRICK_BITS
            reach = int(empty[bk, bj, bi])
            i += 1
            if reach > 0:
                end = leap(px, py, pz, inverse(dx), inverse(dy), inverse(dz), reach, bi, bj, bk)
                i = max(math.ceil((end - t0) / dt - 0.5), i)
                continue
            u = table_coordinate(sample(values, x, y, z), optics)
            if u >= 0.0:
                r, g, b, tau = mean_optics(u, u, optics)
                f = absorbed(tau * dt) * trans * dt
                red, green, blue, trans = red + f * r, green + f * g, blue + f * b, trans - f * tau
        out[ray, 0], out[ray, 1], out[ray, 2], out[ray, 3] = red, green, blue, 1.0 - trans


def plain_view(scene: Scene, camera: Camera, step: float) -> np.ndarray:
    """(height, width, 4) float64 by post-classification."""
    eye, directions = rays(camera, 1)
    out = np.zeros((camera.height * camera.width, 4))
    start = tuple((eye + scene.half) / scene.step - 0.5)
    across = directions.reshape(-1, 3) / scene.step
    _plain(scene.voxels, scene.optics, scene.empty, start, across, step, out)
    return out.reshape(camera.height, camera.width, 4)


def measure(scene: Scene, repeats: int) -> list[dict[str, Any]]:
    """Rows of one scene."""
    camera = default_views("test", size=200)[0]
    exact = render_view(scene, camera, RenderSettings(step=1 / 256, samples=1))
    calls = {}
    for step in STEPS["pre-integrated"]:
        calls["pre-integrated", step] = partial(render_view, scene, camera, RenderSettings(step=step, samples=1))
    for step in STEPS["plain"]:
        calls["plain", step] = partial(plain_view, scene, camera, step)
    times = alternate(calls, repeats)  # type: ignore[arg-type, type-var]
    rows = []
    for (method, step), call in calls.items():
        error = float(-10 * np.log10(np.mean((np.asarray(call(), float) - exact) ** 2)))
        rows.append({"method": method, "step": f"1/{round(1 / step)}", "db": error, "ms": 1e3 * times[method, step]})
    return rows


def thin_shell() -> Scene:
    """The Marschner-Lobb signal under opacity that is not zero on 2 % of the data's range alone."""
    volume = read_volume("example:marschner-lobb")
    lo, hi = float(volume.data.min()), float(volume.data.max())
    x = lo + (hi - lo) * np.array([0, 0.49, 0.5, 0.51, 1])
    opacity = PiecewiseOpacity(x, np.array([0, 0, 0.9, 0, 0]))
    function = TransferFunction("shell", opacity, ColorMap(x[[0, -1]], np.array([[0.2, 0.4, 1], [1, 0.6, 0.2]])))
    return Scene.build(volume, function, float(np.mean(volume.spacing)))


@click.command(help=__doc__)
@click.argument("paths", nargs=-1, type=click.Path(exists=True))
@click.option("-o", "--output", type=click.Path())
@click.option("--repeats", default=3)
@click.option("--table", type=click.Path(exists=True))
def main(paths: tuple[str, ...], output: str | None, repeats: int, table: str | None) -> None:
    if table:
        print_table(table)
        return
    rows = []
    scenes = [(name, source.scene()) for name, source in read_scenes(*paths, names=NAMES)] if paths else []
    for name, scene in [*scenes, ("thin-shell", thin_shell())]:
        for row in measure(scene, repeats):
            rows.append({"scene": name, **row, "commit": commit(), "machine": machine().split(", load")[0]})
            print(rows[-1], flush=True)
    write_rows(output, rows)


if __name__ == "__main__":
    main()
