"""AmiraMesh and Avizo ``.am``: values on a uniform lattice, raw (memory-mapped), text, HxZip (zlib) and HxByteRLE.

Format: "AmiraMesh Format" of the Amira user's guide. BoundingBox is from the centre of the first voxel to that of the
last; TransformationMatrix multiplies row vectors from the right, as in Open Inventor.
"""

from __future__ import annotations

import mmap
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory, count, load_block
from vvgt_cli.volume.components import ArrayInfo, choose_array, select_component
from vvgt_cli.volume.headers import MAX_HEADER, HeaderFields, type_of
from vvgt_cli.volume.reading import ReadOptions, Segment, Volume, one_unit, placed, segments_in, triple, volume_name

_TYPES = ("byte", "short", "ushort", "int", "float", "double")
_STREAM = re.compile(  # place, type, components, name, number, encoding, length
    r'^[ \t]*(\w+)\s*\{\s*(\w+)\s*(?:\[(\d{1,6})\])?\s+"?([^\s"}]+)"?\s*\}\s*=?\s*@(\d+)'
    r"(?:\(\s*(\w+)\s*,\s*(\d*)\s*\))?",
    re.MULTILINE,
)


def read_amira(path: Path, options: ReadOptions) -> Volume:
    """Read values of a uniform lattice; labels keep their numbers."""
    with open(path, "rb") as file:
        head = file.read(MAX_HEADER)
    mark = re.search(rb"^@\d+[ \t]*\r?\n", head, re.MULTILINE)
    start = len(head) if mark is None else mark.start()
    text = re.sub(r"^[ \t]*#.*$", "", head[:start].decode("utf-8", "replace"), flags=re.MULTILINE)
    fields, words, depth = HeaderFields(path.name), [""], 0
    for word in re.findall(r'"[^"\n]*"|[{}]|[^\s{},"]+', text):
        depth += {"{": 1, "}": -1}.get(word, 0)
        words += [word.strip('"')] if depth < 2 else []  # outside of the bundles within Parameters
    for key, n in (("Lattice", 3), ("CoordType", 1), ("BoundingBox", 6), ("TransformationMatrix", 16)):
        if key in words:
            fields[key] = " ".join(words[words.index(key) + 1 :][:n])
    streams = sorted((m.groups("") for m in _STREAM.finditer(text)), key=lambda row: int(row[4]))
    own = [row for row in streams if row[0] == "Lattice" and row[1] in _TYPES]
    if not own or fields.get("CoordType", "uniform").lower() != "uniform":
        raise DataError(
            f"{path}: an Amira file of {fields.get('CoordType')} coordinates, data "
            f"{', '.join(f'{row[0]} ({row[1]})' for row in streams[:9]) or 'none'}; expected Lattice data of type "
            f"{', '.join(_TYPES)} on uniform coordinates (in Amira, Resample makes them)"
        )
    infos = [ArrayInfo(row[3], "point", int(row[2] or 1), str(type_of(row[1]))) for row in own]
    row = own[choose_array(infos, options.array, str(path))]
    shape = (*reversed(fields.sizes("define Lattice", fields.need("Lattice"))), int(row[2] or 1))
    if len(shape) != 4 or shape[3] < 1:
        raise DataError(f"{path}: a lattice of {fields['Lattice']}, {row[2]} components; expected three sizes")
    block = _values(path, head.partition(b"\n")[0].upper(), start, streams, row, shape)
    field, _ = select_component(block, options.component, str(path), label=row[3], color=row[1] == "byte")
    return _placed(field, fields, text, path, options)


def _placed(field: np.ndarray, fields: HeaderFields, text: str, path: Path, options: ReadOptions) -> Volume:
    """Return the volume of a field (nz, ny, nx), where BoundingBox and TransformationMatrix say."""
    low, step, matrix = np.zeros(3), np.ones(3), np.eye(4)
    if "BoundingBox" in fields:
        low, high = np.reshape(fields.floats("BoundingBox", fields["BoundingBox"], 6), (3, 2)).T
        step = (high - low) / np.maximum(np.array(field.shape[::-1]) - 1, 1)
        step = np.where(step == 0, step[0] or 1.0, step)
    elif options.spacing is None:
        warnings.warn(f"{path}: it has no BoundingBox; voxels are taken as 1 wide", stacklevel=2)
    if "TransformationMatrix" in fields:
        matrix = np.reshape(fields.floats("TransformationMatrix", fields["TransformationMatrix"], 16), (4, 4))
    stated = re.search(r'\bUnits\s*\{[^}]*?\bCoordinates\s+"([^"\n]*)"', text)
    _, unit = one_unit(["" if stated is None else stated[1]], str(path), options.spacing is not None)
    origin = (np.append(low, 1.0) @ matrix)[:3]
    own = re.search(r"\bMaterials\s*\{((?:[^{}]|\{[^{}]*\})*)\}", text)
    volume = placed(field, step[:, None] * matrix[:3, :3], origin, options, volume_name(path), unit=unit)
    if own is None or not re.search(r"\bLabels\b", text):
        return volume
    return replace(volume, segments=segments_in(lambda: _materials(own[1]), str(path)))


def _materials(text: str) -> list[Segment]:
    """Return the segments of Amira's materials, ``NAME { Id N, Color R G B }``; the first is 0, the exterior.

    Values of a label field count them in their order, whatever their Id is.
    """
    segments = []
    for number, (name, inner) in enumerate(re.findall(r'([^\s{}"]+|"[^"\n]*")\s*\{([^{}]*)\}', text)):
        color = re.search(r"\bColor\s+([^,\n]+)", inner)
        rgb = None if color is None else triple(float(word) for word in color[1].split()[:3])
        segments.append(Segment(number, name.strip('"'), rgb))
    return segments


def _values(
    path: Path, form: bytes, start: int, streams: list[tuple[str, ...]], row: tuple[str, ...], shape: tuple[int, ...]
) -> np.ndarray:
    """Return the values (nz, ny, nx, c) of the data stream ``row``; the first one's mark is at byte ``start``."""
    binary, coding = b"BINARY" in form, row[5]
    dtype = np.dtype(type_of(row[1])).newbyteorder("<" if b"LITTLE" in form else ">")
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for one in streams:
            if not binary:
                start = max(data.find(b"\n@" + one[4].encode(), max(start - 1, 0)), 0)
            mark = re.match(rb"\s{0,8}@" + one[4].encode() + rb"[ \t]*\r?\n", data[start : start + 64])
            if mark is None:
                raise DataError(f"{path}: the values @{one[4]} are not where they are expected; is the file whole?")
            start += mark.end()
            if one is row:
                break
            plain = (
                count(shape[:3]) * int(one[2] or 1) * (np.dtype(type_of(one[1])).itemsize if one[1] in _TYPES else 1)
            )
            start += int(one[6]) if one[6] else plain if binary else 0
    if coding == "HxByteRLE":
        size, packed = count(shape) * dtype.itemsize, int(row[6] or path.stat().st_size - start)
        runs = np.array(load_block(path, np.dtype("u1"), (packed,), offset=start))
        if size > 64 * packed:
            raise DataError(f"{path}: {packed} bytes of run lengths cannot hold {size}; is the file whole?")
        check_memory(size, str(path))
        from vvgt_cli.volume.plain.run_lengths import decode_runs

        out = np.zeros(size, np.uint8)
        if decode_runs(runs, out) != size:
            raise DataError(f"{path}: its run lengths do not make {size} bytes; is the file whole?")
        return out.view(dtype).reshape(shape)
    if coding not in ("", "HxZip"):
        raise DataError(f"{path}: data encoded as {coding}; expected none, HxZip or HxByteRLE")
    encoding = "zlib" if coding else "raw" if binary else "text"
    return load_block(path, dtype, shape, offset=start, encoding=encoding)
