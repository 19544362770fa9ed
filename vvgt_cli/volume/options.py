"""`ReadOptions`: how to read a volume, where its file does not say or a caller wants something else."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from vvgt_cli.errors import SeveralSteps, UsageError
from vvgt_cli.volume.cut import parse_crop
from vvgt_cli.volume.headers import DTYPES, type_of
from vvgt_cli.volume.types import Volume


@dataclass(frozen=True)
class ReadOptions:
    """How to read a volume; every field left at ``None`` (or 0) means "as the file says".

    Attributes:
        dims: voxels along (x, y, z) of a raw file, or of the grid that a mesh is resampled to.
        dtype: type of a raw file's values, as ``uint16`` or ``ushort`` (`vvgt_cli.volume.headers.type_of`).
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
        keep_largest: data value; of what lies above, all but the largest connected body is hidden.
        packed: values are read front to back only, so that compressed ones may stay in the file
            (`vvgt_cli.volume.blocks.Packed`).
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
    keep_largest: float | None = None
    packed: bool = False
    stored: bool = False
    level: int | None = None

    def __post_init__(self) -> None:
        """Check the values one by one."""
        if self.dtype is not None:
            parse_dtype(self.dtype)
        if self.crop is not None:
            parse_crop(self.crop)
        dims, edges, part = self.dims, self.spacing, self.component
        positive = edges is None or (len(edges) == 3 and all(math.isfinite(s) and s > 0 for s in edges))
        for flag, value, good, expected in (
            ("dims", dims, dims is None or (len(dims) == 3 and min(dims) >= 1),
             "three whole numbers of at least 1, as --dims 256 256 128"),
            ("byte-order", self.byte_order, self.byte_order in (None, "little", "big"), "little or big"),
            ("header-bytes", self.header_bytes, self.header_bytes >= 0, "0 or more"),
            ("spacing", edges, positive, "three positive numbers, as --spacing 1 1 2.5"),
            ("space", self.space, self.space in (None, "RAS", "LPS"), "RAS or LPS"),
            ("component", part, part != "" and not (isinstance(part, int) and part < 0),
             "an index (0, 1, ...), a channel's name or magnitude"),
            ("keep-largest", self.keep_largest, math.isfinite(self.keep_largest or 0), "a finite data value"),
            ("level", self.level, (self.level or 0) >= 0, "full, or the number of a level (0, 1, ...)"),
            ("time", self.time, (self.time or 0) >= 0, "the index of a time step (0, 1, ...)"),
        ):  # fmt: skip
            if not good:
                raise UsageError(f"--{flag} {value}: expected {expected}")

    @property
    def raw_flags(self) -> list[str]:
        """Flags in use that describe the layout of a raw file."""
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
            what: the steps are called.
            **facts: ``times``, ``unit`` and ``names`` for `SeveralSteps`.

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
        """Return the spacing that is asked for, else the file's (x, y, z) without signs, which are orientation."""
        if self.spacing is not None:
            return self.spacing
        return tuple(abs(float(s)) for s in declared)  # type: ignore[return-value]  # `Volume` counts them


def parse_dtype(name: str, byte_order: str | None = None) -> np.dtype:
    """Return the numpy type for a name of `DTYPES`, or for its name in C; little-endian by default.

    Raises:
        UsageError: unknown name.
    """
    found = type_of(name)
    if found is None:
        raise UsageError(f"--dtype {name}: expected one of {', '.join(DTYPES)}")
    return found.newbyteorder(">" if byte_order == "big" else "<")
