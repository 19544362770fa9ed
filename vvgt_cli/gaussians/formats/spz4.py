"""`.spz` of version 4: the streams of version 3, each compressed by Zstandard, after a plain header and records.

The layout follows https://github.com/nianticlabs/spz and its extensions/README.md: 32 bytes of header, records (type,
length, payload) and a table of (compressed, full) sizes. One record holds our comments, another the axes.
"""

from __future__ import annotations

import gzip
import struct
from collections.abc import Iterator
from typing import Any

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.splats import HARMONICS, ROW_BYTES
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.libraries import library_errors, need

MAGIC = b"NGSP"
COMMENTS, AXES = 0x56560001, 0xADBE0003  # types of records: our comments; SPZ_ADOBE_coordinate_system
RIGHT_DOWN_FRONT = 6  # of CoordinateSystem: the axes of a 3DGS .ply
_HEAD = struct.Struct("<4sIIBBBBI12x")  # magic, version, Gaussians, degree, fraction bits, flags, streams, table
_OLD = struct.Struct("<4sIIBBBx")  # of versions 1 to 3
_RECORD, _SIZES = struct.Struct("<II"), struct.Struct("<QQ")
_RECORDS = 2  # flag
_LEVEL = 12  # of Zstandard


def library(source: str) -> Any:
    """Return the module `numcodecs.zstd`.

    Raises:
        DataError: the module is not installed.
    """
    return need("numcodecs.zstd", "share", source, ".spz of version 4")


def _lengths(count: int, degree: int) -> list[int]:
    """Return the sizes in bytes of centres, opacities, colours, scales, rotations and harmonics."""
    return [length * count for length in (9, 1, 3, 3, 4, 3 * HARMONICS[degree]) if length]


def from_version_3(content: bytes, comments: tuple[str, ...], name: str) -> bytes:
    """Convert the uncompressed content of version 3 to a file of version 4, which states the axes of a `.ply`."""
    zstd = library(name)
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
    lengths = _lengths(count, degree) if degree in HARMONICS else []
    if version != 4 or streams != len(lengths) or not _HEAD.size <= table <= len(content) - streams * _SIZES.size:
        raise DataError(
            f"{name}: version {version}, degree {degree}, {streams} streams, table at {table} of {len(content)} bytes; "
            "expected an .spz of version 4 with harmonics of degree 0 to 3"
        )
    check_memory(ROW_BYTES * count, f"{name}: {count:,} Gaussians", "a standard .ply, which is mapped, not loaded")
    zstd, start, body = library(name), table + streams * _SIZES.size, []
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
    front = _OLD.pack(MAGIC, 3, count, degree, fraction, flags & 1)
    return gzip.compress(front + b"".join(body), 1, mtime=0), comments


def _unpacked(zstd: Any, part: bytes, length: int, name: str) -> bytes:
    """Decompress a stream.

    Raises:
        DataError: it has fewer bytes than ``length``, detected by the end of the buffer, which stays unchanged.
    """
    for before in (b"\0", b"\xff"):
        found = bytes(zstd.decompress(part, bytearray(before * length)))
        if found[-1:] != before:
            return found
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
