"""Writing a volume as NRRD: one attached raw file, which ParaView, 3D Slicer and this program read."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from vvgt_cli.files import atomic_write
from vvgt_cli.volume.types import Volume


def write_nrrd(path: str | os.PathLike[str], volume: Volume, overwrite: bool = False) -> int:
    """Write the volume's data values as float32; Returns the file's bytes.

    Raises:
        UsageError, DataError: see `vvgt_cli.files.atomic_write`.
    """
    values = np.ascontiguousarray(volume.data, "<f4") * np.float32(volume.slope) + np.float32(volume.intercept)
    vectors = " ".join(
        f"({','.join(repr(v) if v else '0' for v in axis)})" for axis in volume.affine[:3, :3].T.tolist()
    )
    space = {"RAS": "right-anterior-superior", "LPS": "left-posterior-superior"}.get(volume.space or "")
    header = [
        "NRRD0004",
        "type: float",
        "dimension: 3",
        f"space: {space}" if space else "space dimension: 3",
        f"sizes: {' '.join(map(str, volume.dims))}",
        f"space directions: {vectors}",
        f"space origin: ({','.join(repr(float(o)) for o in volume.origin)})",
        "endian: little",
        "encoding: raw",
    ]
    with atomic_write(path, overwrite) as temporary:
        temporary.write_bytes(("\n".join(header) + "\n\n").encode() + values.astype("<f4", copy=False).tobytes())
    return Path(path).stat().st_size
