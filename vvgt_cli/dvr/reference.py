"""The float64 twin of the ray caster: every ray at one small step, optics straight from the transfer function.

Per segment of length ds, with the scalar s at its middle (Max 1995, eq. 8, by the midpoint rule; conventions: Optics):
``alpha = 1 - exp(-tau(s) ds)``, ``C += T alpha c(s)``, ``T *= 1 - alpha``. Under light c is shaded (docs/light.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.dvr.layers import scalar_layers
from vvgt_cli.dvr.layout import corners
from vvgt_cli.dvr.scene import Scene
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.tables import extinction
from vvgt_cli.volume import Volume

SAMPLES = 4096  # evaluated at a time: bounds the memory


def trilinear(volume: Volume, points: np.ndarray) -> np.ndarray:
    """Return data values (n,) float64 at voxel coordinates (n, 3), (x, y, z), clamped to the edge voxels.

    NaN where one of the eight voxels around is not finite.
    """
    total = np.zeros(len(points))
    for (x, y, z), weight in corners(points, volume.dims):
        with np.errstate(invalid="ignore"):
            total += weight * (volume.slope * volume.data[z, y, x].astype(np.float64) + volume.intercept)
    return np.where(np.isfinite(total), total, np.nan)


def optics(scene: Scene, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return extinction (n,) per unit-frame length and colour (n, 3) of data values (n,); NaN is transparent."""
    known = np.isfinite(x)
    tf = cast(TransferFunction, scene.tf)
    clean = np.clip(np.where(known, x, 0.0), *tf.node_range())
    tau = extinction(tf.opacity(clean), scene.unit_distance) / scene.volume.unit_frame().scale
    return np.where(known, tau, 0.0), tf.color(clean)


def optics_at(scene: Scene, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return extinction (n,) per unit-frame length and colour (n, 3) at voxel coordinates (n, 3)."""
    if scene.grid is None:
        return optics(scene, trilinear(scene.volume, points))
    return _parted(grid_values(scene.grid, points))


def _parted(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return extinction (n,) and colour (n, 3) of extinction times (r, g, b, 1)."""
    return values[:, 3], values[:, :3] / np.where(values[:, 3:] > 0, values[:, 3:], 1)


def matter_at(scene: Scene, points: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield what rays meet at voxel coordinates (n, 3): of each layer of scalars of a mixture, and of all else.

    Extinction (n,) per unit-frame length, colour (n, 3), and the values (nz, ny, nx) that have its normals.
    """
    if scene.mixture is None or scene.mixture.scalars is None:
        yield *optics_at(scene, points), scene.relieved.values
        return
    yield *_parted(grid_values(scene.mixture.grid, points)), scene.relieved.values
    inner = scalar_layers(cast(Any, scene.tf).layers)
    for layer, values in zip(inner, scene.mixture.scalars, strict=True):
        matrix = np.linalg.inv(layer.volume.affine) @ scene.volume.affine
        at = points @ matrix[:3, :3].T + matrix[:3, 3]
        outside = ((at < -0.5) | (at > np.array(layer.volume.dims) - 0.5)).any(axis=1)
        data = np.where(outside, np.nan, trilinear(layer.volume, at))
        tau, rgb = _parted(layer.classify(data).astype(np.float64))
        yield tau / scene.volume.unit_frame().scale, rgb, values


def normals(scene: Scene, points: np.ndarray, values: np.ndarray | None = None) -> np.ndarray:
    """Return directions (n, 3) of the gradient, box frame, at voxel coordinates (n, 3); zeros where there is none.

    Central differences of ``values`` (nz, ny, nx), by default `Scene.shaded`, at voxels (clamped at the edges),
    interpolated trilinearly.
    """
    dims, values = scene.volume.dims, scene.shaded.values if values is None else values
    gradient = np.zeros((len(points), 3))
    for at, weight in corners(points, dims):
        for axis in range(3):
            ends = [[np.clip(x + sign * (k == axis), 0, dims[k] - 1) for k, x in enumerate(at)] for sign in (1, -1)]
            after, before = (values[z, y, x].astype(np.float64) for x, y, z in ends)
            with np.errstate(invalid="ignore"):
                gradient[:, axis] += weight * (after - before) / scene.step[axis]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        length = np.linalg.norm(gradient, axis=1, keepdims=True)
        return np.where((length > 0) & (length < np.inf), gradient / length, 0.0)


def grid_values(grid: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return values (n[, c]) of a grid (nz, ny, nx[, c]) at its coordinates (n, 3), (x, y, z), clamped."""
    total = np.zeros((len(points), *grid.shape[3:]))
    for (x, y, z), weight in corners(points, grid.shape[2::-1]):
        total += weight.reshape(-1, *[1] * (grid.ndim - 3)) * grid[z, y, x]
    return total


def shade(
    scene: Scene, points: np.ndarray, directions: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the colours' factors (n, 1 or 3) and white to add (n,) at voxel coordinates (n, 3) seen along (n, 3).

    ``values`` (nz, ny, nx) have the normals.
    """
    light = scene.light
    assert light is not None
    at = (points + 0.5) * light.inv_cell - 0.5
    if light.traced:
        return grid_values(light.shade.transpose(1, 2, 3, 0), at), np.zeros(len(points))
    normal = normals(scene, points, values)
    known = normal.any(axis=1)
    diffuse, white = np.zeros(len(points)), np.zeros(len(points))
    for toward in [*light.directions, *([-directions] if light.head else [])]:
        half = toward - directions
        length = np.linalg.norm(half, axis=1)
        half = half / np.where(length > 1e-9, length, np.inf)[:, None]
        diffuse += np.abs((normal * toward).sum(axis=1))
        white += np.where(length > 1e-9, np.abs((normal * half).sum(axis=1)) ** light.power, 0)
    factor = light.ambient + light.diffuse * np.where(known, diffuse, 0)
    return factor[:, None], light.specular * np.where(known, white, 0)


def rays(camera: Camera, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return origin (3,) and unit directions (height, width, samples^2, 3) in the unit frame."""
    offset = (np.arange(samples) + 0.5) / samples
    x = (np.arange(camera.width)[:, None] + offset - camera.cx) / camera.fx  # (w, s)
    y = (np.arange(camera.height)[:, None] + offset - camera.cy) / camera.fy  # (h, s)
    local = np.empty((camera.height, camera.width, samples, samples, 3))
    local[..., 0], local[..., 1], local[..., 2] = x[None, :, None, :], y[:, None, :, None], 1.0
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    return camera.position, (local @ camera.rotation).reshape(camera.height, camera.width, samples**2, 3)


def march(scene: Scene, origin: np.ndarray, directions: np.ndarray, step: float) -> np.ndarray:
    """Return premultiplied RGBA (n, 4) float64 along unit ``directions`` (n, 3); ``step`` in smallest voxel edges."""
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (-scene.half - origin) / directions, (scene.half - origin) / directions
    parallel = directions == 0  # no face across that axis: inside its slab, or never
    outside = (parallel & (np.abs(origin) > scene.half)).any(axis=1)
    first = np.where(parallel, -np.inf, np.minimum(near, far)).max(axis=1).clip(0)
    last = np.where(parallel, np.inf, np.maximum(near, far)).min(axis=1)
    length = np.where(outside, 0.0, (last - first).clip(0))  # unit-frame lengths
    count = max(int(np.ceil(length.max() / (step * scene.step.min()))), 1)
    ds = length / count
    color, trans = np.zeros((len(directions), 3)), np.ones(len(directions))
    together = max(SAMPLES // len(directions), 1)  # steps
    for begin in range(0, count, together):
        t = first + (np.arange(begin, min(begin + together, count))[:, None] + 0.5) * ds
        points = ((origin + t[..., None] * directions + scene.half) / scene.step - 0.5).reshape(-1, 3)
        tau, rgb = np.zeros(len(points)), np.zeros((len(points), 3))
        for its, own, values in matter_at(scene, points):
            if scene.light is not None:
                factor, white = shade(scene, points, np.tile(directions, (len(t), 1)), values)
                own = np.minimum(factor * own + white[:, None], 1)
            tau, rgb = tau + its, rgb + its[:, None] * own
        rgb /= np.where(tau > 0, tau, 1)[:, None]
        alpha = -np.expm1(-tau.reshape(t.shape) * ds)
        left = np.cumprod([trans, *(1 - alpha)], axis=0)
        color += ((left[:-1] * alpha)[..., None] * rgb.reshape(*t.shape, 3)).sum(axis=0)
        trans = left[-1]
    return np.concatenate([color, 1 - trans[:, None]], axis=1)


def render_view_reference(scene: Scene, camera: Camera, step: float = 0.125, samples: int = 1) -> np.ndarray:
    """Render (height, width, 4) float64 premultiplied RGBA by ``samples`` x ``samples`` rays in every pixel."""
    origin, directions = rays(camera, samples)
    flat = directions.reshape(-1, 3)
    parts = [march(scene, origin, flat[i : i + SAMPLES], step) for i in range(0, len(flat), SAMPLES)]
    return np.concatenate(parts).reshape(camera.height, camera.width, samples**2, 4).mean(axis=2)
