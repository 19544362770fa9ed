"""Sizes that a CZI file states, compared with the file and with memory before libCZI sets memory aside for them.

Format: "ZEN File Format for CZI", version 1.2.2, chapter 3 (segments, directory entries of schema DV).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory, size_text
from vvgt_cli.volume.channels import MAX_XML, Bounded

SEGMENT = struct.Struct("<16sqq")  # name, bytes set aside, bytes used
HEADER = struct.Struct("<iiii16s16siqqiq")  # the 8th and 9th: where directory and metadata are
ENTRY, DIMENSION = struct.Struct("<2siqiiB5si"), struct.Struct("<4siifi")
DATA = struct.Struct("<iiq")  # of a subblock: metadata, attachment, pixels
LISTING = 128  # bytes before the entries of a directory
WIDEST = 16  # bytes of a pixel


def check_segments(path: Path) -> None:
    """Refuse segments that reach beyond the file, and tiles beyond the memory.

    Raises:
        DataError: such.
    """
    size = path.stat().st_size
    with Bounded(path) as file:

        def take(form: struct.Struct, place: int, what: str) -> tuple[Any, ...]:
            if not 0 <= place <= size - form.size:
                raise DataError(f"{path}: {what} at byte {place} of {size}; check that the CZI file is whole")
            file.seek(place)
            return form.unpack(file.read(form.size))

        head = take(HEADER, SEGMENT.size, "its header")
        listing, metadata = head[7], head[8]
        if metadata:
            (length,) = take(struct.Struct("<i"), metadata + SEGMENT.size, "metadata")
            _fits(path, size, metadata + SEGMENT.size, length, "metadata")
            if length > MAX_XML:
                raise DataError(f"{path}: metadata of {size_text(length)}; expected at most {size_text(MAX_XML)}")
        _, _, used = take(SEGMENT, listing, "a directory of tiles")
        _fits(path, size, listing, used, "the directory of tiles")
        (count,) = take(struct.Struct("<i"), listing + SEGMENT.size, "a directory of tiles")
        _fits(path, size, listing, count * ENTRY.size, "the directory of tiles")
        place = listing + SEGMENT.size + LISTING
        for _ in range(count):
            _, _, tile, _, _, _, _, axes = take(ENTRY, place, "an entry of the directory")
            place += ENTRY.size
            _fits(path, size, place, axes * DIMENSION.size, "an entry of the directory")
            pixels = WIDEST
            for _ in range(axes):
                name, _, extent, _, stored = take(DIMENSION, place, "an axis of a tile")
                place += DIMENSION.size
                if name[:1] in (b"X", b"Y"):
                    pixels *= max(extent, stored, 1)
            if tile < 0 or tile > size:
                raise DataError(f"{path}: a tile at byte {tile} of {size}; check that the CZI file is whole")
            check_memory(pixels, f"{path}: a tile")
            for length in take(DATA, tile + SEGMENT.size, "a tile"):
                _fits(path, size, tile + SEGMENT.size, length, "a tile")


def _fits(path: Path, size: int, place: int, length: int, what: str) -> None:
    if not 0 <= length <= size - place:
        raise DataError(f"{path}: {what} of {length} bytes at byte {place} of {size}; check that the file is whole")
