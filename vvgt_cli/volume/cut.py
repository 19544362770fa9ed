"""Parts of a volume: a box of voxels, and what a mask keeps. Voxels stay where they are in the world."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.stored import Stored, chunks_of, read_block
from vvgt_cli.volume.types import Volume, float_dtype

Box = tuple[tuple[int | None, int | None], ...]


def parse_crop(text: str) -> Box:
    """Parse ``x0:x1,y0:y1,z0:z1`` in voxels; omitted ends are open, the last voxel is excluded.

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
    """Cut the voxels in a box (x, y, z) out; its ends may lie beyond the volume's last voxel.

    Raises:
        UsageError: no voxel of the volume is in it.
    """
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
        found, wanted = (" x ".join(map(str, v.dims)) for v in (mask, volume))
        raise DataError(
            f"--mask {mask.name}: {found} voxels; expected the {wanted} of {volume.name}: resample it onto that grid"
        )
    kind = float_dtype(volume.data.dtype)

    def block(slices: tuple[slice, ...]) -> np.ndarray:
        z, y, x = slices
        lo, hi = np.array([x.start, y.start, z.start]), np.array([x.stop, y.stop, z.stop])
        with np.errstate(invalid="ignore"):
            value = mask.slope * read_block(mask, lo, hi).astype(np.float64) + mask.intercept
            return np.where(np.isfinite(value) & (value != 0), read_block(volume, lo, hi), np.nan).astype(kind)

    if stored:
        lazy: Any = Stored(block, kind, volume.data.shape, chunks_of(volume), volume.name)
        return replace(volume, data=lazy)
    out = np.empty(volume.data.shape, kind)
    nx, ny, nz = volume.dims
    for z in range(nz):
        out[z : z + 1] = block((slice(z, z + 1), slice(0, ny), slice(0, nx)))
    if np.isnan(out).all():
        raise DataError(f"--mask {mask.name}: all of it is 0; expected some voxels that are not, to keep")
    return replace(volume, data=out)
