"""Parts of a volume: a box of voxels, and what a mask keeps. Voxels stay where they are in the world."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.types import Volume

Box = tuple[tuple[int | None, int | None], ...]


def parse_crop(text: str) -> Box:
    """``x0:x1,y0:y1,z0:z1`` in voxels, ends open where they are left out, the last one excluded.

    Raises:
        UsageError: anything else.
    """
    parts = [re.fullmatch(r"\s*(\d*)\s*:\s*(\d*)\s*", part) for part in text.split(",")]
    if len(parts) != 3 or None in parts:
        raise UsageError(f"--crop {text}: expected x0:x1,y0:y1,z0:z1 in voxels, as 10:200,:,:64")
    box = tuple((int(p[1]) if p[1] else None, int(p[2]) if p[2] else None) for p in parts if p)
    if any(a is not None and b is not None and a >= b for a, b in box):
        raise UsageError(f"--crop {text}: an axis ends where it begins, or before; expected x0 below x1")
    return box


def crop(volume: Volume, box: Box) -> Volume:
    """The voxels in a box (x, y, z); its ends may lie beyond the volume's last voxel.

    Raises:
        UsageError: no voxel of the volume is in it.
    """
    first = [a or 0 for a, _ in box]
    if any(a >= n for a, n in zip(first, volume.dims, strict=True)):
        dims = " x ".join(map(str, volume.dims))
        raise UsageError(f"--crop from {first} on: nothing of {volume.name}, which has {dims} voxels, is in it")
    index = tuple(slice(a, b) for a, b in reversed(box))
    origin = tuple((volume.affine @ [*first, 1.0])[:3].tolist())
    return replace(volume, data=volume.data[index], origin=origin)


def masked(volume: Volume, mask: Volume) -> Volume:
    """The volume with NaN where a mask is 0 or not finite; of integers as float32 or float64, which hold them exactly.

    Raises:
        DataError: a mask of another size, or one that keeps nothing.
    """
    if mask.dims != volume.dims:
        found, wanted = (" x ".join(map(str, v.dims)) for v in (mask, volume))
        raise DataError(
            f"--mask {mask.name}: {found} voxels; expected the {wanted} of {volume.name}: resample it onto that grid"
        )
    small = volume.data.dtype.itemsize <= (4 if volume.data.dtype.kind == "f" else 2)
    out = np.empty(volume.data.shape, np.float32 if small else np.float64)
    any_left = False
    for z in range(len(out)):
        with np.errstate(invalid="ignore"):
            value = mask.slope * mask.data[z].astype(np.float64) + mask.intercept
            keep = np.isfinite(value) & (value != 0)
        any_left = any_left or bool(keep.any())
        out[z] = np.where(keep, volume.data[z], np.nan)
    if not any_left:
        raise DataError(f"--mask {mask.name}: all of it is 0; expected some voxels that are not, to keep")
    return replace(volume, data=out)
