"""`Lighting` as kernels take it: directions in the box frame, the light of skies on a grid (docs/light.md)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.dvr.layout import Light
from vvgt_cli.look.lighting import Lighting

if TYPE_CHECKING:
    from vvgt_cli.dvr.traced import Scattering

MAX_CELLS = 1 << 21  # of a grid: 128^3; more cost more time than they show


def scene_light(
    lighting: Lighting,
    axes: np.ndarray,
    step: np.ndarray,
    shape: Sequence[int],
    matter: Callable[[], Scattering] | None = None,
) -> Light:
    """Return the light that falls on a volume.

    Args:
        lighting: in world axes; a direction is taken through the volume's axes.
        axes: (3, 3) of the volume, as `Volume.axes`.
        step: (3,) voxel edges, unit-frame lengths, (x, y, z).
        shape: voxels (z, y, x).
        matter: what scatters the light of a sky; asked for where there is one.
    """
    cell, shade, traced = shade_cell(shape), np.ones((3, 1, 1, 1), np.float32), 0
    if lighting.sky is not None and matter is not None:
        from vvgt_cli.dvr.sky import sky_of
        from vvgt_cli.dvr.traced import light_grid

        sky = sky_of(lighting.sky, np.array(lighting.directions[0]), axes)
        shade, traced, directions = light_grid(matter(), sky, shape, cell), 1, np.zeros((0, 3))
    else:
        inward = [np.linalg.inv(axes) @ np.array(d) for d in lighting.directions]
        directions = np.array([d / np.linalg.norm(d) for d in inward]).reshape(-1, 3)
    return Light(
        float(lighting.ambient), float(lighting.diffuse), float(lighting.specular), float(lighting.specular_power),
        int(lighting.headlight), np.ascontiguousarray(directions), shade, traced, 1.0 / cell,
        np.ascontiguousarray(step, np.float64), np.zeros(3),
    )  # fmt: skip


def shade_cell(shape: Sequence[int]) -> int:
    """Return the edge in voxels of a cell of a sky's light: 1, 2, 4, ..., for `MAX_CELLS` at most."""
    cell = 1
    while math.prod(-(-n // cell) for n in shape) > MAX_CELLS:
        cell *= 2
    return cell


def sphere(count: int) -> np.ndarray:
    """Return (count, 3) unit vectors spread evenly over all directions."""
    n = np.arange(count)
    z = 1 - (2 * n + 1) / count
    turn = math.pi * (3 - math.sqrt(5)) * n
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
