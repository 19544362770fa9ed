"""Data of the ray caster's kernels: a volume's values, the optics, the light, the bricks of the empty-space map."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from vvgt_cli.look.tables import Optics as Optics  # kernels' modules have all their tuples from here

BRICK_BITS = 3
BRICK = 1 << BRICK_BITS  # voxels along the edge of a brick of the empty-space map
TYPES = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))  # of values that kernels read


def pairs_fit(shape: Sequence[int]) -> bool:
    """Return whether 32 bits, read at any pair of integers along x, lie within an array of ``shape`` (nz, ny, nx)."""
    return shape[2] > 1 and math.prod(shape) > 3


def corners(points: np.ndarray, dims: Sequence[int]) -> Iterator[tuple[list[np.ndarray], np.ndarray]]:
    """Yield x, y and z (n,) of each of the eight voxels around points (n, 3), clamped, and their weights (n,)."""
    top = np.array(dims) - 1
    points = np.clip(points, 0, top)
    low = np.floor(points).astype(np.int64)
    ends, shares = (low, np.minimum(low + 1, top)), (1 - (points - low), points - low)
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (shares[up][:, axis] for axis, up in enumerate(corner))
        yield [ends[up][:, axis] for axis, up in enumerate(corner)], x * y * z


class _Values(NamedTuple):
    values: np.ndarray


class Voxels(_Values):
    """A volume's values, so laid out that what `runs` loads by its address lies within them.

    Attributes:
        values: (nz, ny, nx) uint8, uint16 or float32, aligned, C-contiguous, in native byte order.

    Raises:
        ValueError: a layout under which loads would go astray.
    """

    __slots__ = ()

    def __new__(cls, values: np.ndarray) -> Voxels:
        """Check the layout of ``values``, see the class."""
        shape, kind = values.shape, values.dtype
        if len(shape) != 3 or 0 in shape or kind not in TYPES or not kind.isnative:
            names = ", ".join(map(str, TYPES))
            raise ValueError(f"values {shape} of {kind}; expected (nz, ny, nx), not empty, of native {names}")
        if not (values.flags.c_contiguous and values.flags.aligned):
            raise ValueError(f"values {shape} with strides {values.strides}; expected aligned and C-contiguous ones")
        if kind.kind == "u" and not pairs_fit(shape):
            raise ValueError(f"{kind} values {shape}; expected two or more along x and four in all, or float32")
        return super().__new__(cls, values)


class _Grid(NamedTuple):
    values: np.ndarray


class Texels(_Grid):
    """An optics grid, so laid out that what `vectors.texel` loads by its address lies within it.

    Attributes:
        values: (nz, ny, nx, 4) float32 extinction times (r, g, b, 1) per unit-frame length, writable: kernels know no
            other.

    Raises:
        ValueError: a layout under which loads would go astray.
    """

    __slots__ = ()

    def __new__(cls, values: np.ndarray) -> Texels:
        """Check the layout of ``values``, see the class."""
        if values.ndim != 4 or values.shape[3] != 4 or 0 in values.shape or values.dtype != np.dtype(np.float32):
            raise ValueError(f"grid {values.shape} of {values.dtype}; expected (nz, ny, nx, 4) float32, not empty")
        if not (values.flags.c_contiguous and values.flags.aligned and values.flags.writeable):
            raise ValueError(f"grid {values.shape}; expected aligned, C-contiguous and writable memory")
        return super().__new__(cls, values)


class Mixture(NamedTuple):
    """Layers of an optics grid as rays meet them: scalars are interpolated, then classified (docs/layers.md).

    Attributes:
        grid: (nz, ny, nx, 4) float32 extinction times (r, g, b, 1) per unit-frame length of labels, colours and what
            else is classified at voxels, as `Texels` holds it; one texel of zeros where there is nothing.
        scalars: (K, nz, ny, nx) float32 coordinates in the tables, not clamped, of layers of scalars, NaN: unknown;
            None without such layers.
        nodes, cumulative: (K, n + 1, 4) float64 tables, as of `Optics`; or None.
        dark, even: (K, n + 1) float64, the same.
    """

    grid: np.ndarray
    scalars: Any = None
    nodes: Any = None
    cumulative: Any = None
    dark: Any = None
    even: Any = None

    @classmethod
    def of(cls, texels: np.ndarray, scalars: np.ndarray, tables: Sequence[Optics]) -> Mixture:
        """Return the mixture of ``texels`` and of ``scalars`` under as many ``tables`` of one length."""
        if scalars.dtype != np.float32 or scalars.ndim != 4 or not scalars.flags.c_contiguous:
            raise ValueError(f"scalars {scalars.shape} of {scalars.dtype}; expected contiguous float32 (K, nz, ny, nx)")
        stacked = (np.stack([getattr(one, name) for one in tables]) for name in cls._fields[2:])
        return cls(Texels(texels).values, scalars, *stacked)

    def part(self, index: tuple[slice, ...]) -> Mixture:
        """Return the voxels at ``index`` (z, y, x)."""
        whole = self.scalars is not None and self.grid.shape[:3] != self.scalars.shape[1:]
        grid = self.grid if whole else np.ascontiguousarray(self.grid[index])
        scalars = None if self.scalars is None else np.ascontiguousarray(self.scalars[(slice(None), *index)])
        return self._replace(grid=grid, scalars=scalars)

    def fields(self) -> Iterator[tuple[np.ndarray, Optics]]:
        """Yield the scalars (nz, ny, nx) of each layer, read-only, and their tables."""
        for values, nodes, cumulative, dark, even in zip(*self[1:], strict=True) if self.scalars is not None else ():
            values.flags.writeable = False
            yield values, Optics(0.0, 1.0, nodes, cumulative, dark, even, even)


class Light(NamedTuple):
    """Light on a scene, in its box frame (docs/light.md).

    Attributes:
        ambient, diffuse, specular, power: coefficients; ``power`` is of the highlight.
        head: 1 with a light at the eye, else 0.
        directions: (n, 3) float64 unit vectors towards lights at infinity, (x, y, z).
        shade: (3, cz, cy, cx) float32 at the centres of cubes of voxels: red, green and blue that arrive from a sky,
            which may be above 1.
        traced: 1 where ``shade`` is all the light, 0 where it is none of it.
        inv_cell: cells of ``shade`` a voxel.
        edge: (3,) float64 voxel edges, unit-frame lengths, (x, y, z).
        origin: (3,) float64 voxel that ``shade`` is relative to: the first of a block, zeros for a whole volume.
    """

    ambient: float
    diffuse: float
    specular: float
    power: float
    head: int
    directions: np.ndarray
    shade: np.ndarray
    traced: int
    inv_cell: float
    edge: np.ndarray
    origin: np.ndarray


# Types of the fields, for `jit.decorators.kernel`.
TUPLES: dict[type, str] = {Voxels: "V", Optics: "f8 f8 f8:2 f8:2 f8:1 f8:1 f8:1"}
EXTINCTION: dict[type, str] = {**TUPLES, Voxels: "E"}
LIT: dict[type, str] = {**TUPLES, Light: "f8 f8 f8 f8 i8 f8:2 f4:4 i8 f8 f8:1 f8:1"}
GRID: dict[type, str] = {Texels: "f4:4"}
LIT_GRID: dict[type, str] = {**LIT, **EXTINCTION, **GRID}
UNMIXED: dict[type, str] = {Mixture: "f4:4 none none none none none"}
MIXED: dict[type, str] = {Mixture: "f4:4 f4:4 f8:3 f8:3 f8:2 f8:2"}
