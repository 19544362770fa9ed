"""Inviwo (and Voreen) ``.dat`` headers beside a raw file, memory-mapped.

Fields as Inviwo's DatVolumeSequenceReader reads them.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import data_file, load_block
from vvgt_cli.volume.headers import MAX_HEADER, HeaderFields, printable, type_of
from vvgt_cli.volume.reading import ReadOptions, Volume, one_unit, placed, select_component, volume_name


def _fields(path: Path) -> HeaderFields:
    with open(path, "rb") as file:
        text = file.read(MAX_HEADER).decode("utf-8-sig", "replace")
    fields = HeaderFields(path.name)
    for line in text.splitlines():
        key, colon, value = line.split("#")[0].partition(":")
        if colon and not key.startswith("/"):
            fields[key.strip().lower()] = value.strip()
    return fields


def _format(fields: HeaderFields) -> tuple[np.dtype, int]:
    match = re.fullmatch(r"(?:vec([234]))?(\w+)", fields.need("format").lower())
    dtype = None if match is None else type_of(match[2], {"ushort12": "u2"})  # the last: Voreen's
    if match is None or dtype is None:
        raise DataError(f"{fields.name}: Format {fields['format']!r}; expected as UINT8, FLOAT32 or Vec3FLOAT32")
    big = fields.get("byteorder", "").lower().replace("-", "") == "bigendian"
    channels = {"la": 2, "rgb": 3, "rgba": 4}.get(fields.get("objectmodel", "").lower(), 1)  # Voreen's
    return dtype.newbyteorder(">" if big else "<"), int(match[1] or channels)


def _scaling(fields: HeaderFields) -> tuple[float, float]:
    """Return slope and intercept that take DataRange to ValueRange (both must be there)."""
    if not fields.get("datarange") or not fields.get("valuerange"):
        return 1.0, 0.0
    d0, d1 = fields.floats("DataRange", fields["datarange"], 2)
    v0, v1 = fields.floats("ValueRange", fields["valuerange"], 2)
    if (d0, d1) == (v0, v1) or d0 == d1:
        return 1.0, 0.0
    slope = (v1 - v0) / (d1 - d0)
    return slope, v0 - slope * d0


def _vectors(fields: HeaderFields, dims: list[int]) -> np.ndarray:
    """Return the vectors of a step along x, y and z, one a row.

    Basis vectors are rows of the matrix whose columns span the whole box: so Inviwo's DatVolumeSequenceReader takes
    them and its DatVolumeWriter writes them.
    """
    keys = ("basisvector1", "basisvector2", "basisvector3")
    if all(fields.get(k) for k in keys):
        return np.asarray(np.transpose([fields.floats(k, fields[k], 3) for k in keys]) / np.reshape(dims, (3, 1)))
    sizes = next((fields.floats(k, fields[k], 3) for k in ("spacing", "slicethickness") if fields.get(k)), [1.0] * 3)
    return np.diag(np.abs(sizes))


def read_inviwo(path: Path, options: ReadOptions) -> Volume:
    """Read the raw file that an Inviwo header describes; a sequence of several volumes needs ``component``.

    DataRange and ValueRange, where both are given, are the stored-value scaling. Without basis vectors or spacing
    voxels are unit cubes. Offset is the corner of the box, which is centred without one.
    """
    fields = _fields(path)
    dims = fields.sizes("Resolution", fields.need("resolution", "dimensions", "dimension"))
    if len(dims) != 3:
        raise DataError(f"{path}: Resolution {dims}; expected three numbers")
    dtype, channels = _format(fields)
    steps, offset = fields.integer("sequences", fields.integer("numframes", 1)), fields.integer("byteoffset", 0)
    if steps < 1 or offset < 0:
        raise DataError(f"{path}: Sequences {steps}, ByteOffset {offset}; expected at least 1, and 0 or more")
    source = data_file(path, fields.need("rawfile", "objectfilename"))
    block = load_block(source, dtype, (steps, *reversed(dims), channels), offset=offset, alone=True)
    block = np.moveaxis(block, 0, -1).reshape(*reversed(dims), -1) if steps > 1 else block[0]
    field, (slope, intercept) = select_component(block, options.component, str(path), scaling=_scaling(fields))
    if "transformmatrix" in fields:
        warnings.warn(f"{path}: its TransformMatrix is not read", stacklevel=2)
    factors, unit = one_unit(
        [fields.get(f"axis{k}unit", "") for k in (1, 2, 3)], str(path), options.spacing is not None
    )
    quantity, value_unit = (printable(fields.get(key, ""))[:40] for key in ("valuename", "valueunit"))
    volume = placed(
        field, _vectors(fields, dims) * np.reshape(factors, (3, 1)), (0.0, 0.0, 0.0), options, volume_name(path),
        slope=slope, intercept=intercept, unit=unit, quantity=quantity, value_unit=value_unit,
    )  # fmt: skip
    edges = volume.affine[:3, :3]
    if fields.get("offset"):
        origin = np.array(fields.floats("Offset", fields["offset"], 3)) * factors + edges @ (0.5, 0.5, 0.5)
    else:
        origin = edges @ (0.5 - np.array(dims) / 2) + 0.0
    return replace(volume, origin=tuple(origin.tolist()))
