"""Time of projecting, blending and back-projecting Gaussians: `python benchmarks/splat.py [VOLUME ...]`.

The Gaussians stand at voxels drawn by their opacity, a voxel and a half wide. Prints milliseconds (medians of
alternated repeats) at 400 and 1600 pixels, and two floors: the bytes of all pairs read once, and the arithmetic of the
tile rows that the Gaussians' pixel boxes cover (no floor where the scene is opaque: its pixels end early).
"""

from __future__ import annotations

import sys
from functools import partial

import numpy as np
from floors import alternate, bandwidth, flops, machine

from vvgt_cli.cameras import default_views
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.constants import TILE
from vvgt_cli.look import from_histogram
from vvgt_cli.splat import Projection, blend, gather, project
from vvgt_cli.volume import Volume, read_volume, statistics

COUNT, REPEATS, SIZES = 100_000, 9, (400, 1600)
PIXEL_FLOPS = 30  # exponent 4, exponential 12, alpha and transmittance 6, four channels 8
PAIR_BYTES = 4 + 16 + 24 + 12  # entry, extent, flat, colour


def sampled(volume: Volume, count: int) -> Gaussians:
    """``count`` Gaussians at voxels drawn with probability proportional to opacity."""
    tf = from_histogram(statistics(volume))
    values = volume.slope * volume.data.reshape(-1).astype(np.float64) + volume.intercept
    opacity = np.nan_to_num(tf.opacity(values))
    rng = np.random.default_rng(0)
    index = rng.choice(opacity.size, count, p=opacity / opacity.sum())
    k, j, i = np.unravel_index(index, volume.data.shape)
    frame = volume.unit_frame()
    means = (np.column_stack([i, j, k]) + 0.5) * np.array(frame.step) - np.array(frame.half)
    scales = np.log(1.5 * np.array(frame.step)) + rng.normal(0, 0.3, (count, 3))
    alpha = np.clip(opacity[index], 0.02, 0.98)
    return Gaussians(means, scales, rng.normal(size=(count, 4)), np.log(alpha / (1 - alpha)), tf.color(values[index]))


def covered_pixels(projection: Projection) -> int:
    """Pixels of all (tile, Gaussian) rows in the Gaussians' boxes: what the kernels touch if no pixel ends early."""
    x0, y0, x1, y1 = projection.extent.astype(np.int64).T
    seen = x1 > x0
    columns = (x1 - 1) // TILE - x0 // TILE + 1
    return int((columns * TILE * (y1 - y0))[seen].sum())


def main(names: list[str]) -> None:
    print(machine())
    bytes_per_second, rate = bandwidth(), flops(np.float32)
    print(f"{bytes_per_second / 1e9:.1f} GB/s in one thread, {rate / 1e9:.0f} Gflop/s float32\n")
    for name in names:
        gaussians = sampled(read_volume(name), COUNT)
        for size in SIZES:
            camera = default_views("test", size=size)[0]
            projection = project(gaussians, camera)
            fields = np.random.default_rng(0).normal(size=(4, size, size)).astype(np.float32)
            sums = np.zeros((COUNT, 5))
            calls = {
                "project": partial(project, gaussians, camera),
                "blend": partial(blend, projection, gaussians.colors, size, size),
                "gather": partial(gather, projection, fields, sums),
            }
            pairs, pixels = len(projection.members), covered_pixels(projection)
            print(f"{name}: {COUNT} Gaussians, {size} px, {pairs} pairs, {pixels / 1e6:.0f} million pixels")
            for label, value in alternate(calls, REPEATS).items():
                floor = f"{pairs * PAIR_BYTES / bytes_per_second * 1e3:.2f} ms (bytes)"
                if label != "project":
                    floor += f", {pixels * PIXEL_FLOPS / rate * 1e3:.2f} ms (flops, no early end)"
                print(f"  {label:<8} {value * 1e3:8.2f} ms   floors: {floor}")


if __name__ == "__main__":
    main(sys.argv[1:] or ["example:frog", "example:channels"])
