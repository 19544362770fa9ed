"""`Lighting` as kernels take it: directions in the box frame, shadows and occlusion on grids (docs/light.md)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.dvr.layout import TRACED, Light, Voxels
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.look.tables import Optics

if TYPE_CHECKING:
    from vvgt_cli.dvr.traced import Scattering

MAX_CELLS = 1 << 21  # of a grid: 128^3; more cost more time than they show
ANGLE = 3.0  # degrees: radius of a light as it is seen; six times the sun's
RAYS = 7  # towards a light
AROUND = 24  # directions of occlusion
OFFSET = 1.5  # cells that rays begin beyond their place: matter does not shade its own surface
STEP = 1.0  # voxels
FAR = 1e300


def scene_light(
    lighting: Lighting,
    axes: np.ndarray,
    step: np.ndarray,
    shape: Sequence[int],
    extinction: Callable[[int], np.ndarray],
    matter: Callable[[], Scattering] | None = None,
) -> Light:
    """Return the light that falls on a volume.

    Args:
        lighting: in world axes; a direction is taken through the volume's axes.
        axes: (3, 3) of the volume, as `Volume.axes`.
        step: (3,) voxel edges, unit-frame lengths, (x, y, z).
        shape: voxels (z, y, x).
        extinction: mean extinction (cz, cy, cx) float32 of cubes of so many voxels; asked for where there are shadows
            or occlusion, which are marched through it.
        matter: what scatters the light of a sky; asked for where there is one.
    """
    from vvgt_cli.dvr.bricks import dilate

    inward = np.linalg.inv(axes)
    directions = np.array([_unit(inward @ np.array(d)) for d in lighting.directions]).reshape(-1, 3)
    cell, shade, shadows = shade_cell(shape), np.ones((1, 1, 1, 1), np.float32), int(lighting.shadows)
    if lighting.sky is not None and matter is not None:
        from vvgt_cli.dvr.sky import sky_of
        from vvgt_cli.dvr.traced import light_grid

        sky = sky_of(lighting.sky, np.array(lighting.directions[0]), axes)
        shade, shadows, directions = light_grid(matter(), sky, shape, cell), TRACED, np.zeros((0, 3))
    elif lighting.attenuated:
        density, grids = extinction(cell), []
        dense, wanted = Matter.of(density, step * cell), dilate(density > 0)  # where there is nothing, nothing is lit
        if lighting.shadows:
            grids += [transmittance(dense, cone(d, ANGLE, RAYS), 1, wanted=wanted) for d in directions]
        if lighting.occlusion is not None:
            around = transmittance(dense, sphere(AROUND), 1, lighting.occlusion, wanted=wanted)
            grids.append(np.minimum(2 * around, 1))  # a plane is open
        shade = np.stack(grids)
    return Light(
        float(lighting.ambient), float(lighting.diffuse), float(lighting.specular), float(lighting.specular_power),
        int(lighting.headlight),
        np.ascontiguousarray(directions), shade, shadows, int(lighting.occlusion is not None),
        1.0 / cell, np.ascontiguousarray(step, np.float64), np.zeros(3),
    )  # fmt: skip


def shade_cell(shape: Sequence[int]) -> int:
    """Return the edge in voxels of a cell of shadows and occlusion: 1, 2, 4, ..., for `MAX_CELLS` at most."""
    cell = 1
    while math.prod(-(-n // cell) for n in shape) > MAX_CELLS:
        cell *= 2
    return cell


@dataclass(frozen=True)
class Matter:
    """A grid of extinction; attributes as of `Scene`."""

    voxels: Voxels
    optics: Optics
    empty: np.ndarray
    step: np.ndarray

    @classmethod
    def of(cls, extinction: np.ndarray, step: np.ndarray) -> Matter:
        """Wrap (nz, ny, nx) float32 per unit-frame length; ``step`` (3,) edges of its cells, unit frame."""
        from vvgt_cli.dvr.bricks import brick_ranges, empty_distance

        extinction.flags.writeable = False  # as volumes' values are: kernels are compiled for such
        optics = Optics.linear(float(extinction.max()))
        return cls(Voxels(extinction), optics, empty_distance(brick_ranges(extinction), optics), step)


def transmittance(
    matter: Matter, directions: np.ndarray, cell: int, reach: float = FAR, step: float = STEP,
    offset: float | None = None, wanted: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return mean transmittance from the centres of cells along ``directions``, (cz, cy, cx) float32 in [0, 1].

    Args:
        matter: what lies before the lights.
        directions: (n, 3) unit vectors, box frame.
        cell: edge of a cell in voxels.
        reach: unit-frame length beyond which nothing counts.
        step: of the march, in voxels.
        offset: voxels along each direction from where on matter counts; None: `OFFSET` cells.
        wanted: (cz, cy, cx) bool: others have 1; None: all.
    """
    from vvgt_cli.dvr.shadows import mean_transmittance

    out = np.empty(tuple(-(-n // cell) for n in matter.voxels.values.shape), np.float32)
    first = OFFSET * cell if offset is None else offset
    mean_transmittance(
        matter.voxels, matter.optics, matter.empty, np.ascontiguousarray(directions / matter.step),
        np.ones(out.shape, bool) if wanted is None else wanted, float(cell), float(first), float(reach), float(step),
        out,
    )  # fmt: skip
    return out


def cone(axis: np.ndarray, angle: float, count: int) -> np.ndarray:
    """Return (count, 3) unit vectors spread evenly over the disc within ``angle`` degrees of a unit vector (3,)."""
    first = _unit(np.cross(axis, np.eye(3)[np.abs(axis).argmin()]))
    second = np.cross(axis, first)
    n = np.arange(count)
    radius = math.tan(math.radians(angle)) * np.sqrt((n + 0.5) / count)
    turn = math.pi * (3 - math.sqrt(5)) * n
    off = radius[:, None] * (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second)
    directions: np.ndarray = (axis + off) / np.linalg.norm(axis + off, axis=1, keepdims=True)
    return directions


def sphere(count: int) -> np.ndarray:
    """Return (count, 3) unit vectors spread evenly over all directions."""
    n = np.arange(count)
    z = 1 - (2 * n + 1) / count
    turn = math.pi * (3 - math.sqrt(5)) * n
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def _unit(vector: np.ndarray) -> np.ndarray:
    unit: np.ndarray = vector / np.linalg.norm(vector)
    return unit
