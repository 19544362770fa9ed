"""NRRD, attached (``.nrrd``) and detached (``.nhdr``, with one data file or several).

Encodings: raw (memory-mapped where it is one file), gzip, bzip2 and text. Along an axis of
kind ``time``, and of kind ``list`` in sequences of 3D Slicer (``.seq.nrrd``), time runs.

Format: https://teem.sourceforge.net/nrrd/format.html
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.blocks import data_file, load_block
from vvgt_cli.volume.components import select_component
from vvgt_cli.volume.headers import MARK, MAX_HEADER, Fields, unit_rows
from vvgt_cli.volume.medical.nrrd_files import data_names, load_files
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.packed import Packed, packed
from vvgt_cli.volume.readers import volume_name
from vvgt_cli.volume.space import MILLIMETRE, metres, one_unit
from vvgt_cli.volume.types import Volume

_TYPES = {
    "i1": "signed char, int8, int8_t",
    "u1": "uchar, unsigned char, uint8, uint8_t",
    "i2": "short, short int, signed short, signed short int, int16, int16_t",
    "u2": "ushort, unsigned short, unsigned short int, uint16, uint16_t",
    "i4": "int, signed int, int32, int32_t",
    "u4": "uint, unsigned int, uint32, uint32_t",
    "i8": "longlong, long long, long long int, signed long long, signed long long int, int64, int64_t",
    "u8": "ulonglong, unsigned long long, unsigned long long int, uint64, uint64_t",
    "f4": "float",
    "f8": "double",
}
_DTYPE = {name: code for code, names in _TYPES.items() for name in names.split(", ")}
_ENCODINGS = {
    "raw": "raw",
    "gzip": "gzip",
    "gz": "gzip",
    "bzip2": "bzip2",
    "bz2": "bzip2",
    "text": "text",
    "txt": "text",
    "ascii": "text",
}
_SPATIAL_KINDS = {"domain", "space", "???", "none"}
_SEQUENCE = re.compile(r"\.seq\.n(rrd|hdr)$", re.I)  # how 3D Slicer names them


def read_header(path: Path) -> tuple[Fields, int]:
    """The fields of a NRRD header, and the position behind its blank line (the file's end if detached).

    Raises:
        DataError: not a NRRD file, or a header without an end.
    """
    with open(path, "rb") as file:
        if not file.readline(MAX_HEADER).removeprefix(MARK).startswith(b"NRRD000"):
            raise DataError(f"{path}: does not begin with NRRD000; expected a NRRD file")
        fields = Fields(path.name)
        while line := file.readline(MAX_HEADER):
            if file.tell() > MAX_HEADER:
                raise DataError(f"{path}: no blank line ends its header; check that the file is whole")
            text = line.decode("utf-8", "replace").strip()
            if not text:
                break
            key, colon, value = text.partition(":")
            if not text.startswith("#") and colon and not value.startswith("="):
                name = key.strip().lower().replace(" ", "")  # teem takes most names with and without blanks
                fields[{"centerings": "centers"}.get(name, name)] = value.strip()
        return fields, file.tell()


def _dtype(fields: Fields, encoding: str) -> np.dtype:
    name = " ".join(fields.need("type").lower().split())
    if name not in _DTYPE:
        raise DataError(f"{fields.name}: values of type {name!r}; expected one of int8 ... uint64, float, double")
    dtype = np.dtype(_DTYPE[name])
    if dtype.itemsize > 1 and encoding != "text":
        endian = fields.need("endian").lower()
        if endian not in ("little", "big"):
            raise DataError(f"{fields.name}: endian is {endian!r}; expected little or big")
        dtype = dtype.newbyteorder("<" if endian == "little" else ">")
    return dtype


def _vectors(fields: Fields, n: int) -> list[list[float] | None] | None:
    """Return the space directions of the n axes: a vector of three, or None for an axis that is not spatial.

    Returns None where the header has no space directions.

    Raises:
        DataError: vectors of another number, or of another length than the space has dimensions.
    """
    if "spacedirections" not in fields:
        return None
    tokens = re.findall(r"none|\([^)]*\)", fields["spacedirections"])
    if len(tokens) != n or "".join(tokens).replace(" ", "") != "".join(fields["spacedirections"].split()):
        raise DataError(f"{fields.name}: space directions {fields['spacedirections']!r}; expected {n} vectors or none")
    return [None if token == "none" else _vector(fields, "space directions", token) for token in tokens]


def _vector(fields: Fields, key: str, text: str) -> list[float]:
    """Return a vector ``(x,y,z)`` of the header's space; the third of two dimensions is 0, a fourth is time's."""
    space = fields.get("space", "").lower()
    edge = fields.integer("spacedimension", 4 if space.endswith("-time") else 3 if space else text.count(",") + 1)
    inner = text.strip("() ")
    if inner.count(",") + 1 != edge:
        raise DataError(f"{fields.name}: {key} has {text!r}; expected {edge} numbers with decimal points")
    return [*fields.floats(key, inner, edge), 0.0, 0.0][:3]


def _component_axis(fields: Fields, sizes: list[int], vectors: list[list[float] | None] | None) -> int | None:
    """Index (fastest first) of the axis that holds components, or None.

    Raises:
        DataError: more axes than three in space and one of components.
    """
    kinds = fields.get("kinds", "").lower().split()
    odd = [k for k, vector in enumerate(vectors) if vector is None] if vectors else []
    if not odd and len(kinds) == len(sizes):
        odd = [k for k, kind in enumerate(kinds) if kind not in _SPATIAL_KINDS]
    if not odd and len(sizes) == 4:
        odd = [0 if sizes[0] <= sizes[3] else 3]
    if len(sizes) - len(odd) not in (2, 3) or len(odd) > 1:
        raise DataError(
            f"{fields.name}: axes of sizes {sizes}, of which {len(odd)} are not spatial; expected two or three "
            "spatial axes and at most one of components"
        )
    return odd[0] if odd else None


def _time_axis(path: Path, fields: Fields, axis: int | None) -> bool:
    """Whether the axis beyond space is one of time."""
    kinds = fields.get("kinds", "").lower().split()
    kind = kinds[axis] if axis is not None and axis < len(kinds) else ""
    return kind == "time" or (kind == "list" and _SEQUENCE.search(path.name) is not None)


def _step(block: np.ndarray, options: ReadOptions, source: str) -> int | str | None:
    """What is chosen of time steps along a block's last axis: by ``time``, or by ``component``.

    Raises:
        UsageError: none is (`SeveralSteps`), both are, or one that does not exist.
    """
    if options.component is not None:
        if options.time is not None:
            raise UsageError(f"{source}: --time and --component both choose along its one axis of time; leave out one")
        return options.component
    step = options.step(block.shape[-1], source)
    return step if block.shape[-1] > 1 else None


def _place(
    fields: Fields, vectors: list[list[float] | None] | None, axis: int | None, sizes: list[int], options: ReadOptions
) -> dict[str, Any]:
    """Return spacing, direction, origin, space and unit, as keywords of `Volume`.

    Coordinates of left-handed spaces (left-anterior-superior, 3D-left-handed) are made right-handed ones.

    Raises:
        DataError: numbers that do not fit the axes.
        UsageError: units that do not compare, and no spacing given.
    """
    space = None
    if vectors is None:
        steps, origin = _along_axes(fields, axis, sizes)
        axes = np.diag(steps)
        units = [unit for k, unit in enumerate(_words(fields, "units")) if k != axis]
    else:
        spatial = [v for k, v in enumerate(vectors) if k != axis and v is not None]
        axes, origin = np.array(spatial if len(spatial) == 3 else [*spatial, _third(spatial)]), np.zeros(3)
        units = _words(fields, "spaceunits")[:3]
    if "spaceorigin" in fields and "none" not in fields["spaceorigin"]:
        origin = np.array(_vector(fields, "space origin", fields["spaceorigin"]))
    known, unit = one_unit(units, fields.name, options.spacing is not None)
    factors = np.array([*known, 1.0, 1.0, 1.0])[:3]
    if vectors is not None:  # which say where axes run
        signs, space = _space(fields)
        factors *= signs
    if space is not None:  # in mm
        factors, unit = factors * (metres(unit) or MILLIMETRE) / MILLIMETRE, ""
    lengths, direction = unit_rows((axes * factors).tolist())
    spacing, first = options.spacing_or(lengths), tuple((origin * factors + 0.0).tolist())
    return {"spacing": spacing, "direction": direction, "origin": first, "space": space, "unit": unit}


def _along_axes(fields: Fields, axis: int | None, sizes: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return step and first position (3,) along each axis, by ``spacings``, ``axis mins`` and ``axis maxs``.

    As teem has it: where values are cells, as they are unless ``centers`` says ``node``, they begin half a step behind
    the minimum.
    """

    def numbers(key: str) -> list[float]:
        words = fields.get(key, "").replace(", ", " ").split() or ["nan"] * len(sizes)
        if len(words) != len(sizes):
            raise DataError(f"{fields.name}: {key} is {fields[key]!r}; expected {len(sizes)} numbers")
        kept = [word for k, word in enumerate(words) if k != axis]
        return [math.nan if word.lower() == "nan" else fields.floats(key, word, 1)[0] for word in kept]

    centers = (fields.get("centers", "").lower().split() + ["cell"] * len(sizes))[: len(sizes)]
    nodes = [center == "node" for k, center in enumerate(centers) if k != axis]
    counts = [size for k, size in enumerate(sizes) if k != axis]
    steps, first = np.ones(3), np.zeros(3)
    for k, (step, low, high) in enumerate(zip(*map(numbers, ("spacings", "axismins", "axismaxs")), strict=True)):
        parts = max(counts[k] - nodes[k], 1)
        if math.isnan(step) and not math.isnan(low + high):
            step = (high - low) / parts
        steps[k] = 1.0 if math.isnan(step) else step
        first[k] = 0.0 if math.isnan(low) else low + (0.0 if nodes[k] else steps[k] / 2)
    return steps, first


def _words(fields: Fields, key: str) -> list[str]:
    """Return the words of a field, each in quotes or, as some writers have it, without."""
    return [a or b for a, b in re.findall(r'"([^"]*)"|(\S+)', fields.get(key, ""))]


def _third(axes: list[list[float]]) -> np.ndarray:
    """A unit vector at right angles to the first two axes, for a volume of two."""
    unit = np.reshape(unit_rows([*axes, [0.0, 0.0, 1.0]])[1], (3, 3)).T
    normal = np.cross(unit[0], unit[1])
    length = np.linalg.norm(normal)
    result: np.ndarray = normal / length if length > 0 else unit[2]
    return result


def _space(fields: Fields) -> tuple[np.ndarray, str | None]:
    """Signs that make the file's coordinates right-handed, and the anatomical space that they then are in."""
    name = fields.get("space", "").lower().removesuffix("-time")
    letters = "".join(word[:1] for word in name.split("-")) if name.count("-") == 2 else name
    if letters in ("ras", "lps"):
        return np.ones(3), letters.upper()
    if letters in ("las", "rps"):
        return np.array([-1.0, 1.0, 1.0]), "RAS" if letters == "las" else "LPS"
    return np.array([1.0, 1.0, -1.0 if name == "3d-left-handed" else 1.0]), None


def _line_skip(path: Path, offset: int, lines: int) -> int:
    with open(path, "rb") as file:
        file.seek(offset)
        for _ in range(lines):
            if not file.readline():
                raise DataError(f"{path.name}: shorter than its 'line skip' of {lines} lines")
        return file.tell()


def read_nrrd(path: Path, options: ReadOptions) -> Volume:
    """Read a NRRD file; raw encoding is memory-mapped.

    Raises:
        DataError: a header that is incomplete or does not fit the data, a data file outside the header's folder.
        UsageError: several components, or time steps (`SeveralSteps`), and none chosen.
    """
    fields, offset = read_header(path)
    encoding = _ENCODINGS.get(fields.need("encoding").lower())
    if encoding is None:
        raise DataError(f"{path}: encoding {fields['encoding']!r}; expected {', '.join(sorted(_ENCODINGS))}")
    dtype = _dtype(fields, encoding)
    sizes = fields.sizes("sizes", fields.need("sizes"))
    if len(sizes) != fields.integer("dimension", len(sizes)):
        raise DataError(f"{path}: dimension {fields['dimension']} but sizes {fields['sizes']!r}")
    skip = fields.integer("byteskip", 0)
    if skip < -1 or (skip == -1 and encoding != "raw"):
        raise DataError(f"{path}: byte skip {skip} with encoding {encoding}; expected 0 or more (-1 with raw only)")

    slabs = options.packed and encoding in ("gzip", "bzip2") and len(sizes) == 3 and options.component is None
    slabs = slabs and _component_axis(fields, sizes, _vectors(fields, len(sizes))) is None

    def load(source: Path, start: int, shape: tuple[int, ...]) -> np.ndarray:
        if skip == -1:
            return load_block(source, dtype, shape, offset=-1)
        start = _line_skip(source, start, fields.integer("lineskip", 0))
        if slabs and shape == tuple(reversed(sizes)):
            return packed(source, dtype, shape, encoding, offset=start, skip=skip)
        return load_block(source, dtype, shape, offset=start, encoding=encoding, skip=skip)

    shape = tuple(reversed(sizes))
    named = fields.get("datafile")
    several = data_names(path, named, len(sizes)) if named is not None else None
    if named is None:
        block = load(path, offset, shape)
    elif several is None:
        block = load(data_file(path, named), 0, shape)
    else:
        block = load_files(path, *several, shape, dtype, lambda name, part: load(data_file(path, name), 0, part))
    return _volume(path, fields, block, sizes, options)


def _volume(path: Path, fields: Fields, block: np.ndarray, sizes: list[int], options: ReadOptions) -> Volume:
    vectors = _vectors(fields, len(sizes))
    axis = _component_axis(fields, sizes, vectors)
    place = _place(fields, vectors, axis, sizes, options) | {"name": volume_name(path)}
    if isinstance(block, Packed):
        return Volume(block, **place)
    block = block[..., None] if axis is None else np.moveaxis(block, len(sizes) - 1 - axis, -1)
    if block.ndim == 3:
        block = block[None]
    color = "rgb" in fields.get("kinds", "").lower()
    label = f"axis {axis}" if axis is not None else ""
    component = options.component
    if _time_axis(path, fields, axis):
        component = _step(block, options, str(path))
    elif options.time:
        raise UsageError(
            f"{path}: no axis of time (of kind time, or list in a .seq.nrrd); leave out --time {options.time}"
        )
    field, _ = select_component(block, component, str(path), label=label, color=color)
    return Volume(field, **place)
