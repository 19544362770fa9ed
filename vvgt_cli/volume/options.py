"""Options of reading a volume, where its file does not say or a caller wants something else; crop and mask."""

from __future__ import annotations

import math
import operator
import re
from dataclasses import dataclass, replace
from typing import Any, SupportsIndex

import numpy as np

from vvgt_cli.errors import DataError, SeveralSteps, UsageError
from vvgt_cli.volume.headers import DTYPES, type_of
from vvgt_cli.volume.stored import Stored, chunks_of, read_block
from vvgt_cli.volume.types import Volume, float_dtype


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
            several; names and indices of several, as ``A,B``, are for `vvgt_cli.field.layered.open_content`.
        time: index of the time step, for files that hold several.
        space: anatomical space to bring the volume to, ``RAS`` or ``LPS``; None: RAS where its file states one.
        crop: ``x0:x1,y0:y1,z0:z1``, the voxels to keep, as `parse_crop` has it.
        mask: file or `Volume` of the same size (before or after ``crop``); where it is 0 nothing is shown.
        keep_largest: data value; of what lies above, all but the largest connected body is hidden.
        packed: values are read front to back only, so that compressed ones may stay in the file
            (`vvgt_cli.volume.blocks.Packed`).
        stored: values are read block by block: formats that can leave them in the file (`vvgt_cli.volume.stored`).
        level: of a file with several resolutions (OME-Zarr), from 0, the finest.
        suv: of DICOM PET, ``bw`` for SUV by body weight or an error, ``none`` for values as they are; None: SUV where
            the file states enough.

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
    suv: str | None = None

    def __post_init__(self) -> None:
        """Check the values one by one."""
        if self.dtype is not None:
            parse_dtype(self.dtype)
        if self.crop is not None:
            parse_crop(self.crop)
        if isinstance(self.component, SupportsIndex):  # numpy's whole numbers too
            object.__setattr__(self, "component", operator.index(self.component))
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
            ("suv", self.suv, self.suv in (None, "bw", "none"), "bw or none"),
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

        ``what`` the steps are called, and the ``facts`` times, unit and names, are for `SeveralSteps`.

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
    """Return the type of a name of `DTYPES` or of C, by default little-endian; raise UsageError for others."""
    kind = type_of(name)
    if kind is None:
        raise UsageError(f"--dtype {name}: expected one of {', '.join(DTYPES)}")
    return kind.newbyteorder(">" if byte_order == "big" else "<")


Box = tuple[tuple[int | None, int | None], ...]


def parse_crop(text: str) -> Box:
    """Parse ``x0:x1,y0:y1,z0:z1`` in voxels, the last one excluded, omitted ends open; raise UsageError for others."""
    parts = [re.fullmatch(r"\s*(\d*)\s*:\s*(\d*)\s*", part) for part in text.split(",")]
    if len(parts) != 3 or None in parts:
        raise UsageError(f"--crop {text}: expected x0:x1,y0:y1,z0:z1 in voxels, as 10:200,:,:64")
    box = tuple((int(p[1]) if p[1] else None, int(p[2]) if p[2] else None) for p in parts if p)
    if any(a is not None and b is not None and a >= b for a, b in box):
        raise UsageError(f"--crop {text}: an axis ends where it begins, or before; expected x0 below x1")
    return box


def crop(volume: Volume, box: Box) -> Volume:
    """Cut out the voxels of a box (x, y, z), which may reach beyond the volume; raise UsageError if there are none."""
    first = [a or 0 for a, _ in box]
    if any(a >= n for a, n in zip(first, volume.dims, strict=True)):
        dims = " x ".join(map(str, volume.dims))
        raise UsageError(f"--crop from {first} on: nothing of {volume.name}, which has {dims} voxels, is in it")
    index = tuple(slice(a, b) for a, b in reversed(box))
    origin = tuple((volume.affine @ [*first, 1.0])[:3].tolist())
    data: Any = volume.data
    part: Any = data.part(index) if isinstance(data, Stored) else data[index]
    return replace(volume, data=part, origin=origin)


def masked(volume: Volume, mask: Volume, stored: bool = False) -> Volume:
    """Set voxels to NaN where a mask is 0 or not finite; integers become float32 or float64, which hold them exactly.

    Where it is ``stored``, that is done block by block.

    Raises:
        DataError: a mask of another size, or one that keeps nothing (of a stored one only its blocks know).
    """
    if mask.dims != volume.dims:
        given, wanted = (" x ".join(map(str, v.dims)) for v in (mask, volume))
        raise DataError(
            f"--mask {mask.name}: {given} voxels; expected the {wanted} of {volume.name}: resample it onto that grid"
        )
    kind = float_dtype(volume.data.dtype)

    def block(slices: tuple[slice, ...]) -> np.ndarray:
        z, y, x = slices
        lo, hi = np.array([x.start, y.start, z.start]), np.array([x.stop, y.stop, z.stop])
        with np.errstate(invalid="ignore"):
            value = mask.slope * read_block(mask, lo, hi).astype(np.float64) + mask.intercept
            return np.where(np.isfinite(value) & (value != 0), read_block(volume, lo, hi), np.nan).astype(kind)

    lazy: Any = Stored(block, kind, volume.data.shape, chunks_of(volume), volume.name)
    if stored:
        return replace(volume, data=lazy)
    out = np.empty(volume.data.shape, kind)
    for z in range(len(out)):
        out[z : z + 1] = lazy[z : z + 1]
    if np.isnan(out).all():
        raise DataError(f"--mask {mask.name}: all of it is 0; expected some voxels that are not, to keep")
    return replace(volume, data=out)
