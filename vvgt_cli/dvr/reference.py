"""The float64 twin of the ray caster: every ray at one small step, optics straight from the transfer function.

Per segment of length ds, with the scalar s at its middle (Max 1995, eq. 8, by the midpoint rule; conventions: Optics):
``alpha = 1 - exp(-tau(s) ds)``, ``C += T alpha c(s)``, ``T *= 1 - alpha``.
"""

from __future__ import annotations

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.dvr.scene import Scene
from vvgt_cli.transfer.tables import extinction
from vvgt_cli.volume import Volume

RAYS = 4096  # marched at a time: bounds the memory


def trilinear(volume: Volume, points: np.ndarray) -> np.ndarray:
    """Data values (n,) float64 at voxel coordinates (n, 3), (x, y, z), clamped to the edge voxels.

    NaN where one of the eight voxels around is not finite.
    """
    top = np.array(volume.dims) - 1
    points = np.clip(points, 0, top)
    low = np.floor(points).astype(np.int64)
    high = np.minimum(low + 1, top)
    fraction = points - low
    total = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (np.where(up, high[:, axis], low[:, axis]) for axis, up in enumerate(corner))
        weight = np.prod(np.where(corner, fraction, 1 - fraction), axis=1)
        with np.errstate(invalid="ignore"):
            total += weight * (volume.slope * volume.data[z, y, x].astype(np.float64) + volume.intercept)
    return np.where(np.isfinite(total), total, np.nan)


def optics(scene: Scene, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Extinction (n,) per unit-frame length and colour (n, 3) of data values (n,); NaN is transparent."""
    known = np.isfinite(x)
    clean = np.clip(np.where(known, x, 0.0), *scene.tf.node_range())
    tau = extinction(scene.tf.opacity(clean), scene.unit_distance) / scene.volume.unit_frame().scale
    return np.where(known, tau, 0.0), scene.tf.color(clean)


def rays(camera: Camera, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and unit directions (height, width, samples^2, 3) in the unit frame."""
    offset = (np.arange(samples) + 0.5) / samples
    x = (np.arange(camera.width)[:, None] + offset - camera.cx) / camera.fx  # (w, s)
    y = (np.arange(camera.height)[:, None] + offset - camera.cy) / camera.fy  # (h, s)
    local = np.empty((camera.height, camera.width, samples, samples, 3))
    local[..., 0], local[..., 1], local[..., 2] = x[None, :, None, :], y[:, None, :, None], 1.0
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    return camera.position, (local @ camera.rotation).reshape(camera.height, camera.width, samples**2, 3)


def march(scene: Scene, origin: np.ndarray, directions: np.ndarray, step: float) -> np.ndarray:
    """Premultiplied RGBA (n, 4) float64 along unit ``directions`` (n, 3); ``step`` in voxels of the smallest edge."""
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
    for i in range(count):
        t = first + (i + 0.5) * ds
        points = (origin + t[:, None] * directions + scene.half) / scene.step - 0.5
        tau, rgb = optics(scene, trilinear(scene.volume, points))
        alpha = -np.expm1(-tau * ds)
        color += (trans * alpha)[:, None] * rgb
        trans = trans * (1 - alpha)
    return np.concatenate([color, 1 - trans[:, None]], axis=1)


def render_view_reference(scene: Scene, camera: Camera, step: float = 0.125, samples: int = 1) -> np.ndarray:
    """(height, width, 4) float64 premultiplied RGBA, ``samples`` x ``samples`` rays in every pixel."""
    origin, directions = rays(camera, samples)
    flat = directions.reshape(-1, 3)
    parts = [march(scene, origin, flat[i : i + RAYS], step) for i in range(0, len(flat), RAYS)]
    result: np.ndarray = np.concatenate(parts).reshape(camera.height, camera.width, samples**2, 4).mean(axis=2)
    return result
