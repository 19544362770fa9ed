"""MetaImage, ``.mha`` (data in the file) and ``.mhd`` (data beside it): raw (memory-mapped), zlib and text.

Format: https://itk.org/Wiki/ITK/MetaIO/Documentation
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.headers import MAX_HEADER, HeaderFields
from vvgt_cli.volume.reading import ReadOptions, Volume, data_file, load_block, select_component, volume_name
from vvgt_cli.volume.space import MILLIMETRE, metres, one_unit, placed

_MODALITIES = {f"MET_MOD_{name}": name for name in ("CT", "MR", "NM", "US")}  # MetaIO's (metaImageTypes.h)
_SCALING = (("slope", 1), ("offset", 0))


def read_header(path: Path) -> tuple[HeaderFields, int]:
    """Read the fields of a MetaImage header, and the position behind its last, ElementDataFile, or raise DataError."""
    fields = HeaderFields(path.name)
    with open(path, "rb") as file:
        while (line := file.readline(MAX_HEADER)) and file.tell() <= MAX_HEADER:
            key, equals, value = line.decode("utf-8-sig", "replace").partition("=")
            if equals:
                fields[key.strip().lower()] = value.strip()
            if key.strip().lower() == "elementdatafile":
                return fields, file.tell()
    raise DataError(f"{path}: its header has no ElementDataFile; expected a MetaImage file")


def _flag(fields: HeaderFields, *keys: str) -> bool:
    for key in keys:
        if key in fields:
            return fields[key].lower() in ("true", "1", "t", "yes")
    return False


def _dtype(fields: HeaderFields) -> np.dtype:
    name = fields.need("elementtype")
    own = {"long": "i4"}  # MET_LONG has 4 bytes whatever the machine (MetaIO, metaTypes.h)
    plain = name.lower().removeprefix("met_").removesuffix("_array")
    big = _flag(fields, "binarydatabyteordermsb", "elementbyteordermsb")
    return fields.dtype(f"ElementType {name} of kind", plain, own).newbyteorder(">" if big else "<")


def _first(fields: HeaderFields, keys: tuple[str, ...], n: int, default: float) -> np.ndarray:
    """Return the numbers (3,) of the first of these fields that is there, of which ``n`` are stated."""
    key = next((key for key in keys if key in fields), None)
    stated = [] if key is None else fields.floats(key, fields[key], min(n, 3))
    return np.array([*stated, default, default, default][:3])


def _place(fields: HeaderFields, n: int, options: ReadOptions) -> dict[str, Any]:
    """Return the arguments ``steps``, ``origin``, ``space`` and ``unit`` of `placed`.

    TransformMatrix lists the axes one after the other. The space is LPS, in mm, where the header names an orientation
    or gives axes, as ITK has it whatever the letters are.
    """
    spacing = _first(fields, ("elementspacing", "elementsize"), n, 1.0)
    origin = _first(fields, ("offset", "position", "origin"), n, 0.0)
    rows = np.eye(3)  # directions of the axes, one after the other
    space = "LPS" if fields.get("anatomicalorientation", "?").strip("? ") else None
    key = next((key for key in ("transformmatrix", "rotation", "orientation") if key in fields), None)
    if key is not None:
        edge = 3 if n == 4 and len(fields[key].split()) == 9 else n  # a matrix of space alone
        matrix = np.reshape(fields.floats(key, fields[key], edge * edge), (edge, edge))
        rows[: min(n, 3), : min(n, 3)] = matrix[:3, :3]
        if fields.get("anatomicalorientation", "LPS").strip("? "):
            space = "LPS"
    _, unit = one_unit([fields.get("distanceunits", "").strip("? ")], fields.name, options.spacing is not None)
    factor = 1.0
    if space is not None:
        factor, unit = (metres(unit) or MILLIMETRE) / MILLIMETRE, ""
    if options.spacing is not None:
        spacing = np.where(spacing == 0, 1.0, spacing)  # an axis has a direction, whatever its length
    return {"steps": factor * spacing[:, None] * rows, "origin": factor * origin, "space": space, "unit": unit}


def read_metaimage(path: Path, options: ReadOptions) -> Volume:
    """Read a MetaImage file; uncompressed data are memory-mapped."""
    fields, offset = read_header(path)
    sizes = fields.sizes("dimsize", fields.need("dimsize"))
    if len(sizes) != fields.integer("ndims", len(sizes)) or len(sizes) not in (2, 3, 4):
        raise DataError(f"{path}: NDims {fields.get('ndims')}, DimSize {fields['dimsize']!r}; expected 2, 3 or 4 axes")
    dtype = _dtype(fields)
    channels = fields.integer("elementnumberofchannels", 1)
    if channels < 1:
        raise DataError(f"{path}: ElementNumberOfChannels {channels}; expected at least 1")
    named = fields["elementdatafile"]
    source, start = (path, offset) if named.upper() == "LOCAL" else (path, 0)
    if named.upper() != "LOCAL":
        if named.upper().startswith("LIST") or "%" in named:
            raise DataError(f"{path}: its data lie in several files; expected one (write it again as .mha)")
        source = data_file(path, named)
    shape = (*reversed(sizes), channels)
    block = _load(fields, source, dtype, shape, start)
    # (t?, z?, y, x, c) -> (z, y, x, c)
    if len(sizes) == 4:
        block = (
            np.moveaxis(block, 0, -2).reshape(*shape[1:4], -1) if channels > 1 else np.moveaxis(block[..., 0], 0, -1)
        )
    elif len(sizes) == 2:
        block = block[None]
    field, _ = select_component(block, options.component, str(path))
    if any(fields.get(f"elementtointensityfunction{key}", f"{n}") not in (f"{n}", f"{n}.0") for key, n in _SCALING):
        warnings.warn(f"{path}: ElementToIntensityFunction is not applied to its values, as in ITK", stacklevel=2)
    facts = _place(fields, len(sizes), options) | {"modality": _MODALITIES.get(fields.get("modality", ""), "")}
    return placed(field, options=options, name=volume_name(path), **facts)


def _load(fields: HeaderFields, source: Path, dtype: np.dtype, shape: tuple[int, ...], start: int) -> np.ndarray:
    header = fields.integer("headersize", 0)
    if header < -1:
        raise DataError(f"{fields.name}: HeaderSize {header}; expected 0 or more, or -1 (data at the file's end)")
    if "binarydata" in fields and not _flag(fields, "binarydata"):
        return load_block(source, dtype, shape, offset=start, encoding="text")
    if _flag(fields, "compresseddata"):
        if header == -1:
            raise DataError(f"{fields.name}: HeaderSize -1 with compressed data; expected 0 or more")
        return load_block(source, dtype, shape, offset=start + header, encoding="zlib")
    offset = -1 if header == -1 else start + header
    return load_block(source, dtype, shape, offset=offset, alone=start == 0)
