"""Analyze 7.5 and SPM's variants of it: ``.hdr`` + ``.img`` without NIfTI's magic.

Format: dbh.h (Mayo Clinic); SPM's scale factor, offset and origin as spm_hread.m has them.
"""

from __future__ import annotations

import math
import struct
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.medical import byte_order, is_analyze
from vvgt_cli.volume.medical.frames import read_head
from vvgt_cli.volume.medical.nifti import DTYPES, Header, other_of_pair, read_parsed, scaling
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.types import Volume

HEADER = 348  # bytes
_SPM = {130: "i1", 132: "u2", 136: "u4"}


def read_analyze(path: Path, options: ReadOptions) -> Volume:
    """Read an Analyze pair by its ``.hdr`` or ``.img``; values are memory-mapped. Voxels lie in no anatomical space.

    A message says so, as the format does not store which side is left. SPM's scale factor, offset and origin are used.

    Raises:
        DataError: a header that is damaged or does not fit the data, or values that are no real numbers.
        UsageError: time steps (`SeveralSteps`), or several components, and none chosen.
    """
    if path.name.lower().endswith((".img", ".img.gz")):
        header = other_of_pair(path, ".hdr")
        if header is None:
            raise DataError(f"{path}: an image without its .hdr beside it; expected a pair, or raw values with --dims")
        from vvgt_cli.volume.registry import read_volume

        return read_volume(str(header), replace(options, crop=None, mask=None))  # which come later
    head, _ = read_head(path, HEADER)
    parsed, place = _parse(head, str(path))
    volume = read_parsed(parsed, path, False, options)
    warnings.warn(
        f"{path.name}: Analyze does not say which side is left; axes are taken as they are stored (a NIfTI file says)",
        stacklevel=2,
    )
    origin = tuple(-(at - 1) * step if at else 0.0 for at, step in zip(place, volume.spacing, strict=True))
    return replace(volume, origin=origin)


def _parse(head: bytes, name: str) -> tuple[Header, tuple[int, ...]]:
    """The header, and SPM's origin: the voxel at (0, 0, 0), counted from 1; 0 where there is none."""
    found = byte_order(head)
    if found is None or not is_analyze(head):
        raise DataError(f"{name}: no Analyze header ({HEADER} bytes that begin with their number)")
    order = found[0]
    dim, (code,) = struct.unpack_from(order + "8h", head, 40), struct.unpack_from(order + "h", head, 70)
    pixdim = struct.unpack_from(order + "8f", head, 76)
    offset, slope, intercept = struct.unpack_from(order + "3f", head, 108)
    sizes = dim[1 : dim[0] + 1]
    while len(sizes) > 3 and sizes[-1] == 0:  # some writers leave axes beyond the third at 0
        sizes = sizes[:-1]
    if min(sizes) < 1:
        raise DataError(f"{name}: dim {dim}; expected 1 to 7 axes of at least 1 voxel each")
    kinds = DTYPES | _SPM
    if code not in kinds:
        raise DataError(f"{name}: values of type {code}; expected real numbers (convert it to one channel first)")
    slope, intercept = scaling(slope, intercept, name)
    intercept = intercept if math.isfinite(intercept) else 0.0
    header = Header(sizes, np.dtype(order + kinds[code]), False, int(abs(offset)), slope, intercept, pixdim, None, None)
    return header, struct.unpack_from(order + "3h", head, 253)
