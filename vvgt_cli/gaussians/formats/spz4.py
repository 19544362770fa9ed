"""`.spz` of version 4: the streams of version 3, each packed by Zstandard, behind a header and records in the clear.

As https://github.com/nianticlabs/spz and its extensions/README.md have it: 32 bytes of header, records (type, length,
payload) and a table of (packed, whole) sizes. Our comments are one record, the axes another.
"""

from __future__ import annotations

import gzip
import struct
from collections.abc import Iterator
from typing import Any

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.splats import A_ROW, HARMONICS
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
    """The module `numcodecs.zstd`.

    Raises:
        DataError: it is not installed.
    """
    return need("numcodecs.zstd", "share", source, ".spz of version 4")


def _lengths(count: int, degree: int) -> list[int]:
    """Bytes of centres, opacities, colours, sizes, rotations and harmonics."""
    return [length * count for length in (9, 1, 3, 3, 4, 3 * HARMONICS[degree]) if length]


def from_version_3(content: bytes, comments: tuple[str, ...], name: str) -> bytes:
    """A file of version 4 that holds what one of version 3 does, unpacked, and says that its axes are a `.ply`'s."""
    zstd = library(name)
    _, _, count, degree, fraction, flags = _OLD.unpack_from(content)
    records = _RECORD.pack(AXES, 4) + struct.pack("<I", RIGHT_DOWN_FRONT)
    said = "\n".join(comments).encode("ascii", "replace")
    records += _RECORD.pack(COMMENTS, len(said)) + said if said else b""
    packed, sizes, start = [], b"", _OLD.size
    for length in _lengths(count, degree):
        packed.append(bytes(zstd.compress(content[start : start + length], _LEVEL)))
        sizes += _SIZES.pack(len(packed[-1]), length)
        start += length
    head = (MAGIC, 4, count, degree, fraction, flags | _RECORDS, len(packed), _HEAD.size + len(records))
    return b"".join([_HEAD.pack(*head), records, sizes, *packed])


def to_version_3(content: bytes, name: str) -> tuple[bytes, list[str]]:
    """What a file of version 3 would hold, packed by gzip, and our comments.

    Raises:
        DataError: not such a file, other axes than a `.ply`'s, no Zstandard here, or more than memory holds.
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
    check_memory(A_ROW * count, f"{name}: {count:,} Gaussians", "a standard .ply, which is mapped, not loaded")
    zstd, start, body = library(name), table + streams * _SIZES.size, []
    for number, length in enumerate(lengths):
        size, whole = _SIZES.unpack_from(content, table + number * _SIZES.size)
        part = content[start : start + size]
        if whole != length or len(part) != size:
            raise DataError(f"{name}: stream {number} of {whole} bytes in {len(part)}; expected {length} in {size}")
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
    """What a stream holds.

    Raises:
        DataError: fewer bytes than ``length``, of which the last would stay as they were.
    """
    for before in (b"\0", b"\xff"):
        found = bytes(zstd.decompress(part, bytearray(before * length)))
        if found[-1:] != before:
            return found
    raise DataError(f"{name}: less than the {length} bytes that its table says; is the file whole?")


def _records(zone: bytes, name: str) -> Iterator[tuple[int, bytes]]:
    start = 0
    while start < len(zone):
        left = len(zone) - start
        kind, length = _RECORD.unpack_from(zone, start) if left >= _RECORD.size else (0, left)
        if _RECORD.size + length > left:
            raise DataError(f"{name}: a record of {length} bytes where {left} are left; is the file whole?")
        start += _RECORD.size + length
        yield kind, zone[start - length : start]
