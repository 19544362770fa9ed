"""FreeSurfer's MGH (``.mgh``, memory-mapped) and MGZ (``.mgz``, gzip).

Format: https://surfer.nmr.mgh.harvard.edu/fswiki/FsTutorial/MghFormat; all numbers are big-endian.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import read_head
from vvgt_cli.volume.medical import MGH_HEADER, MGH_TYPES, is_mgh
from vvgt_cli.volume.medical.nifti import Frames, load_frames
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import volume_name
from vvgt_cli.volume.space import placed
from vvgt_cli.volume.types import FLAT, Volume

DATA = 284  # where values begin
# without "good RAS": steps of 1 mm on the coronal slices of FreeSurfer's own volumes
_CORONAL = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def read_mgh(path: Path, options: ReadOptions) -> Volume:
    """Read an MGH or MGZ file; the former is memory-mapped. Frames are time steps."""
    head, encoding = read_head(path, MGH_HEADER)
    if not is_mgh(head):
        raise DataError(f"{path}: no header of an MGH file (version 1, sizes above 0, a type that is known)")
    _, *sizes, kind = struct.unpack_from(">6i", head)
    numbers = struct.unpack_from(">15f", head, 30)
    axes, centre = _CORONAL, np.zeros(3)
    if head[28:30] == b"\0\1" and all(map(math.isfinite, numbers)):
        rows = np.reshape(numbers[3:12], (3, 3))  # where x, y and z run
        if abs(np.linalg.det(rows)) > FLAT:
            axes, centre = rows * np.reshape(numbers[:3], (3, 1)), np.array(numbers[12:])
    origin = centre - np.array(sizes[:3]) / 2 @ axes
    frames = Frames(path, np.dtype(">" + MGH_TYPES[kind]), tuple(sizes), DATA, encoding)
    field, _ = load_frames(frames, options, str(path))
    return placed(field, axes, origin, options, volume_name(path), space="RAS")
