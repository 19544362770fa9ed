"""NRRD, attached (``.nrrd``) and detached (``.nhdr``, with one data file or several).

Encodings: raw (memory-mapped where it is one file), gzip, bzip2 and text. Several data files are named by
``data file: LIST [n]`` or ``data file: FORMAT MIN MAX STEP [n]``. Time runs along an axis of kind ``time``, and of kind
``list`` in sequences of 3D Slicer (``.seq.nrrd``).

Format: https://teem.sourceforge.net/nrrd/format.html
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.blocks import Packed, check_memory, count, data_file, load_block
from vvgt_cli.volume.headers import MARK, MAX_HEADER, HeaderFields, printable
from vvgt_cli.volume.reading import ReadOptions, Segment, Volume, segments_in, select_component, triple, volume_name
from vvgt_cli.volume.space import MILLIMETRE, metres, one_unit, placed, unit_rows

_ENCODINGS = {
    "raw": "raw", "gzip": "gzip", "gz": "gzip", "bzip2": "bzip2", "bz2": "bzip2", "text": "text", "txt": "text",
    "ascii": "text",
}  # fmt: skip
_SPATIAL_KINDS = {"domain", "space", "???", "none"}
MAX_FILES = 100_000
_SEGMENT = re.compile(r"Segment([0-9]{1,9})_(\w+):=")
_SEQUENCE = re.compile(r"\.seq\.n(rrd|hdr)$", re.I)  # how 3D Slicer names them


def read_header(path: Path) -> tuple[HeaderFields, int]:
    """Read the fields of a NRRD header, and the position behind its blank line (or the end), or raise DataError."""
    with open(path, "rb") as file:
        if not file.readline(MAX_HEADER).removeprefix(MARK).startswith(b"NRRD000"):
            raise DataError(f"{path}: does not begin with NRRD000; expected a NRRD file")
        fields = HeaderFields(path.name)
        while line := file.readline(MAX_HEADER):
            if file.tell() > MAX_HEADER:
                raise DataError(f"{path}: no blank line ends its header; check that the file is whole")
            text = line.decode("utf-8", "replace").strip()
            if not text:
                break
            key, colon, value = text.partition(":")
            if text.startswith("#") or not colon:
                continue
            if value.startswith("="):  # a key and a value that teem leaves to programs
                fields[f"{key}:="] = value[1:].strip()
                continue
            name = key.strip().lower().replace(" ", "")  # teem takes most names with and without blanks
            fields[{"centerings": "centers"}.get(name, name)] = value.strip()
        return fields, file.tell()


def _dtype(fields: HeaderFields, encoding: str) -> np.dtype:
    dtype = fields.dtype("type", fields.need("type"))
    if dtype.itemsize > 1 and encoding != "text":
        endian = fields.need("endian").lower()
        if endian not in ("little", "big"):
            raise DataError(f"{fields.name}: endian is {endian!r}; expected little or big")
        dtype = dtype.newbyteorder("<" if endian == "little" else ">")
    return dtype


def _vectors(fields: HeaderFields, n: int) -> list[list[float] | None] | None:
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
    rows = [None if token == "none" else _vector(fields, "space directions", token) for token in tokens]
    timed = _space_name(fields).endswith("-time")  # time's axis steps along none of space
    return [row if row is None or any(row) or not timed else None for row in rows]


def _space_name(fields: HeaderFields) -> str:
    """Return the name of the space in lower case, with ``-time`` where it has time."""
    return re.sub("^(ras|las|lps)t$", r"\1-time", fields.get("space", "").lower())


def _vector(fields: HeaderFields, key: str, text: str) -> list[float]:
    """Return a vector ``(x,y,z)`` of the header's space; the third of two dimensions is 0, a fourth is time's."""
    space = _space_name(fields)
    edge = fields.integer("spacedimension", 4 if space.endswith("-time") else 3 if space else text.count(",") + 1)
    inner = text.strip("() ")
    if inner.count(",") + 1 != edge:
        raise DataError(f"{fields.name}: {key} has {text!r}; expected {edge} numbers with decimal points")
    return [*fields.floats(key, inner, edge), 0.0, 0.0][:3]


def _component_axis(fields: HeaderFields, sizes: list[int], vectors: list[list[float] | None] | None) -> int | None:
    """Find the axis (fastest first) of components, None without one; raise DataError for several axes beside space."""
    kinds = fields.get("kinds", "").lower().split()
    odd = [k for k, vector in enumerate(vectors) if vector is None] if vectors else []
    if not odd and len(kinds) == len(sizes):
        odd = [k for k, kind in enumerate(kinds) if kind not in _SPATIAL_KINDS]
    if not odd and len(sizes) == 4:
        odd = [3 if _space_name(fields).endswith("-time") or sizes[0] > sizes[3] else 0]
    if len(sizes) - len(odd) not in (2, 3) or len(odd) > 1:
        raise DataError(
            f"{fields.name}: axes of sizes {sizes}, of which {len(odd)} are not spatial; expected two or three "
            "spatial axes and at most one of components"
        )
    return odd[0] if odd else None


def _step(block: np.ndarray, options: ReadOptions, source: str) -> int | str | None:
    """Choose along a block's last axis, time, by ``time`` or ``component``; raise UsageError unless one says."""
    if options.component is not None:
        if options.time is not None:
            raise UsageError(f"{source}: --time and --component both choose along its one axis of time; leave out one")
        return options.component
    step = options.step(block.shape[-1], source)
    return step if block.shape[-1] > 1 else None


def _place(
    fields: HeaderFields, vectors: list[list[float] | None] | None, axis: int | None, sizes: list[int],
    options: ReadOptions,
) -> dict[str, Any]:  # fmt: skip
    """Return the arguments ``steps``, ``origin``, ``space`` and ``unit`` of `placed`.

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
    return {"steps": axes * factors, "origin": origin * factors + 0.0, "space": space, "unit": unit}


def _along_axes(fields: HeaderFields, axis: int | None, sizes: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return step and first position (3,) along each axis, by ``spacings``, ``axis mins`` and ``axis maxs``.

    Where values are cells, as in teem unless ``centers`` says ``node``, they begin half a step behind the minimum.
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


def _words(fields: HeaderFields, key: str) -> list[str]:
    """Return the words of a field, each in quotes or, as some writers have it, without."""
    return [a or b for a, b in re.findall(r'"([^"]*)"|(\S+)', fields.get(key, ""))]


def _third(axes: list[list[float]]) -> np.ndarray:
    """Return a unit vector at right angles to the two axes of a flat volume."""
    unit = np.reshape(unit_rows([*axes, [0.0, 0.0, 1.0]])[1], (3, 3)).T
    normal = np.cross(unit[0], unit[1])
    length = np.linalg.norm(normal)
    return np.asarray(normal / length if length > 0 else unit[2])


def _space(fields: HeaderFields) -> tuple[np.ndarray, str | None]:
    """Return signs that make the file's coordinates right-handed, and the anatomical space that they then are in."""
    name = _space_name(fields).removesuffix("-time")
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
    """Read a NRRD file; raw encoding is memory-mapped."""
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

    shape = tuple(reversed(sizes))
    packed = options.packed and len(sizes) == 3 and options.component is None
    packed = packed and _component_axis(fields, sizes, _vectors(fields, len(sizes))) is None

    def load(source: Path, start: int, part: tuple[int, ...]) -> np.ndarray:
        if skip == -1:
            return load_block(source, dtype, part, offset=-1)
        start, whole = _line_skip(source, start, fields.integer("lineskip", 0)), packed and part == shape
        return load_block(
            source, dtype, part, offset=start, encoding=encoding, skip=skip, packed=whole, alone=source != path
        )

    named = fields.get("datafile")
    several = _data_names(path, named, len(sizes)) if named is not None else None
    if named is None:
        block = load(path, offset, shape)
    elif several is None:
        block = load(data_file(path, named), 0, shape)
    else:
        block = _load_files(path, *several, shape, dtype, lambda name, part: load(data_file(path, name), 0, part))
    return _volume(path, fields, block, sizes, options)


def _volume(path: Path, fields: HeaderFields, block: np.ndarray, sizes: list[int], options: ReadOptions) -> Volume:
    vectors = _vectors(fields, len(sizes))
    axis = _component_axis(fields, sizes, vectors)
    place = _place(fields, vectors, axis, sizes, options) | {"options": options, "name": volume_name(path)}
    if "oldmin" in fields or "oldmax" in fields:
        warnings.warn(f"{path}: old min and old max are not applied to its quantized values, as in ITK", stacklevel=2)
    place["value_unit"] = printable(_words(fields, "sampleunits")[0])[:40] if fields.get("sampleunits") else ""
    if any(_SEGMENT.fullmatch(key) for key in fields):
        layer = options.component if isinstance(options.component, int) else None
        place["segments"] = segments_in(lambda: segments(fields, layer), str(path))
    if isinstance(block, Packed):
        return placed(block, **place)
    block = block[..., None] if axis is None else np.moveaxis(block, len(sizes) - 1 - axis, -1)
    if block.ndim == 3:
        block = block[None]
    label = f"axis {axis}" if axis is not None else ""
    component, kinds = options.component, fields.get("kinds", "").lower()
    kind = dict(enumerate(kinds.split())).get(axis, "") if axis is not None else ""
    timed = _space_name(fields).endswith("-time") and kind in ("", "space", "domain")
    timed = timed and "none" not in fields.get("spacedirections", "")
    if timed or kind == "time" or (kind == "list" and _SEQUENCE.search(path.name)):
        component = _step(block, options, str(path))
    elif options.time:
        raise UsageError(
            f"{path}: no axis of time (of kind time, or list in a .seq.nrrd); leave out --time {options.time}"
        )
    field, _ = select_component(block, component, str(path), label=label, color="rgb" in kinds)
    return placed(field, **place)


def segments(fields: HeaderFields, layer: int | None = None) -> list[Segment]:
    """Return the segments in a header of 3D Slicer's .seg.nrrd, of one layer or of all, or raise DataError."""
    kept, stated = [], dict[str, dict[str, str]]()
    for key, value in fields.items():
        if match := _SEGMENT.fullmatch(key):
            stated.setdefault(match[1], {})[match[2]] = value
    for index, one in stated.items():
        color, label = one.get("Color", "").split(), one.get("LabelValue", str(int(index) + 1))
        try:
            rgb = triple(map(float, color)) if color else None
            segment = Segment(int(label), one.get("Name", one.get("ID", "")), rgb, _terms(one.get("Tags", "")))
        except ValueError:
            text = f"{fields.name}: segment {index}: label {label[:40]!r}, colour {color[:5]}; expected numbers"
            raise DataError(text) from None
        kept += [segment] if layer is None or one.get("Layer", "0") == str(layer) else []
    return kept


def _terms(tags: str) -> tuple[tuple[str, str, str], ...]:
    """Return `Segment.terms` of the tags of a segment; none if they are not as 3D Slicer writes them.

    The entry is ``context~category~type~modifier~context~region~modifier``, each code ``scheme^value^meaning``.
    """
    entry = next((tag for tag in tags.split("|") if tag.startswith("TerminologyEntry:")), "")
    fields = entry.partition(":")[2].split("~")
    codes = [triple(code) for k, field in enumerate(fields) if k not in (0, 4) and len(code := field.split("^")) == 3]
    return tuple(codes) if len(codes) == 5 and len(fields) == 7 else ()


def _data_names(path: Path, named: str, n: int) -> tuple[list[str], int] | None:
    """Return names and how many of ``n`` axes each file holds, None if ``named`` is one file, or raise DataError."""
    words = named.split()
    if words and words[0] == "LIST":
        lines = path.read_bytes()[:MAX_HEADER].decode("utf-8", "replace").splitlines()
        start = next(k for k, line in enumerate(lines) if re.match(r"data ?file:\s*LIST", line, re.IGNORECASE))
        names, rest = [line.strip() for line in lines[start + 1 :] if line.strip()], words[1:]
    elif re.search(r"%0?\d*d", named) and len(words) >= 4:
        try:
            lo, hi, step = (int(w) for w in words[1:4])
            number = re.fullmatch(r"([^%]*)%(0?)(\d*)d([^%]*)", words[0])
            if number is None or step == 0 or not 0 <= (hi - lo) // step < MAX_FILES:
                raise ValueError
        except ValueError:
            raise DataError(
                f"{path}: data file {named!r}; expected NAME%03d MIN MAX STEP, as slice%03d.raw 1 99 1"
            ) from None
        before, zero, width, after = number.groups()
        form = f"{{:{zero}{width}d}}" if len(width) < 3 else "{:d}"
        names = [before + form.format(k) + after for k in range(lo, hi + (1 if step > 0 else -1), step)]
        rest = words[4:]
    else:
        return None
    axes = int(rest[0]) if rest and rest[0].isdecimal() else n - 1
    if not names or len(names) > MAX_FILES or not 1 <= axes <= n:
        raise DataError(f"{path}: data file {named!r} with {len(names)} names of {axes} axes each; expected slices")
    return names, axes


def _load_files(
    path: Path,
    names: list[str],
    axes: int,
    shape: tuple[int, ...],
    dtype: np.dtype,
    load: Callable[[str, tuple[int, ...]], np.ndarray],
) -> np.ndarray:
    """Load the blocks of files, in order along the slowest axes; each holds the fastest ``axes``, or a slab of all.

    Raise DataError where files and sizes do not fit; ``load`` takes name and shape.
    """
    n = len(shape)
    part = shape[n - axes :]
    if axes == n and shape[0] % len(names) == 0:
        part = (shape[0] // len(names), *shape[1:])
    if count(part) * len(names) != count(shape):
        raise DataError(
            f"{path}: {len(names)} data files of {' x '.join(map(str, reversed(part)))} values; expected "
            f"{' x '.join(map(str, reversed(shape)))} in all"
        )
    check_memory(count(shape) * dtype.itemsize, str(path))
    out = np.empty((len(names), *part), dtype)
    for k, name in enumerate(names):
        out[k] = load(name, part)
    return out.reshape(shape)
