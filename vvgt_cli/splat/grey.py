"""MIP and X-ray of Gaussians that carry values: sums and maxima in grey, which need no order (docs/live.md).

In a Gaussian, the value is linear along its gradient: at d pixels from the centre on the screen, the values along the
ray have mean ``m + a^T d`` and a deviation b, by the joint normal distribution of value and place. Its MIP is
``(m + a^T d + AHEAD b) fall(p)`` of the range of values, p = d^T S^-1 d / 2, with a fall from 1 at `PLATEAU` to 0 at
`END`: cells of the volume reach as far as that, and exp(-p) would darken their edges. Its X-ray is the optical depth
``mass exp(-p) / area``.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.constants import DILATION, TILE
from vvgt_cli.gaussians.frames import axes_of
from vvgt_cli.gaussians.live import LENGTH, SPREAD, TAU, VALUE, Table, apply_look, directions
from vvgt_cli.gaussians.rules import Rule
from vvgt_cli.jit.decorators import parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, next_iteration
from vvgt_cli.splat.render import Projection, project

REACH = 4.0  # largest p, as far as quads of the page
GREY = Rule("grey", "MIP and X-ray", dilation=DILATION / 4, reach=REACH)
PLATEAU, END = 0.5, 3.0  # p
AHEAD = 0.75  # deviations along the ray by which its greatest value exceeds the mean


def mip(gaussians: Gaussians, camera: Camera, lo: float, hi: float) -> np.ndarray:
    """Return the greatest value along each ray, (h, w) float32 from 0 for ``lo`` to 1 for ``hi``."""
    assert gaussians.live is not None
    live, width = gaussians.live.astype(np.float64), (hi - lo) or 1.0
    projection = _projected(gaussians, camera)
    along, explained = directions(gaussians)
    joint = np.einsum("kij,kj->ki", axes_of(gaussians), along)  # covariance of place and value, per deviation of value
    spread = live[:, SPREAD] / width * explained
    x, y, z = _in_camera(gaussians, camera)
    right, down, ahead = camera.rotation @ (joint * spread[:, None]).T
    on_screen = camera.fx * (right - ahead * x / z) / z, camera.fy * (down - ahead * y / z) / z
    a, b, c = projection.flat[:, 2:5].astype(np.float64).T
    slope = a * on_screen[0] + b * on_screen[1], b * on_screen[0] + c * on_screen[1]
    rest = np.maximum(spread**2 - slope[0] * on_screen[0] - slope[1] * on_screen[1], 0)
    fields = np.stack([(live[:, VALUE] - lo) / width + AHEAD * np.sqrt(rest), *slope], axis=1)
    return _accumulated(projection, fields, camera, True).clip(0, 1)


def xray(gaussians: Gaussians, table: Table, camera: Camera) -> np.ndarray:
    """Return what is absorbed along each ray, (h, w) float32 in [0, 1].

    ``table``: of the function, without a grain, so that extinction is the mean over the values.
    """
    assert gaussians.live is not None
    mass = table.of(gaussians.live)[:, TAU] * gaussians.live[:, LENGTH].astype(np.float64) ** 3
    moved = apply_look(gaussians, table)
    projection = _projected(moved, camera)
    place = _in_camera(moved, camera)
    a, b, c = projection.flat[:, 2:5].astype(np.float64).T
    per_area = np.sqrt(np.maximum(a * c - b * b, 0)) / (2 * math.pi) * camera.fx * camera.fy / place[2] ** 2
    oblique = np.linalg.norm(place, axis=0) / place[2]
    peak = mass * per_area * oblique / -math.expm1(-REACH)
    fields = np.stack([peak, np.zeros_like(peak), np.zeros_like(peak)], axis=1)
    return -np.expm1(-_accumulated(projection, fields, camera, False))


def _projected(gaussians: Gaussians, camera: Camera) -> Projection:
    """Project Gaussians of any opacity, out to `REACH`."""
    return project(replace(gaussians, opacity_logits=np.full(len(gaussians), 9.0)), camera, GREY)


def _in_camera(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Return the centres (3, K) float64 in camera coordinates, none nearer than a ten-thousandth."""
    x, y, z = camera.rotation @ gaussians.means.T.astype(np.float64) + camera.translation[:, None]
    return np.stack([x, y, np.maximum(z, 1e-4)])


def _accumulated(projection: Projection, fields: np.ndarray, camera: Camera, greatest: bool) -> np.ndarray:
    """Return `accumulate`'s picture (h, w) float32 of ``fields`` (K, 3)."""
    p, image = projection, np.zeros((camera.height, camera.width), np.float32)
    rows = np.ascontiguousarray(fields, np.float32)
    accumulate(p.tiles, p.start, p.members, p.extent, p.flat, rows, p.tiles_x, greatest, image)
    return image


@parallel_kernel("i8:1 i8:1 i4:1 i4:2 f4:2 f4:2 i8 b1 f4:2", error_model="numpy")
def accumulate(
    thread: ThreadSlice,
    tiles: np.ndarray, start: np.ndarray, members: np.ndarray, extent: np.ndarray, flat: np.ndarray, fields: np.ndarray,
    tiles_x: int, greatest: bool, image: np.ndarray,
) -> None:  # fmt: skip
    """Raise ``image`` (h, w) float32 to the greatest MIP of a Gaussian, or add their optical depths to it.

    ``fields`` (K, 3) float32: value at the centre and its slope per pixel, or the optical depth at the centre and
    zeros; other arguments as of `tiles.blend`.
    """
    height, width = image.shape
    index = next_iteration(thread)
    while index < tiles.shape[0]:
        tile = tiles[index]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        right, bottom = min(left + TILE, width), min(top + TILE, height)
        for k in members[start[tile] : start[tile + 1]]:
            u, v, a, b, c = flat[k, 0], flat[k, 1], flat[k, 2], flat[k, 3], flat[k, 4]
            value, across, down = fields[k, 0], fields[k, 1], fields[k, 2]
            for row in range(max(extent[k, 1], top), min(extent[k, 3], bottom)):
                dy = row + 0.5 - v
                for column in range(max(extent[k, 0], left), min(extent[k, 2], right)):
                    dx = column + 0.5 - u
                    p = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
                    if greatest:
                        if p < END:
                            t = min((END - p) / (END - PLATEAU), 1.0)
                            here = (value + across * dx + down * dy) * t * t * (3.0 - 2.0 * t)
                            image[row, column] = max(image[row, column], here)
                    elif p < REACH:
                        image[row, column] += value * math.exp(-p)
        index = next_iteration(thread)
