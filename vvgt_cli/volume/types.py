"""`Volume`: a scalar field on a regular grid, and the box frame that every stage works in."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.segments import Segment

DENSITY = "density"  # `Volume.preset`
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
FLAT = 1e-3  # volume of the parallelepiped of three unit axes, below which they lie in a plane
ALIKE = 0.02  # of a voxel, by which places on one grid may differ
RIGHT = 1e-4  # cosine up to which axes are at right angles


T = TypeVar("T")


def float_dtype(dtype: np.dtype) -> np.dtype:
    """Return the type of floats that holds all values of a type, and NaN."""
    return np.dtype(np.float32 if dtype.itemsize <= (4 if dtype.kind == "f" else 2) else np.float64)


def without(values: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Return values as floats that are NaN where ``hidden``; return them as they are where nothing is."""
    if not hidden.any():
        return values
    out = values.astype(float_dtype(values.dtype))
    out[hidden] = np.nan
    return out


def triple(values: Iterable[T]) -> tuple[T, T, T]:
    """Return three values as a tuple of known length."""
    x, y, z = values
    return x, y, z


@dataclass(frozen=True)
class UnitFrame:
    """Box-centred frame with longest edge 2 along the index axes: ``box = (index_xyz + 0.5) * step - half``.

    The unit frame of files is the same turned to world directions: ``unit = axes @ box = scale * (world - centre)``,
    with `Volume.axes`.

    Attributes:
        scale: unit-frame lengths per world length (1 / world unit).
        half: half extents of the box in the unit frame, (x, y, z).
        step: voxel edge in the unit frame, (x, y, z).
        centre: box centre in the world, (x, y, z).
    """

    scale: float
    half: tuple[float, float, float]
    step: tuple[float, float, float]
    centre: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Volume:
    """A scalar volume.

    Attributes:
        data: (nz, ny, nx) stored values, x fastest on disk; may be memory-mapped, of any real dtype
            and byte order. The data value is ``slope * stored + intercept``.
        spacing: voxel edge (x, y, z) in world units, each > 0.
        origin: world position of the centre of voxel (0, 0, 0), (x, y, z).
        direction: 3 x 3 row-major, its columns the world directions (unit vectors) of the index axes i, j, k; of any
            handedness, and at any angles to each other but in a plane.
        name: short name for reports.
        slope, intercept: stored-value scaling (NIfTI, DICOM), slope finite and not 0.
        space: anatomical space that direction and origin are in, "RAS" or "LPS", None where there is none.
        hounsfield: whether the file says that data values are Hounsfield units.
        modality: as DICOM abbreviates it, "CT", "MR", "NM" or "US"; "" unknown.
        reference: UID of DICOM's frame of reference: positions of two volumes compare where it is the same.
        quantity: what the values are, as the file calls them ("temperature"); "" unknown.
        preset: name of the function that shows such values (smoke, fire), or `DENSITY` of a map (MRC, CCP4, cube,
            OpenDX), which is shown by standard deviations; "" unknown.
        value_unit: unit of the values; "" unknown.
        time: time that the values are of, and its unit, which may be ""; None unknown.
        unit: of lengths in the world where there is no anatomical space, whose unit is mm: "um", "m", ...; "" unknown.
        segments: what the file says of its labels, if it says that values are labels; else None.

    Raises:
        DataError: wrong rank, empty axis, dtype that is not real, spacing not finite and positive, axes in a plane.
    """

    data: np.ndarray
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)
    direction: tuple[float, ...] = IDENTITY
    name: str = "volume"
    slope: float = 1.0
    intercept: float = 0.0
    space: str | None = None
    hounsfield: bool = False
    reference: str | None = None
    unit: str = ""
    modality: str = ""
    quantity: str = ""
    preset: str = ""
    value_unit: str = ""
    time: tuple[float, str] | None = None
    segments: tuple[Segment, ...] | None = None

    def __post_init__(self) -> None:
        """Check the attributes."""
        if self.data.ndim != 3 or min(self.data.shape) < 1:
            raise DataError(f"{self.name}: array of shape {self.data.shape}; expected three axes (z, y, x), none empty")
        if self.data.dtype.kind not in "iufb":
            raise DataError(f"{self.name}: values of type {self.data.dtype}; expected integers or floats")
        if len(self.spacing) != 3 or not all(math.isfinite(s) and s > 0 for s in self.spacing):
            raise DataError(
                f"{self.name}: spacing {self.spacing}; expected three positive numbers (try --spacing X Y Z)"
            )
        if not (math.isfinite(self.slope) and self.slope != 0 and math.isfinite(self.intercept)):
            raise DataError(
                f"{self.name}: value scaling {self.slope} * stored + {self.intercept}; expected finite, slope not 0"
            )
        place = np.array([*self.direction, *self.origin], dtype=np.float64)
        if place.shape != (12,) or not np.isfinite(place).all() or abs(np.linalg.det(self.axes)) < FLAT:
            raise DataError(
                f"{self.name}: direction {self.direction}, origin {self.origin}; expected finite numbers and axes that "
                "do not lie in a plane"
            )

    @property
    def dims(self) -> tuple[int, int, int]:
        """Voxels along (x, y, z)."""
        nz, ny, nx = self.data.shape
        return nx, ny, nz

    @property
    def values_in(self) -> str:
        """Unit of the values, "" if unknown."""
        return "HU" if self.hounsfield else self.value_unit

    @property
    def extent(self) -> tuple[float, float, float]:
        """Edges of the box (x, y, z) in world units; it reaches half a voxel beyond the outer centres."""
        (nx, ny, nz), (x, y, z) = self.dims, self.spacing
        return nx * x, ny * y, nz * z

    @property
    def axes(self) -> np.ndarray:
        """(3, 3) float64, columns: world directions of the index axes; takes the box frame to the unit frame."""
        return np.array(self.direction, dtype=np.float64).reshape(3, 3)

    @property
    def affine(self) -> np.ndarray:
        """(4, 4) float64: (i, j, k, 1) of a voxel centre to its world position."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.axes * np.array(self.spacing)
        matrix[:3, 3] = self.origin
        return matrix

    def on_grid(self, other: Volume) -> bool:
        """Return whether the voxels of two volumes lie at the same places, to `ALIKE` voxels."""
        ends = [[0, 0, 0, 1], [*self.dims, 1], [self.dims[0], 0, 0, 1], [0, self.dims[1], 0, 1]]
        off = (np.array(ends, np.float64) @ (self.affine - other.affine).T)[:, :3]
        return self.dims == other.dims and bool(np.abs(off).max() <= ALIKE * min(other.spacing))

    def check_grid(self, own: str, first: Volume, name: str, why: str) -> None:
        """Raise DataError unless this volume, called ``own``, has the grid of ``first``, called ``name``."""
        if self.space == first.space and self.on_grid(first):
            return
        texts = [
            " x ".join(map(str, one.dims)) + " voxels of {} from {} along {}".format(
                *(" ".join(f"{v:g}" for v in vector) for vector in (one.spacing, one.origin, one.direction))
            ) for one in (self, first)
        ]  # fmt: skip
        raise DataError(f"{own}: {texts[0]}; expected the grid of {name}, {texts[1]}: {why}")

    @property
    def sheared(self) -> bool:
        """Whether the index axes are not at right angles (a tilted gantry)."""
        axes = self.axes
        return bool(np.abs(axes.T @ axes - np.eye(3)).max() > RIGHT)

    def unit_frame(self) -> UnitFrame:
        """Return the frame that cameras and Gaussians of a run live in (conventions: Space)."""
        extent = self.extent
        scale = 2.0 / max(extent)
        half = triple(e * scale / 2 for e in extent)
        step = triple(s * scale for s in self.spacing)
        middle = [(n - 1) * s / 2 for n, s in zip(self.dims, self.spacing, strict=True)]
        rows = (self.direction[3 * r : 3 * r + 3] for r in range(3))
        centre = triple(
            o + sum(d * m for d, m in zip(row, middle, strict=True)) for o, row in zip(self.origin, rows, strict=True)
        )
        return UnitFrame(scale, half, step, centre)
