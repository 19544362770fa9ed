"""`Sky`: the light that comes from every direction, by formula or from a picture, and a table to draw directions from.

The table has rows of equal height z and columns of equal azimuth, so that all of its texels are equally large
(Lambert's cylindrical projection): the density of a direction is its texel's probability times texels / 4 pi.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.images.files import read_radiance

ROWS, COLUMNS = 128, 256
Toward = tuple[float, float, float]  # to the viewer's right, towards the viewer, up
LUMINANCE = 0.2126, 0.7152, 0.0722  # of linear red, green and blue, sRGB's primaries
EVERY = 31  # texel is looked at for the brightest side


class Sky(NamedTuple):
    """Light from infinity, in a volume's box frame.

    Attributes:
        radiance: (rows, columns, 3) float64 linear red, green and blue.
        cumulative: (rows * columns,) float64 probability of the texels up to each: as their luminance.
    """

    radiance: np.ndarray
    cumulative: np.ndarray


SKY = "f8:3 f8:1"  # types of the fields, for `jit.decorators.kernel`


def sky_of(name: str, front: np.ndarray, axes: np.ndarray) -> Sky:
    """Return the sky of a name of `look.lighting.SKIES`, or of a picture (`pictured`).

    It is exposed so that a white matt surface turned to the brightest side is white: red, green and blue average 1.

    Args:
        name: which, or the picture's path.
        front: (3,) direction, world axes, whose horizontal part points to where the viewer stands; all of it points to
            the sun.
        axes: (3, 3) of the volume, as `Volume.axes`.

    Raises:
        DataError: the picture is missing or damaged, or its light is negative, not finite or none.
    """
    here = directions()
    world = here @ axes.T
    world /= np.linalg.norm(world, axis=1, keepdims=True)
    ahead = np.array([front[0], front[1], 0.0])
    ahead = ahead / np.linalg.norm(ahead) if ahead.any() else np.array([0.0, -1.0, 0.0])
    right = np.array([-ahead[1], ahead[0], 0.0])  # of the viewer
    x, y, z = world @ right, world @ ahead, world[:, 2]
    toward = (0.0, math.hypot(front[0], front[1]), float(front[2]))
    radiance = _BY_NAME[name](x, y, z, toward) if name in _BY_NAME else pictured(name, x, y, z)
    matt = np.clip(here[::EVERY] @ here.T, 0, None) @ radiance * 4 / len(here)
    radiance = radiance / matt.mean(axis=1).max()
    weight = np.cumsum(radiance @ LUMINANCE)
    return Sky(np.ascontiguousarray(radiance.reshape(ROWS, COLUMNS, 3)), weight / weight[-1])


def directions() -> np.ndarray:
    """Return the unit vectors (texels, 3) through the middles of the table's texels."""
    z = 1 - (np.arange(ROWS) + 0.5) * 2 / ROWS
    turn = (np.arange(COLUMNS) + 0.5) * 2 * math.pi / COLUMNS
    across = np.sqrt(1 - z * z)[:, None]
    x, y = across * np.cos(turn), across * np.sin(turn)
    return np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], axis=-1).reshape(-1, 3)


def pictured(path: str, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the light (n, 3) of a picture all around, twice as wide as high: its middle is behind what is viewed.

    Each direction takes the mean of the part of the picture that its texel covers.

    Args:
        path: of an ``.hdr`` or ``.exr``, linear red, green and blue.
        x: (n,) of unit vectors, to the viewer's right.
        y: towards the viewer.
        z: up.

    Raises:
        DataError: see `sky_of`.
    """
    pixels = read_radiance(path)
    finite = np.isfinite(pixels)
    if not finite.all() or pixels.min() < 0 or not pixels.max() > 0:
        wrong = "none" if finite.all() and pixels.min() >= 0 else "negative or not finite"
        raise DataError(f"{path}: light that is {wrong}; expected numbers from 0, some above: repair the picture")
    height, width = pixels.shape[:2]
    sums = np.pad(pixels.astype(np.float64).cumsum(axis=0).cumsum(axis=1), [(1, 0), (1, 0), (0, 0)])
    top, bottom = (np.arccos(np.clip(z + end / ROWS, -1, 1)) / math.pi * height for end in (1, -1))
    column = (np.arctan2(x, -y) / (2 * math.pi) + 0.5) * width
    left, right = column - width / COLUMNS / 2, column + width / COLUMNS / 2
    top, bottom = np.round(top).astype(int), np.round(bottom).astype(int)
    left, right = (np.clip(np.round(end), 0, width).astype(int) for end in (left, right))
    top, left = np.minimum(top, height - 1), np.minimum(left, width - 1)
    bottom, right = np.maximum(bottom, top + 1), np.maximum(right, left + 1)
    total = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    return np.maximum(total, 0) / ((bottom - top) * (right - left))[:, None]


def _box(x: np.ndarray, y: np.ndarray, z: np.ndarray, toward: Toward, angle: float) -> np.ndarray:
    """Return how much (n,) of a round soft box of ``angle`` degrees around ``toward`` is in each direction."""
    length = math.sqrt(sum(c * c for c in toward))
    cosine = (x * toward[0] + y * toward[1] + z * toward[2]) / length
    edge = math.cos(math.radians(angle))
    return np.clip((cosine - edge) / (1 - edge) * 3, 0, 1)


def _colored(*parts: tuple[np.ndarray, tuple[float, float, float]]) -> np.ndarray:
    """Sum (n,) brightnesses times colours: (n, 3)."""
    return np.sum([part[:, None] * np.array(color) for part, color in parts], axis=0)


def _studio(x: np.ndarray, y: np.ndarray, z: np.ndarray, _: Toward) -> np.ndarray:
    """Return a key light in front at the upper left, a weaker one at the right, one behind, and grey walls."""
    key, fill = _box(x, y, z, (-0.6, 0.6, 0.62), 35), _box(x, y, z, (0.9, 0.5, 0.1), 40)
    rim = _box(x, y, z, (0.4, -0.8, 0.5), 25)
    return _colored(
        (0.22 + 0.16 * z, (0.95, 0.98, 1.05)), (5 * key, (1.0, 0.95, 0.88)), (1.2 * fill, (0.86, 0.93, 1.0)),
        (3 * rim, (1.0, 1.0, 1.0)),
    )  # fmt: skip


def _overcast(x: np.ndarray, y: np.ndarray, z: np.ndarray, _: Toward) -> np.ndarray:
    """Return the CIE's standard overcast sky (Moon and Spencer 1942), over ground that reflects a fifth."""
    return _colored((np.where(z > 0, (1 + 2 * z) / 3, 0.2 * 7 / 9), (0.96, 0.99, 1.05)))


def _window(x: np.ndarray, y: np.ndarray, z: np.ndarray, _: Toward) -> np.ndarray:
    """Return a large window at the left, slightly in front, in a dim room."""
    turn, height = np.arctan2(y, -x), np.arcsin(np.clip(z, -1, 1))
    pane = ((turn > -0.2) & (turn < 0.85) & (height > -0.15) & (height < 0.75)).astype(np.float64)
    return _colored((6 * pane, (0.94, 0.98, 1.06)), (0.16 + 0.06 * z, (1.08, 1.0, 0.9)))


def _sun(x: np.ndarray, y: np.ndarray, z: np.ndarray, toward: Toward) -> np.ndarray:
    """Return a sun behind haze, 24 degrees wide, in a dim sky."""
    return _colored((30 * _box(x, y, z, toward, 12), (1.0, 0.96, 0.88)), (0.2 + 0.12 * z, (0.88, 0.96, 1.12)))


_BY_NAME = {"studio": _studio, "overcast": _overcast, "window": _window, "sun": _sun}
