"""VolVis ``.slc``: 8-bit volumes, plain (memory-mapped) or run-length coded plane by plane.

Layout as vtkSLCReader reads it; decoded here because VTK's decoder trusts the runs and writes past its buffer when
they lie.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.reading import ReadOptions, Volume, check_memory, load_block, select_component, volume_name
from vvgt_cli.volume.space import one_unit

# magic, sizes, bits, spacing, unit, data origin, modification, coding, icon size
_HEADER = re.compile(rb"\s*11111" + rb"\s+(\d+)" * 4 + rb"\s+(\S+)" * 3 + rb"\s+(\d+)" * 6 + rb" X")
_UNITS = {b"0": "m", b"1": "mm", b"2": "um", b"3": "foot", b"4": "inch"}  # VolVis' C_UnitType
_PLANE = re.compile(rb"\s*(\d{1,12}) X")


def read_slc(path: Path, options: ReadOptions) -> Volume:
    """Read an SLC file; raise DataError if it is none, not 8-bit, or has planes that do not fit the file."""
    with open(path, "rb") as file:
        match = _HEADER.match(file.read(4096))
    if match is None:
        raise DataError(f"{path}: no SLC header (11111, sizes, bits, spacing ... icon size, X)")
    nx, ny, nz, bits, *_ = (int(match[k]) for k in range(1, 5))
    if bits != 8 or min(nx, ny, nz) < 1:
        raise DataError(f"{path}: {nx} x {ny} x {nz} voxels of {bits} bits; expected 8 bits and at least 1 voxel")
    spacing = options.spacing_or(tuple(float(match[k]) for k in (5, 6, 7)))
    _, unit = one_unit([_UNITS.get(match[8], f"code {int(match[8])}")], str(path), True)
    coding, icon = int(match[11]), 3 * int(match[12]) * int(match[13])
    start = match.end() + icon
    if coding == 0:
        data = load_block(path, np.dtype("u1"), (nz, ny, nx), offset=start)
    elif coding == 1:
        data = _decode(path, (nz, ny, nx), start)
    else:
        raise DataError(f"{path}: SLC coding {coding}; expected 0 (plain) or 1 (run lengths)")
    field, _ = select_component(data[..., None], options.component, str(path))
    return Volume(field, spacing, name=volume_name(path), unit=unit)


def _decode(path: Path, shape: tuple[int, int, int], start: int) -> np.ndarray:
    nz, ny, nx = shape
    size = path.stat().st_size
    # A run of two bytes makes 127 voxels at most.
    if nz * ny * nx > 64 * max(size - start, 0):
        raise DataError(f"{path}: {size} bytes cannot hold {nx} x {ny} x {nz} run-length coded voxels")
    check_memory(nz * ny * nx + size, str(path))
    from vvgt_cli.volume.plain.run_lengths import decode_runs

    packed = np.fromfile(path, np.uint8)
    out = np.zeros((nz, ny * nx), np.uint8)
    for z in range(nz):
        match = _PLANE.match(packed[start : start + 32].tobytes())
        if match is None:
            raise DataError(f"{path}: plane {z} of {nz} has no size where one is expected; check that it is whole")
        begin = start + match.end()
        start = begin + int(match[1])
        filled = decode_runs(packed[begin:start], out[z]) if start <= size else -1
        # Some writers leave the last voxel of every plane out; it stays 0.
        if filled < ny * nx - 1:
            raise DataError(f"{path}: plane {z} of {nz} is damaged or cut short; expected {nx} x {ny} voxels")
    return out.reshape(shape)
