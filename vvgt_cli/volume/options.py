"""`ReadOptions`: what a caller may say about a volume beyond its file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from vvgt_cli.errors import SeveralSteps, UsageError
from vvgt_cli.volume.cut import parse_crop
from vvgt_cli.volume.types import Volume

DTYPES = (
    "int8",
    "uint8",
    "int16",
    "uint16",
    "int32",
    "uint32",
    "int64",
    "uint64",
    "float16",
    "float32",
    "float64",
)
_ALIASES = {
    "char": "int8",
    "uchar": "uint8",
    "byte": "uint8",
    "short": "int16",
    "ushort": "uint16",
    "int": "int32",
    "uint": "uint32",
    "half": "float16",
    "float": "float32",
    "double": "float64",
}


@dataclass(frozen=True)
class ReadOptions:
    """How to read a volume; every field left at ``None`` (or 0) means "as the file says".

    Attributes:
        dims: voxels along (x, y, z) of a raw file, or of the grid that a mesh is resampled to.
        dtype: a name of `DTYPES` (or a C-like alias such as ``ushort``) for a raw file.
        byte_order: ``little`` or ``big`` for a raw file (default little).
        header_bytes: bytes to skip at the start of a raw file.
        spacing: voxel edges (x, y, z) along the index axes, in the file's unit, in place of the file's; the first
            voxel and the directions stay. Not of values that stand at points (meshes).
        array: name of the array (path of a dataset, series of a DICOM folder), for formats that hold several.
        component: index of a component or channel, the name of a channel, or ``magnitude``, for arrays that have
            several.
        time: index of the time step, for files that hold several.
        space: anatomical space to bring the volume to, ``RAS`` or ``LPS``; None: RAS where its file states one.
        crop: ``x0:x1,y0:y1,z0:z1``, the voxels to keep, as `vvgt_cli.volume.cut.parse_crop` has it.
        mask: file or `Volume` of the same size (before or after ``crop``); where it is 0 nothing is shown.
        packed: values are read front to back only: where they are compressed and a format can, they stay so
            (`vvgt_cli.volume.packed`).
        stored: values are read block by block: formats that can leave them in the file (`vvgt_cli.volume.stored`).
        level: of a file with several resolutions (OME-Zarr), from 0, the finest.

    Raises:
        UsageError: a value out of its range.
    """

    dims: tuple[int, int, int] | None = None
    dtype: str | None = None
    byte_order: str | None = None
    header_bytes: int = 0
    spacing: tuple[float, float, float] | None = None
    array: str | None = None
    component: int | str | None = None
    time: int | None = None
    space: str | None = None
    crop: str | None = None
    mask: str | Volume | None = None
    packed: bool = False
    stored: bool = False
    level: int | None = None

    def __post_init__(self) -> None:
        if self.dims is not None and (len(self.dims) != 3 or min(self.dims) < 1):
            raise UsageError(f"--dims {self.dims}: expected three whole numbers of at least 1, as --dims 256 256 128")
        if self.dtype is not None:
            parse_dtype(self.dtype)
        if self.byte_order not in (None, "little", "big"):
            raise UsageError(f"--byte-order {self.byte_order}: expected little or big")
        if self.header_bytes < 0:
            raise UsageError(f"--header-bytes {self.header_bytes}: expected 0 or more")
        if self.spacing is not None and not (
            len(self.spacing) == 3 and all(math.isfinite(s) and s > 0 for s in self.spacing)
        ):
            raise UsageError(f"--spacing {self.spacing}: expected three positive numbers, as --spacing 1 1 2.5")
        if self.space not in (None, "RAS", "LPS"):
            raise UsageError(f"--space {self.space}: expected RAS or LPS")
        component = self.component
        if component == "" or (isinstance(component, int) and component < 0):
            raise UsageError(f"--component {component}: expected an index (0, 1, ...), a channel's name or magnitude")
        if self.crop is not None:
            parse_crop(self.crop)
        if self.level is not None and self.level < 0:
            raise UsageError(f"--level {self.level}: expected full, or the number of a level (0, 1, ...)")
        if self.time is not None and self.time < 0:
            raise UsageError(f"--time {self.time}: expected the index of a time step (0, 1, ...)")

    @property
    def raw_flags(self) -> list[str]:
        """The flags in use that only a raw file takes."""
        given = {
            "--dims": self.dims is not None,
            "--dtype": self.dtype is not None,
            "--byte-order": self.byte_order is not None,
            "--header-bytes": self.header_bytes != 0,
        }
        return [flag for flag, used in given.items() if used]

    def step(self, steps: int, source: str, what: str = "time steps", **facts: Any) -> int:
        """Return the time step asked for, or the only one of ``steps``.

        Args:
            steps: how many there are.
            source: for messages.
            what: they are called.
            **facts: ``times``, ``unit`` and ``names``, as of `SeveralSteps`.

        Raises:
            SeveralSteps: several and none chosen.
            UsageError: none such.
        """
        if self.time is None and steps > 1:
            raise SeveralSteps(source, steps, what, **facts)
        if (self.time or 0) >= steps:
            one = "it has 1 time step; leave out --time"
            expected = f"expected a time step from 0 to {steps - 1}" if steps > 1 else one
            raise UsageError(f"{source}: --time {self.time}: {expected}")
        return self.time or 0

    def spacing_or(self, declared: tuple[float, ...]) -> tuple[float, float, float]:
        """The spacing asked for, else the file's (x, y, z): signs are orientation and dropped."""
        if self.spacing is not None:
            return self.spacing
        return tuple(abs(float(s)) for s in declared)  # type: ignore[return-value]  # `Volume` counts them


def parse_dtype(name: str, byte_order: str | None = None) -> np.dtype:
    """numpy dtype for a name of `DTYPES` or an alias; little-endian unless told.

    Raises:
        UsageError: unknown name.
    """
    key = _ALIASES.get(name.strip().lower(), name.strip().lower())
    if key not in DTYPES:
        raise UsageError(f"--dtype {name}: expected one of {', '.join(DTYPES)}")
    return np.dtype(key).newbyteorder(">" if byte_order == "big" else "<")
