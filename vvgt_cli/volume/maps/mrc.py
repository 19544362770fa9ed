"""MRC and CCP4 maps (``.mrc``, ``.map``, ``.ccp4``, ``.rec``, ``.st``), plain (memory-mapped), gzip or bzip2.

Lengths are in angstroms, as in the file. Format: MRC2014, https://www.ccpem.ac.uk/mrc_format/mrc2014.php; unsigned
bytes as IMOD marks them, https://bio3d.colorado.edu/imod/doc/mrc_format.txt.
"""

from __future__ import annotations

import math
import struct
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import load_block, read_head
from vvgt_cli.volume.maps import MRC_HEADER, MRC_STAMPS, is_mrc
from vvgt_cli.volume.medical.nifti import other_of_pair
from vvgt_cli.volume.medical.pairs import read_pair
from vvgt_cli.volume.reading import DENSITY, FLAT, ReadOptions, Volume, placed, select_component, volume_name

_DTYPES = {0: "i1", 1: "i2", 2: "f4", 6: "u2", 12: "f2"}
_OTHERS = {3: "complex integers", 4: "complex numbers", 101: "4-bit integers"}
IMOD, SIGNED = b"IMOD", 1  # its mark, and the flag that bytes are signed
STACKS = range(401, 631)  # space groups: several volumes, one behind the other
MAX_EXTRA = 1 << 30  # bytes of the extended header


@dataclass(frozen=True)
class Header:
    """The header of a map.

    Attributes:
        sizes: columns, rows and sections of a volume.
        dtype: of the values.
        offset: byte of the first value.
        volumes: how many there are, one behind the other.
        axes: axis of the cell that columns, rows and sections run along: 0 is x, 1 y, 2 z.
        steps: (3, 3) rows: vectors of a step along x, y and z of the cell, in angstroms.
        origin: (3,) centre of the first voxel in angstroms.
        stated: the header states the lengths of the steps.
    """

    sizes: tuple[int, int, int]
    dtype: np.dtype
    offset: int
    volumes: int
    axes: tuple[int, ...]
    steps: np.ndarray
    origin: np.ndarray
    stated: bool


def _order(head: bytes) -> str:
    """Return the byte order of the machine stamp, unless only the other one gives a mode and axes that exist."""
    first = MRC_STAMPS.get(head[212], "<")
    for order in (first, "<>".replace(first, "")):
        mode, axis = struct.unpack_from(order + "i", head, 12)[0], struct.unpack_from(order + "i", head, 64)[0]
        if (mode in _DTYPES or mode in _OTHERS) and 0 <= axis <= 3:
            return order
    return first


def parse_header(head: bytes, name: str) -> Header:
    """Parse the first 1024 bytes; raise DataError without such a header, or for values that are no real numbers."""
    if len(head) < MRC_HEADER:
        raise DataError(f"{name}: {len(head)} bytes; expected the {MRC_HEADER} of a header of an MRC or CCP4 map")
    order = _order(head)
    words = struct.unpack_from(order + "10i6f3i3f2i", head)
    sizes, mode, start, intervals, cell, angles = (words[a:b] for a, b in
                                                   ((0, 3), (3, 4), (4, 7), (7, 10), (10, 13), (13, 16)))  # fmt: skip
    group, extra = words[22:24]
    if min(sizes) < 1 or not 0 <= extra <= MAX_EXTRA:
        raise DataError(
            f"{name}: sizes {sizes}, {extra} bytes of extended header; expected an MRC or CCP4 map of at least 1 voxel "
            "along each axis"
        )
    if mode[0] not in _DTYPES:
        raise DataError(
            f"{name}: values of mode {mode[0]} ({_OTHERS.get(mode[0], 'unknown')}); expected mode 0, 1, 2, 6 or 12 "
            "(convert it to real numbers first)"
        )
    bare = mode[0] == 0 and head[152:156] in (IMOD, IMOD[::-1])
    unsigned = bare and not struct.unpack_from(order + "i", head, 156)[0] & SIGNED
    axes = tuple(a - 1 for a in words[16:19])
    axes = axes if sorted(axes) == [0, 1, 2] else (0, 1, 2)
    steps = _steps(intervals, cell, angles)
    origin = np.array(struct.unpack_from(order + "3f", head, 196), np.float64)
    if not np.isfinite(origin).all() or not origin.any():
        origin = np.array([start[axes.index(k)] for k in range(3)]) @ steps
    stack = group in STACKS and 0 < intervals[2] < sizes[2] and sizes[2] % intervals[2] == 0
    return Header(
        (*sizes[:2], intervals[2] if stack else sizes[2]),
        np.dtype(order + ("u1" if unsigned else _DTYPES[mode[0]])),
        MRC_HEADER + extra,
        sizes[2] // intervals[2] if stack else 1,
        axes,
        steps,
        origin,
        all(math.isfinite(c) and c > 0 for c in cell),
    )


def _steps(intervals: tuple[int, ...], cell: tuple[float, ...], angles: tuple[float, ...]) -> np.ndarray:
    """Return the vectors of a step along cell axes x, y, z, one a row; 1 angstrom long where the header states none.

    The cell's a lies along x and its b in the plane of x and y (International Tables for Crystallography B, 3.3.1).
    """
    lengths = [c / n if n > 0 and math.isfinite(c) and c > 0 else 1.0 for c, n in zip(cell, intervals, strict=True)]
    fits = all(math.isfinite(angle) and 0 < angle < 180 for angle in angles)
    a, b, c = (math.cos(math.radians(angle)) if fits and angle != 90 else 0.0 for angle in angles)
    sine = math.sqrt(1 - c * c)
    across = (a - b * c) / sine
    up = 1 - b * b - across * across
    if up <= FLAT**2:
        return np.diag(lengths)
    unit = np.array([[1.0, 0.0, 0.0], [c, sine, 0.0], [b, across, math.sqrt(up)]])
    return np.asarray(unit * np.array(lengths)[:, None])


def read_mrc(path: Path, options: ReadOptions) -> Volume:
    """Read an MRC or CCP4 map; one that is not compressed is memory-mapped. Volumes of a stack are time steps.

    MAPC, MAPR and MAPS say along which axes of the cell columns, rows and sections run; the cell and MX, MY, MZ say how
    far apart they are. The first voxel lies at ORIGIN where that is not 0, else at NXSTART, NYSTART, NZSTART steps.
    """
    head, encoding = read_head(path, MRC_HEADER)
    if path.suffix.lower() == ".rec" and not is_mrc(head) and other_of_pair(path, ".PAR"):
        return read_pair(path, options)
    header = parse_header(head, str(path))
    step = options.step(header.volumes, str(path))
    if not header.stated and options.spacing is None:
        warnings.warn(
            f"{path}: its header states no cell; its voxels are taken as 1 angstrom wide (--spacing X Y Z: otherwise)",
            stacklevel=2,
        )
    shape, dtype = header.sizes[::-1], header.dtype
    offset = header.offset + step * math.prod(shape) * dtype.itemsize
    block = load_block(path, dtype, shape, encoding=encoding, skip=offset, packed=options.packed)
    if options.component is not None:
        block = select_component(block[..., None], options.component, str(path), label="a map")[0]
    steps = [header.steps[a] for a in header.axes]
    return placed(block, steps, header.origin, options, volume_name(path), preset=DENSITY, unit="angstrom")
