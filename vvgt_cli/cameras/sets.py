"""View sets: the Fibonacci sphere of the conventions, and orbits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from vvgt_cli.cameras.types import Camera

GOLDEN = (1 + math.sqrt(5)) / 2
SET_SHIFT = {"train": 0.5, "check": 0.83, "test": 0.13}
SET_VIEWS = {"train": 24, "check": 4, "test": 10}
RADIUS = 3.0
FIELD_OF_VIEW = 40.0  # degrees, vertical
SIZE = 400  # pixels


def look_at(
    eye: Sequence[float] | np.ndarray,
    *,
    target: Sequence[float] = (0.0, 0.0, 0.0),
    up: Sequence[float] = (0.0, 0.0, 1.0),
    width: int = SIZE,
    height: int = SIZE,
    fov: float = FIELD_OF_VIEW,
    name: str = "view",
) -> Camera:
    """Return a camera at ``eye`` that looks at ``target`` (unit frame), with the vertical field of view in degrees."""
    eye = np.asarray(eye, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) < 1e-9:  # looking along `up`: any right-hand axis will do
        right = np.cross(forward, (0.0, 1.0, 0.0) if abs(forward[1]) < 0.9 else (1.0, 0.0, 0.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])  # rows: x right, y down, z forward
    focal = height / (2 * math.tan(math.radians(fov) / 2))
    return Camera(rotation, -rotation @ eye, focal, focal, width / 2, height / 2, width, height, name)


def fibonacci_views(
    count: int,
    shift: float,
    *,
    size: int = SIZE,
    radius: float = RADIUS,
    fov: float = FIELD_OF_VIEW,
    name: str = "view",
) -> list[Camera]:
    """Return ``count`` square views on the Fibonacci sphere (conventions: Default views)."""
    views = [_fibonacci_view(i, count, shift, size, radius, fov, f"{name}_{i:03d}") for i in range(count)]
    return [replace(view, rotation=view.rotation.copy(), translation=view.translation.copy()) for view in views]


@lru_cache(maxsize=1000)
def _fibonacci_view(i: int, count: int, shift: float, size: int, radius: float, fov: float, name: str) -> Camera:
    """Return one of the views; kept, because a conversion asks for the same ones many times."""
    z = 0.9 * (1 - (2 * i + 1) / count)
    azimuth = 2 * math.pi * ((i / GOLDEN + shift) % 1.0)
    ring = math.sqrt(1 - z * z)
    eye = (radius * ring * math.cos(azimuth), radius * ring * math.sin(azimuth), radius * z)
    return look_at(eye, width=size, height=size, fov=fov, name=name)


def default_views(
    which: str, count: int | None = None, *, size: int = SIZE, radius: float = RADIUS, fov: float = FIELD_OF_VIEW
) -> list[Camera]:
    """Return the ``train`` (24), ``check`` (4) or ``test`` (10) set, which are disjoint."""
    return fibonacci_views(
        SET_VIEWS[which] if count is None else count, SET_SHIFT[which], size=size, radius=radius, fov=fov, name=which
    )


def orbit_views(
    count: int, *, elevation: float = 20.0, size: int = SIZE, radius: float = RADIUS, fov: float = FIELD_OF_VIEW
) -> list[Camera]:
    """Return ``count`` views on a circle around +z at ``elevation`` degrees."""
    height, ring = radius * math.sin(math.radians(elevation)), radius * math.cos(math.radians(elevation))
    cameras = []
    for i in range(count):
        azimuth = 2 * math.pi * i / count
        eye = (ring * math.cos(azimuth), ring * math.sin(azimuth), height)
        cameras.append(look_at(eye, width=size, height=size, fov=fov, name=f"orbit_{i:03d}"))
    return cameras


def farthest_cameras(cameras: Sequence[Camera], count: int) -> list[int]:
    """Return the indices, ascending, of at most ``count`` cameras that are far apart, by farthest-point sampling.

    Sampling begins with the camera farthest from the mean position. Ties are broken by position, so the order of the
    cameras does not matter.
    """
    eyes = np.array([camera.position for camera in cameras])
    if len(eyes) <= count:
        return list(range(len(eyes)))
    tie = np.lexsort(eyes.T)  # smallest first
    eyes = eyes[tie]
    gap = np.linalg.norm(eyes - eyes[np.argmax(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1))], axis=1)
    chosen = [int(np.argmin(gap))]
    while len(chosen) < count:
        nearest = int(np.argmax(np.where(np.isin(np.arange(len(eyes)), chosen), -1.0, gap)))
        chosen.append(nearest)
        gap = np.minimum(gap, np.linalg.norm(eyes - eyes[nearest], axis=1))
    return sorted(int(tie[i]) for i in chosen)


def pixel_width(size: int) -> float:
    """Return the width of a pixel at the volume's centre in the default views, unit frame."""
    return 2 * RADIUS * math.tan(math.radians(FIELD_OF_VIEW) / 2) / size
