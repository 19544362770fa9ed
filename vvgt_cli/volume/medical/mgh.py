"""FreeSurfer's MGH (``.mgh``, memory-mapped) and MGZ (``.mgz``, gzip).

Format: https://surfer.nmr.mgh.harvard.edu/fswiki/FsTutorial/MghFormat; all numbers are big-endian.
"""

from __future__ import annotations

import gzip
import io
import math
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import read_head
from vvgt_cli.volume.medical import MGH_HEADER, MGH_TYPES, is_mgh
from vvgt_cli.volume.medical.nifti import Frames, load_frames
from vvgt_cli.volume.reading import FLAT, MAX_HEADER, ReadOptions, Segment, Volume, placed, segments_in, volume_name

DATA = 284  # where values begin
COLOR_TABLE = struct.pack(">ii", 1, -2)  # behind them: the tag of a colour table, and its version
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
    volume = placed(field, axes, origin, options, volume_name(path), space="RAS")
    behind = DATA + math.prod(sizes) * frames.dtype.itemsize
    try:
        with (gzip.open if encoding == "gzip" else open)(path, "rb") as file:
            file.seek(behind)
            table = file.read(MAX_HEADER).partition(COLOR_TABLE)[2]
    except (OSError, EOFError, zlib.error):  # the values are there
        table = b""
    return replace(volume, segments=segments_in(lambda: table_entries(table), str(path))) if table else volume


def table_entries(content: bytes) -> list[Segment]:
    """Return the entries of a colour table of version 2 (colortab.cpp: CTABreadFromBinaryV2); T is transparency."""
    table = io.BytesIO(content)

    def number() -> int:
        return int(struct.unpack(">i", table.read(4))[0])

    def text() -> str:
        return table.read(number()).split(b"\0")[0].decode("utf-8", "replace")

    _, _, entries = number(), text(), list[Segment]()  # entries that there may be, file that they come from
    for _ in range(number()):
        label, name, *color = number(), text(), number(), number(), number(), number()
        red, green, blue, clear = (value / 255 for value in color)
        entries.append(Segment(label, name, (red, green, blue), opacity=1 - clear if label else 0.0))
    return entries
