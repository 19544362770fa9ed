"""Blocks of values in OpenVDB files: plain, zlib, and Blosc 1 with LZ4, the only coder that OpenVDB asks it for.

Lengths come from the caller; what the file says is compared with them before anything is unpacked.
Formats: openvdb/io/Compression.h; Blosc 1, README_CHUNK_FORMAT.rst.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import unpack

ZIP, ACTIVE_MASK, BLOSC = 1, 2, 4
_LZ4 = 1
_MAX_SPLITS, _MIN_SPLIT = 16, 128  # blosc.c


def read_block(cursor: Cursor, need: int, compression: int) -> bytes | memoryview:
    """Read the next ``need`` bytes of values; raise DataError for another length, or damage."""
    if not compression & (ZIP | BLOSC):
        return cursor.take(need)
    (packed,) = cursor.unpack("q")
    if packed <= 0:  # what does not get smaller is stored plainly, its length negated
        if -packed != need:
            raise cursor.bad(f"a block of {-packed} bytes where {need} are expected")
        return cursor.take(need)
    data = cursor.take(packed)
    out = _unblosc(data, need, cursor) if compression & BLOSC else _unzip(data, need, cursor)
    if len(out) != need:
        raise cursor.bad(f"a compressed block holds {len(out)} bytes where {need} are expected")
    return out


def _unzip(data: memoryview, need: int, cursor: Cursor) -> bytes:
    try:
        return unpack("zlib", data, need + 1)
    except zlib.error as error:
        raise cursor.bad(f"damaged ZIP data ({error})") from error


def _unblosc(data: memoryview, need: int, cursor: Cursor) -> bytes:
    if len(data) < 16:
        raise cursor.bad("a Blosc block shorter than its header")
    _, _, flags, typesize, nbytes, blocksize, cbytes = struct.unpack_from("<4B3I", data)
    if nbytes != need or cbytes != len(data):
        raise cursor.bad(f"a Blosc block of {cbytes} for {nbytes} bytes where {len(data)} for {need} are expected")
    if flags & 2:
        return bytes(data[16 : 16 + need])
    if flags >> 5 != _LZ4 or flags & 4 or typesize < 1 or not 1 <= blocksize <= need:
        raise cursor.bad(f"Blosc flags {flags:#x}, block size {blocksize}; expected LZ4 with or without byte shuffle")
    count = -(-need // blocksize)
    starts = struct.unpack_from(f"<{count}I", data, 16) if 16 + 4 * count <= len(data) else ()
    if len(starts) != count:
        raise cursor.bad("a Blosc block without its table")
    parts = []
    for number, start in enumerate(starts):
        length = min(blocksize, need - number * blocksize)
        whole = length == blocksize
        splits = typesize if not flags & 16 and whole and typesize <= _MAX_SPLITS else 1
        if splits > 1 and (blocksize // typesize < _MIN_SPLIT or length % typesize):
            splits = 1
        block = _unsplit(data, start, length, splits, cursor)
        parts.append(_unshuffle(block, typesize) if flags & 1 and typesize > 1 else block)
    return b"".join(parts)


def _unsplit(data: memoryview, start: int, length: int, splits: int, cursor: Cursor) -> bytes:
    """Decompress one block of ``length`` bytes: streams of equal lengths, each behind its compressed length."""
    import lz4.block

    each, out = length // splits, []
    for _ in range(splits):
        size = struct.unpack_from("<i", data, start)[0] if start + 4 <= len(data) else -1
        start += 4
        if size < 0 or start + size > len(data):
            raise cursor.bad("a Blosc block that leaves its bounds")
        stream = data[start : start + size]
        start += size
        if size == each:
            out.append(bytes(stream))
            continue
        try:
            out.append(lz4.block.decompress(stream, uncompressed_size=each))
        except lz4.block.LZ4BlockError as error:
            raise cursor.bad(f"damaged LZ4 data ({error})") from error
        if len(out[-1]) != each:
            raise cursor.bad(f"LZ4 data of {len(out[-1])} bytes where {each} are expected")
    return b"".join(out)


def _unshuffle(block: bytes, typesize: int) -> bytes:
    """Undo the byte shuffle: first bytes of all values, then the second ones; the rest stays as it is."""
    n = len(block) // typesize
    body = np.frombuffer(block, np.uint8, n * typesize).reshape(typesize, n).T.tobytes()
    return body + block[n * typesize :]


class Cursor:
    """A position in ``data`` that moves as things are taken.

    Attributes:
        at: bytes from the start.
        name: the file, for messages.
    """

    def __init__(self, data: memoryview, name: str) -> None:
        """Begin at the start of ``data``."""
        self.data, self.name, self.at = data, name, 0

    def bad(self, what: str) -> DataError:
        """Make the error for what was found here."""
        return DataError(f"{self.name}: {what} (near byte {self.at}); check that the file is whole")

    def take(self, n: int) -> memoryview:
        """Take the next ``n`` bytes; raise DataError if there are fewer."""
        if not 0 <= n <= len(self.data) - self.at:
            raise self.bad(f"{n} bytes are expected, {len(self.data) - self.at} are left")
        self.at += n
        return self.data[self.at - n : self.at]

    def unpack(self, form: str) -> tuple[Any, ...]:
        """Take the next little-endian numbers, by a format of `struct`."""
        return struct.unpack("<" + form, self.take(struct.calcsize("<" + form)))

    def text(self) -> str:
        """Take a string behind its length."""
        (n,) = self.unpack("I")
        return str(self.take(n), "utf-8", "replace")

    def seek(self, at: int) -> None:
        """Move to ``at``; raise DataError if it is outside the file."""
        if not 0 <= at <= len(self.data):
            raise self.bad(f"an offset of {at} in a file of {len(self.data)} bytes")
        self.at = at
