"""`Volume`: a scalar field on a regular grid, and the unit frame that every stage works in."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vvgt_cli.errors import DataError

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class UnitFrame:
    """Box-centred frame with longest edge 2: ``unit = (index_xyz + 0.5) * step - half``.

    Attributes:
        scale: unit-frame lengths per world length (1 / world unit).
        half: half extents of the box in the unit frame, (x, y, z).
        step: voxel edge in the unit frame, (x, y, z).
        centre: box centre in index axes x spacing + origin (world units), (x, y, z).
    """

    scale: float
    half: tuple[float, float, float]
    step: tuple[float, float, float]
    centre: tuple[float, float, float]


@dataclass(frozen=True)
class Volume:
    """A scalar volume.

    Attributes:
        data: (nz, ny, nx) stored values, x fastest on disk; may be memory-mapped, of any real dtype
            and byte order. The data value is ``slope * stored + intercept``.
        spacing: voxel edge (x, y, z) in world units, each > 0.
        origin: world position of the centre of voxel (0, 0, 0), (x, y, z).
        direction: 3 x 3 direction cosines, row-major; metadata only.
        name: short name for reports.
        slope, intercept: stored-value scaling (NIfTI, DICOM), slope finite and not 0.

    Raises:
        DataError: wrong rank, empty axis, dtype that is not real, spacing not finite and positive.
    """

    data: np.ndarray
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[float, ...] = IDENTITY
    name: str = "volume"
    slope: float = 1.0
    intercept: float = 0.0

    def __post_init__(self) -> None:
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

    @property
    def dims(self) -> tuple[int, int, int]:
        """Voxels along (x, y, z)."""
        nz, ny, nx = self.data.shape
        return nx, ny, nz

    @property
    def extent(self) -> tuple[float, float, float]:
        """Edges of the box (x, y, z) in world units; it reaches half a voxel beyond the outer centres."""
        return tuple(n * s for n, s in zip(self.dims, self.spacing, strict=True))  # type: ignore[return-value]

    def unit_frame(self) -> UnitFrame:
        """The frame that cameras and Gaussians live in (conventions: Space)."""
        extent = self.extent
        scale = 2.0 / max(extent)
        half = tuple(e * scale / 2 for e in extent)
        step = tuple(s * scale for s in self.spacing)
        centre = tuple(o + (n - 1) * s / 2 for o, n, s in zip(self.origin, self.dims, self.spacing, strict=True))
        return UnitFrame(scale, half, step, centre)  # type: ignore[arg-type]
