"""`Lighting` as kernels take it: directions in the box frame, shadows and occlusion on grids (docs/light.md)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vvgt_cli.dvr.layout import BRICK, Light, Optics, Voxels
from vvgt_cli.transfer.lighting import Lighting

MAX_CELLS = 1 << 21  # of a grid: 128^3; more cost more time than they show
ANGLE = 3.0  # degrees: radius of a light as it is seen; six times the sun's
RAYS = 7  # towards a light
AROUND = 24  # directions of occlusion
OFFSET = 1.5  # cells that rays begin beyond their place: matter does not shade its own surface
STEP = 1.0  # voxels
FAR = 1e300


class Matter(NamedTuple):
    """What attenuates light: the fields of `vvgt_cli.dvr.scene.Scene` of these names."""

    voxels: Voxels
    optics: Optics
    empty: np.ndarray
    step: np.ndarray


def lights_of(matter: Matter, axes: np.ndarray, lighting: Lighting, max_cells: int = MAX_CELLS) -> Light:
    """What falls on a scene.

    Args:
        matter: of the scene.
        axes: (3, 3), of its volume.
        lighting: in world axes; a direction is taken through ``axes``.
        max_cells: of each grid of shadows and occlusion: cubes of 1, 2, 4, ... voxels, as fine as that allows.
    """
    inward = np.linalg.inv(axes)
    directions = np.array([_unit(inward @ np.array(d)) for d in lighting.directions]).reshape(-1, 3)
    cell = 1
    while math.prod(-(-n // cell) for n in matter.voxels.values.shape) > max_cells:
        cell *= 2
    grids = []
    if lighting.shadows:
        grids += [transmittance(matter, cone(d, ANGLE, RAYS), cell) for d in directions]
    if lighting.occlusion is not None:
        around = transmittance(matter, sphere(AROUND), cell, lighting.occlusion)
        grids.append(np.minimum(2 * around, 1))  # a plane is open
    shade = np.stack(grids) if grids else np.ones((1, 1, 1, 1), np.float32)
    return Light(
        float(lighting.ambient), float(lighting.diffuse), float(lighting.specular), float(lighting.specular_power),
        int(lighting.headlight),
        np.ascontiguousarray(directions), shade, int(lighting.shadows), int(lighting.occlusion is not None),
        1.0 / cell, np.ascontiguousarray(matter.step, np.float64),
    )  # fmt: skip


def transmittance(
    matter: Matter,
    directions: np.ndarray,
    cell: int,
    reach: float = FAR,
    step: float = STEP,
    offset: float | None = None,
) -> np.ndarray:
    """Mean transmittance from the centres of cells along ``directions``, (cz, cy, cx) float32 in [0, 1].

    Args:
        matter: what lies before the lights.
        directions: (n, 3) unit vectors, box frame.
        cell: edge of a cell in voxels; cells that touch nothing visible have 1.
        reach: unit-frame length beyond which nothing counts.
        step: of the march, in voxels.
        offset: voxels along each direction from where on matter counts; None: `OFFSET` cells.
    """
    from vvgt_cli.dvr.shadows import mean_transmittance

    out = np.empty(tuple(-(-n // cell) for n in matter.voxels.values.shape), np.float32)
    first = OFFSET * cell if offset is None else offset
    near = 1 + cell // BRICK
    mean_transmittance(
        matter.voxels, matter.optics, matter.empty, np.ascontiguousarray(directions / matter.step), near, float(cell),
        float(first), float(reach), float(step), out,
    )  # fmt: skip
    return out


def cone(axis: np.ndarray, angle: float, count: int) -> np.ndarray:
    """(count, 3) unit vectors spread evenly over the disc within ``angle`` degrees of a unit vector (3,)."""
    first = _unit(np.cross(axis, np.eye(3)[np.abs(axis).argmin()]))
    second = np.cross(axis, first)
    n = np.arange(count)
    radius = math.tan(math.radians(angle)) * np.sqrt((n + 0.5) / count)
    turn = math.pi * (3 - math.sqrt(5)) * n
    off = radius[:, None] * (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second)
    found: np.ndarray = (axis + off) / np.linalg.norm(axis + off, axis=1, keepdims=True)
    return found


def sphere(count: int) -> np.ndarray:
    """(count, 3) unit vectors spread evenly over all directions."""
    n = np.arange(count)
    z = 1 - (2 * n + 1) / count
    turn = math.pi * (3 - math.sqrt(5)) * n
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def _unit(vector: np.ndarray) -> np.ndarray:
    found: np.ndarray = vector / np.linalg.norm(vector)
    return found
