"""Checks of the directories of a TIFF file, before a library reads them."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import size_text

_WIDTH, _HEIGHT, _BITS, _SAMPLES, _DEPTH = 256, 257, 258, 277, 32997
_FIELD = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q"}
_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
MAX_PAGES = 1 << 20
_MAX_RATIO = 1 << 15  # fax codes blank pages in next to nothing; deflate is at 1032


def check_pages(path: Path) -> int:
    """Count the pages of a file; raise DataError unless its directories, tags and pixels fit into it."""
    try:
        with open(path, "rb") as file:
            return _walk(file, path)
    except struct.error as error:
        raise DataError(f"{path}: its TIFF directories are cut short; check that the file is whole") from error


def _walk(file: BinaryIO, path: Path) -> int:
    head, size = file.read(16), path.stat().st_size
    order = "<" if head[:2] == b"II" else ">"
    (version,) = struct.unpack_from(order + "H", head, 2)
    big = version == 43
    (offset,) = struct.unpack_from(order + ("Q" if big else "I"), head, 8 if big else 4)
    forms = ("Q", "HHQ8s", "Q") if big else ("H", "HHI4s", "I")
    number, entry, link = (struct.Struct(order + form) for form in forms)
    seen: set[int] = set()
    least = 0
    while offset:
        if offset in seen or len(seen) >= MAX_PAGES:
            raise DataError(f"{path}: page {len(seen)} of the TIFF file points back to an earlier one")
        file.seek(offset)
        (n,) = number.unpack(file.read(number.size))
        rows = list(entry.iter_unpack(file.read(min(n, 4096) * entry.size)))
        least += _page_bytes(rows, order, size, f"{path}: page {len(seen)}")
        seen.add(offset)
        file.seek(offset + number.size + n * entry.size)
        (offset,) = link.unpack(file.read(link.size))
    if not seen:
        raise DataError(f"{path}: a TIFF file without pages")
    if least > size * _MAX_RATIO:
        raise DataError(f"{path}: {size_text(size)} cannot hold its {len(seen)} pages of {size_text(least)}")
    return len(seen)


def _page_bytes(rows: list[tuple[int, int, int, bytes]], order: str, size: int, page: str) -> int:
    """Return the least number of bytes that the pixels of a page take, by its tags, in a file of ``size`` bytes."""
    tags: dict[int, int] = {}
    for tag, kind, n, value in rows:
        if n * _BYTES.get(kind, 1) > size:
            raise DataError(f"{page}: {n} values of tag {tag} in a file of {size_text(size)}")
        if kind in _FIELD and n:
            tags[tag] = struct.unpack_from(order + _FIELD[kind], value)[0]
    samples = tags.get(_SAMPLES, 1)
    # BitsPerSample lies elsewhere in the file when there are several: 8 is the least that matters for a size check.
    bits = tags.get(_BITS, 1) if samples <= 2 else 8
    width, height = tags.get(_WIDTH, 0), tags.get(_HEIGHT, 0)
    if min(width, height, samples) < 1:
        raise DataError(f"{page} of {width} x {height} pixels with {samples} samples; expected at least 1")
    return width * height * samples * max(tags.get(_DEPTH, 1), 1) * max(bits, 1) // 8
