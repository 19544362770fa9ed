"""`.spz` (Niantic's, versions 3 and 4) and `.compressed.ply` (PlayCanvas') through gsply.

`.spz` of version 4 has the streams of version 3, each compressed by Zstandard, after a plain header and records. The
layout follows https://github.com/nianticlabs/spz and its extensions/README.md: 32 bytes of header, records (type,
length, payload) and a table of (compressed, full) sizes. One record holds our comments, another the axes.
"""

from __future__ import annotations

import gzip
import struct
import tempfile
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.splats import ROW_BYTES, Splats, morton_order
from vvgt_cli.gaussians.header import MIP, TYPES, header_lines
from vvgt_cli.gaussians.types import HARMONICS
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.libraries import library_errors, need

EXTRA = "share"
_RANGES = [f"{end}_{of}{axis}" for of in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
_RANGES += [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
_FORMAT = "format binary_little_endian 1.0"
_WHOLE = (0, 0, 0, 1, 1, 1)  # colour range of SuperSplat 1, whose chunks state none
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_FRACTION = 20  # fractional bits of a coordinate of 23 bits, unless it is too large: 1e-6
_COMMENT = 16  # gzip's flag for a comment in its header (RFC 1952)
_FLAGS = 14  # byte of the header; 1: opacity is compensated for dilation ("antialiased")
_FRONT = struct.Struct("<2sBBIBB")  # magic, method, flags, time, extra flags, system


def gsply(source: str) -> Any:
    """Return the library; raise DataError if it is not installed."""
    return need("gsply", EXTRA, source, "this format")


def compressed_ply(splats: Splats, name: str, order: np.ndarray | None = None) -> bytes:
    """Encode columns as a `.compressed.ply`: 16 bytes per Gaussian, and 72 per chunk of 256 neighbours.

    ``order`` (K,) of the Gaussians is by default along the Morton curve.
    """
    library = gsply(name)
    s = splats.take(morton_order(splats.means) if order is None else order)
    rest = s.f_rest if s.f_rest.shape[1] else None
    content: bytes = library.compress_to_bytes(s.means, s.log_scales, s.quaternions, s.logits, s.f_dc, rest)
    comments = "".join(f"comment {line}\n" for line in s.comments).encode()
    head, end, body = content.partition(b"end_header\n")
    return head + comments + end + body


def read_compressed_ply(content: bytes, name: str) -> Splats:
    """Read the columns of a `.compressed.ply`; raise DataError if gsply cannot, or is not installed."""
    library = gsply(name)
    lines, size = header_lines(content, name)
    with library_errors(name, "a compressed .ply"):
        data = library.decompress_from_bytes(_in_order(content, lines, size))
        return _columns(data, [line[8:] for line in lines if line.startswith("comment ")])


def _in_order(content: bytes, lines: list[str], at: int) -> bytes:
    """Reorder the file's columns as gsply expects, with a colour range in every chunk."""
    elements: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    for words in map(str.split, lines):
        if words[:1] == ["element"]:
            elements[words[1]] = int(words[2]), []
        elif words[:1] == ["property"]:
            elements[list(elements)[-1]][1].append((words[2], TYPES[words[1]]))
    tables = {}
    for element, (count, fields) in elements.items():
        tables[element] = np.frombuffer(content, fields, count, at)
        at += tables[element].nbytes
    rest = [f"f_rest_{k}" for k in range(len(elements["sh"][1]))] if "sh" in elements else []
    chunks, count = len(tables["chunk"]), len(tables["vertex"])
    if _FORMAT not in lines or len(tables.get("sh", tables["vertex"])) != count or count > 256 * chunks:
        raise ValueError(f"not {_FORMAT}, or {chunks} chunks of 256 for {count} vertices")
    ends = {} if "min_r" in (tables["chunk"].dtype.names or ()) else dict(zip(_RANGES[12:], _WHOLE, strict=True))
    head, body = ["ply", _FORMAT], b""
    for element, names, kind in (("chunk", _RANGES, "float"), ("vertex", _PACKED, "uint"), ("sh", rest, "uchar")):
        if names:
            columns = [tables[element][key] if key not in ends else [ends[key]] * chunks for key in names]
            head += [f"element {element} {len(columns[0])}", *(f"property {kind} {key}" for key in names)]
            body += np.stack(columns, axis=1).astype(TYPES[kind]).tobytes()
    return "\n".join([*head, "end_header", ""]).encode() + body


def spz(splats: Splats, name: str) -> bytes:
    """Encode columns as `.spz` version 3, in the axes of the `.ply`, with its comments in the gzip header."""
    return _packed(_version_3(splats, name), splats.comments)


def spz_4(splats: Splats, name: str) -> bytes:
    """Encode columns as `.spz` version 4, with records for the comments and for the axes, which are the `.ply`'s."""
    return from_version_3(_version_3(splats, name), splats.comments, name)


def zstandard(source: str) -> Any:
    """Return the module `numcodecs.zstd`; raise DataError if it or gsply is not installed."""
    gsply(source)
    return need("numcodecs.zstd", EXTRA, source, ".spz of version 4")


def _version_3(splats: Splats, name: str) -> bytes:
    """Return the content of an `.spz` of version 3 before compression, with the flag for compensated opacity."""
    library = gsply(name)
    largest = max(float(np.abs(splats.means).max()), 1e-6)
    bits = min(int(np.floor(np.log2((2**23 - 1) / largest))), _FRACTION)
    if bits < 1:
        raise DataError(f"{name}: positions up to {largest:g}; expected less than 4e6 for .spz: try --frame unit")
    s = splats
    rest = s.f_rest if s.f_rest.shape[1] else None
    data = library.GSData.from_arrays(s.means, s.log_scales, s.quaternions, s.logits, s.f_dc, rest, format="ply")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "out.spz"
        library.write_spz(path, data, version=3, fractional_bits=bits)
        content = bytearray(gzip.decompress(path.read_bytes()))
    content[_FLAGS] |= MIP in s.comments
    return bytes(content)


def _packed(content: bytes, comments: tuple[str, ...]) -> bytes:
    """Compress by gzip with comments in its header, reproducibly."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    text = "\n".join(comments).encode("ascii", "replace").replace(b"\0", b" ")
    front = _FRONT.pack(b"\x1f\x8b", 8, _COMMENT if text else 0, 0, 2, 255) + (text + b"\0" if text else b"")
    return front + packer.compress(content) + packer.flush() + struct.pack("<II", zlib.crc32(content), len(content))


def read_spz(content: bytes, name: str) -> Splats:
    """Read the columns of an `.spz` of version 1 to 4; raise DataError if gsply cannot, or is not installed."""
    library = gsply(name)
    comments = _comments(content)
    if content.startswith(MAGIC):
        content, comments = to_version_3(content, name)
    with library_errors(name, "an .spz"), tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "in.spz"
        path.write_bytes(content)
        return _columns(library.read_spz(path), comments)


def _comments(content: bytes) -> list[str]:
    """Return the comments that `_packed` wrote."""
    if len(content) < _FRONT.size or _FRONT.unpack_from(content)[2] != _COMMENT:
        return []
    text = content[_FRONT.size : max(content.find(b"\0", _FRONT.size), 0)]  # empty if it is not terminated
    return text.decode("ascii", "replace").splitlines()


def _columns(data: Any, comments: list[str]) -> Splats:
    count = len(data.means)
    rest = np.zeros((count, 0, 3)) if data.shN is None else np.reshape(data.shN, (count, -1, 3))
    columns = (data.means, data.scales, data.quats, np.reshape(data.opacities, count), data.sh0, rest)
    means, log_scales, quaternions, logits, f_dc, f_rest = (np.array(column, np.float32) for column in columns)
    return Splats(means, log_scales, quaternions, logits, f_dc, f_rest, tuple(comments))


MAGIC = b"NGSP"
COMMENTS, AXES = 0x56560001, 0xADBE0003  # types of records: our comments; SPZ_ADOBE_coordinate_system
RIGHT_DOWN_FRONT = 6  # of CoordinateSystem: the axes of a 3DGS .ply
_HEAD = struct.Struct("<4sIIBBBBI12x")  # magic, version, Gaussians, degree, fraction bits, flags, streams, table
_OLD = struct.Struct("<4sIIBBBx")  # of versions 1 to 3
_RECORD, _SIZES = struct.Struct("<II"), struct.Struct("<QQ")
_RECORDS = 2  # flag
_LEVEL = 12  # of Zstandard
_COEFFICIENTS = {**HARMONICS, 4: 24}  # of version 4


def _lengths(count: int, degree: int) -> list[int]:
    """Return the sizes in bytes of centres, opacities, colours, scales, rotations and harmonics."""
    return [length * count for length in (9, 1, 3, 3, 4, 3 * _COEFFICIENTS[degree]) if length]


def from_version_3(content: bytes, comments: tuple[str, ...], name: str) -> bytes:
    """Convert the uncompressed content of version 3 to a file of version 4, which states the axes of a `.ply`."""
    zstd = zstandard(name)
    _, _, count, degree, fraction, flags = _OLD.unpack_from(content)
    records = _RECORD.pack(AXES, 4) + struct.pack("<I", RIGHT_DOWN_FRONT)
    text = "\n".join(comments).encode("ascii", "replace")
    records += _RECORD.pack(COMMENTS, len(text)) + text if text else b""
    packed, sizes, start = [], b"", _OLD.size
    for length in _lengths(count, degree):
        packed.append(bytes(zstd.compress(content[start : start + length], _LEVEL)))
        sizes += _SIZES.pack(len(packed[-1]), length)
        start += length
    head = (MAGIC, 4, count, degree, fraction, flags | _RECORDS, len(packed), _HEAD.size + len(records))
    return b"".join([_HEAD.pack(*head), records, sizes, *packed])


def to_version_3(content: bytes, name: str) -> tuple[bytes, list[str]]:
    """Convert a file of version 4 to version 3, compressed by gzip, and return it with our comments.

    Raises:
        DataError: the file is not valid, has other axes than a `.ply` or exceeds memory, or numcodecs is missing.
    """
    try:
        _, version, count, degree, fraction, flags, streams, table = _HEAD.unpack_from(content)
    except struct.error:
        raise DataError(f"{name}: {len(content)} bytes; expected an .spz of version 4, whose header has 32") from None
    lengths = _lengths(count, degree) if degree in _COEFFICIENTS else []
    if version != 4 or streams != len(lengths) or not _HEAD.size <= table <= len(content) - streams * _SIZES.size:
        raise DataError(
            f"{name}: version {version}, degree {degree}, {streams} streams, table at {table} of {len(content)} bytes; "
            "expected an .spz of version 4 with harmonics of degree 0 to 4"
        )
    check_memory(ROW_BYTES * count, f"{name}: {count:,} Gaussians", "a standard .ply, which is mapped, not loaded")
    zstd, start, body = zstandard(name), table + streams * _SIZES.size, []
    for number, length in enumerate(lengths):
        size, whole = _SIZES.unpack_from(content, table + number * _SIZES.size)
        part = content[start : start + size]
        if whole != length or len(part) != size:
            raise DataError(f"{name}: stream {number} is {whole} bytes in {len(part)}; expected {length} in {size}")
        with library_errors(name, "an .spz of version 4"):
            body.append(_unpacked(zstd, part, length, f"{name}: stream {number}"))
        start += size
    comments: list[str] = []
    for kind, payload in _records(content[_HEAD.size : table] if flags & _RECORDS else b"", name):
        if kind == COMMENTS:
            comments = payload.decode("ascii", "replace").splitlines()
        if kind == AXES and payload[:1] != bytes([RIGHT_DOWN_FRONT]):
            raise DataError(f"{name}: axes of kind {payload[:1].hex()}; expected right, down, front as in a .ply (06)")
    if degree > 3:
        warnings.warn(f"{name}: harmonics of degree 4 are left out", stacklevel=2)
        degree, body[-1] = 3, np.frombuffer(body[-1], "u1").reshape(count, -1)[:, : 3 * HARMONICS[3]].tobytes()
    front = _OLD.pack(MAGIC, 3, count, degree, fraction, flags & 1)
    return gzip.compress(front + b"".join(body), 1, mtime=0), comments


def _unpacked(zstd: Any, part: bytes, length: int, name: str) -> bytes:
    """Decompress a stream; raise DataError below ``length`` bytes, seen by the unchanged end of the buffer."""
    for before in (b"\0", b"\xff"):
        content = bytes(zstd.decompress(part, bytearray(before * length)))
        if content[-1:] != before:
            return content
    raise DataError(f"{name}: truncated; expected {length} bytes by the file's table")


def _records(zone: bytes, name: str) -> Iterator[tuple[int, bytes]]:
    start = 0
    while start < len(zone):
        left = len(zone) - start
        kind, length = _RECORD.unpack_from(zone, start) if left >= _RECORD.size else (0, left)
        if _RECORD.size + length > left:
            raise DataError(f"{name}: a record of {length} bytes; expected at most {left}, which remain in the file")
        start += _RECORD.size + length
        yield kind, zone[start - length : start]
