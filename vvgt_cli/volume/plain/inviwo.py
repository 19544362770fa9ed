"""Inviwo (and Voreen) ``.dat`` headers beside a raw file, memory-mapped.

Fields as Inviwo's DatVolumeSequenceReader reads them.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import data_file, load_block
from vvgt_cli.volume.components import select_component
from vvgt_cli.volume.headers import MAX_HEADER, Fields, unit_rows
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import volume_name
from vvgt_cli.volume.types import IDENTITY, Volume

_FORMAT = re.compile(r"(?:vec([234]))?(u?int|float)(8|16|32|64)")
# Names of Voreen and of old Inviwo files.
_ALIASES = {
    "char": "int8",
    "uchar": "uint8",
    "short": "int16",
    "ushort": "uint16",
    "ushort_12": "uint16",
    "int": "int32",
    "uint": "uint32",
    "float": "float32",
    "double": "float64",
}


def _fields(path: Path) -> Fields:
    with open(path, "rb") as file:
        text = file.read(MAX_HEADER).decode("utf-8-sig", "replace")
    fields = Fields(path.name)
    for line in text.splitlines():
        key, colon, value = line.split("#")[0].partition(":")
        if colon and not key.startswith("/"):
            fields[key.strip().lower()] = value.strip()
    return fields


def _format(fields: Fields) -> tuple[np.dtype, int]:
    text = fields.need("format").lower()
    match = _FORMAT.fullmatch(_ALIASES.get(text, text))
    if match is None or match[2] + match[3] == "float8":
        raise DataError(f"{fields.name}: Format {fields['format']!r}; expected as UINT8, FLOAT32 or Vec3FLOAT32")
    big = fields.get("byteorder", "").lower() == "bigendian"
    return np.dtype(match[2] + match[3]).newbyteorder(">" if big else "<"), int(match[1] or 1)


def _scaling(fields: Fields) -> tuple[float, float]:
    """Slope and intercept that take DataRange to ValueRange (both must be there)."""
    if not fields.get("datarange") or not fields.get("valuerange"):
        return 1.0, 0.0
    d0, d1 = fields.floats("DataRange", fields["datarange"], 2)
    v0, v1 = fields.floats("ValueRange", fields["valuerange"], 2)
    if (d0, d1) == (v0, v1) or d0 == d1:
        return 1.0, 0.0
    slope = (v1 - v0) / (d1 - d0)
    return slope, v0 - slope * d0


def _geometry(fields: Fields, dims: list[int]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Spacing (x, y, z) and direction (row-major).

    Basis vectors are rows of the matrix whose columns span the whole box: so Inviwo's DatVolumeSequenceReader takes
    them and its DatVolumeWriter writes them.
    """
    keys = ("basisvector1", "basisvector2", "basisvector3")
    if all(fields.get(k) for k in keys):
        rows = [fields.floats(k, fields[k], 3) for k in keys]
        lengths, direction = unit_rows([list(column) for column in zip(*rows, strict=True)])
        return tuple(length / n for length, n in zip(lengths, dims, strict=True)), direction
    for key in ("spacing", "slicethickness"):
        if fields.get(key):
            return tuple(fields.floats(key, fields[key], 3)), IDENTITY
    return (1.0, 1.0, 1.0), IDENTITY


def _origin(fields: Fields, dims: list[int], spacing: tuple[float, ...], direction: tuple[float, ...]) -> np.ndarray:
    """(3,) centre of the first voxel: Offset is the corner of the box, which is centred without one."""
    steps = np.array(direction).reshape(3, 3) * spacing
    if fields.get("offset"):
        return np.array(fields.floats("Offset", fields["offset"], 3)) + steps @ (0.5, 0.5, 0.5)
    return steps @ (0.5 - np.array(dims) / 2) + 0.0


def read_inviwo(path: Path, options: ReadOptions) -> Volume:
    """Read the raw file that an Inviwo header describes; a sequence of several volumes needs ``component``.

    DataRange and ValueRange, where both are given, are the stored-value scaling. Without basis vectors or spacing
    voxels are unit cubes.

    Raises:
        DataError: a header that is incomplete or does not fit the data, a data file outside the header's folder.
        UsageError: several components or volumes and none chosen.
    """
    fields = _fields(path)
    dims = fields.sizes("Resolution", fields.need("resolution", "dimensions", "dimension"))
    if len(dims) != 3:
        raise DataError(f"{path}: Resolution {dims}; expected three numbers")
    dtype, channels = _format(fields)
    steps, offset = fields.integer("sequences", 1), fields.integer("byteoffset", 0)
    if steps < 1 or offset < 0:
        raise DataError(f"{path}: Sequences {steps}, ByteOffset {offset}; expected at least 1, and 0 or more")
    source = data_file(path, fields.need("rawfile", "objectfilename"))
    block = load_block(source, dtype, (steps, *reversed(dims), channels), offset=offset)
    block = np.moveaxis(block, 0, -1).reshape(*reversed(dims), -1) if steps > 1 else block[0]
    field, (slope, intercept) = select_component(block, options.component, str(path), scaling=_scaling(fields))
    spacing, direction = _geometry(fields, dims)
    spacing = options.spacing_or(spacing)
    origin = tuple(_origin(fields, dims, spacing, direction).tolist())
    return Volume(
        field,
        spacing,
        origin,
        direction,
        volume_name(path),
        slope,
        intercept,
    )
