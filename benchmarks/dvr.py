"""Time of a view by ray casting: `python benchmarks/dvr.py [VOLUME ...]` (default: the examples below).

Prints milliseconds a view (medians of alternated repeats), nanoseconds a sample of the whole box, and two floors: the
volume's bytes read once, and the arithmetic of the samples that lie in bricks with extinction.
"""

from __future__ import annotations

import sys
from functools import partial

import numpy as np
from floors import alternate, bandwidth, flops, machine

from vvgt_cli.cameras import default_views
from vvgt_cli.dvr import REFERENCE, RenderSettings, Scene, render_view
from vvgt_cli.look import from_histogram
from vvgt_cli.volume import read_volume, statistics

SIZE, REPEATS = 400, 5
SAMPLE_FLOPS = 50  # position 6, trilinear 24, table coordinate 4, compositing the rest
SETTINGS = {
    "one ray, half a voxel": RenderSettings(samples=1),
    "one ray, a voxel": RenderSettings(step=1.0, samples=1),
    "adaptive": RenderSettings(),
    "reference": REFERENCE,
}


def samples_in_box(scene: Scene, step: float) -> float:
    """Samples of one view: mean chord of the box (4 V / S) times the rays that meet it, seen from the side."""
    extent = 2 * scene.half / scene.step  # voxels
    area = 2 * (extent[0] * extent[1] + extent[1] * extent[2] + extent[0] * extent[2])
    camera = default_views("test", size=SIZE)[0]
    covered = area / 4 * scene.step.mean() ** 2 * (camera.fx / 3) ** 2  # mean projected area, pixels
    return covered * 4 * extent.prod() / area / step


def main(names: list[str]) -> None:
    print(machine())
    bytes_per_second, rate = bandwidth(), flops(np.float64)
    print(f"{bytes_per_second / 1e9:.1f} GB/s in one thread, {rate / 1e9:.0f} Gflop/s float64\n")
    for name in names:
        volume = read_volume(name)
        scene = Scene.build(volume, from_histogram(statistics(volume)), float(np.mean(volume.spacing)))
        camera = default_views("test", size=SIZE)[0]
        calls = {label: partial(render_view, scene, camera, settings) for label, settings in SETTINGS.items()}
        times = alternate(calls, REPEATS)
        active = float((scene.empty == 0).mean())
        print(f"{name}: {' x '.join(map(str, volume.dims))} {volume.data.dtype}, {active:.0%} of the bricks visible")
        for label, value in times.items():
            samples = samples_in_box(scene, SETTINGS[label].step)  # of the first ray of every pixel
            floor_bytes = scene.values.nbytes / bytes_per_second
            floor_flops = active * samples * SAMPLE_FLOPS / rate
            print(
                f"  {label:<22} {value * 1e3:8.1f} ms  {value / samples * 1e9:6.1f} ns/sample   floors: "
                f"{floor_bytes * 1e3:.1f} ms (bytes), {floor_flops * 1e3:.1f} ms (flops, one ray a pixel)"
            )


if __name__ == "__main__":
    main(sys.argv[1:] or ["example:frog", "example:channels", "example:marschner-lobb"])
