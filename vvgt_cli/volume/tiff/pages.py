"""Checks of the directories of a TIFF file, before a library reads them."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import size_text

_WIDTH, _HEIGHT, _BITS, _SAMPLES, _DEPTH = 256, 257, 258, 277, 32997
_FIELD = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q"}
_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
MAX_PAGES = 1 << 20
_MAX_RATIO = 1 << 15  # fax codes blank pages in next to nothing; deflate is at 1032


@dataclass(frozen=True)
class _Layout:
    """A file being walked: its byte order, the forms of a directory's parts, and its size."""

    path: Path
    order: str
    number: str
    entry: str
    link: str
    size: int


def check_pages(path: Path) -> int:
    """Count the pages of a file; raise DataError unless its directories, tags and pixels fit into it."""
    try:
        with open(path, "rb") as file:
            return _walk(file, path)
    except struct.error as error:
        raise DataError(f"{path}: its TIFF directories are cut short; check that the file is whole") from error


def _walk(file: BinaryIO, path: Path) -> int:
    head = file.read(16)
    order = "<" if head[:2] == b"II" else ">"
    (version,) = struct.unpack_from(order + "H", head, 2)
    big = version == 43
    (offset,) = struct.unpack_from(order + ("Q" if big else "I"), head, 8 if big else 4)
    forms = ("Q", "HHQ8s", "Q") if big else ("H", "HHI4s", "I")
    layout = _Layout(path, order, *forms, path.stat().st_size)
    seen: set[int] = set()
    least = 0
    while offset:
        if offset in seen or len(seen) >= MAX_PAGES:
            raise DataError(f"{path}: page {len(seen)} of the TIFF file points back to an earlier one")
        seen.add(offset)
        file.seek(offset)
        (n,) = struct.unpack(order + layout.number, file.read(struct.calcsize(layout.number)))
        step = struct.calcsize("<" + layout.entry)
        least += _page_bytes(file.read(min(n, 4096) * step), layout, len(seen) - 1)
        file.seek(offset + struct.calcsize(layout.number) + n * step)
        (offset,) = struct.unpack(order + layout.link, file.read(struct.calcsize(layout.link)))
    if not seen:
        raise DataError(f"{path}: a TIFF file without pages")
    if least > layout.size * _MAX_RATIO:
        raise DataError(f"{path}: {size_text(layout.size)} cannot hold its {len(seen)} pages of {size_text(least)}")
    return len(seen)


def _page_bytes(table: bytes, layout: _Layout, page: int) -> int:
    """Return the least number of bytes that the pixels of a page take."""
    tags: dict[int, int] = {}
    step = struct.calcsize("<" + layout.entry)
    for at in range(0, len(table) - step + 1, step):
        tag, kind, n, value = struct.unpack_from(layout.order + layout.entry, table, at)
        if n * _BYTES.get(kind, 1) > layout.size:
            raise DataError(
                f"{layout.path}: page {page}: {n} values of tag {tag} in a file of {size_text(layout.size)}"
            )
        if kind in _FIELD and n:
            tags[tag] = struct.unpack_from(layout.order + _FIELD[kind], value)[0]
    samples = tags.get(_SAMPLES, 1)
    # BitsPerSample lies elsewhere in the file when there are several: 8 is the least that matters for a size check.
    bits = tags.get(_BITS, 1) if samples <= 2 else 8
    width, height = tags.get(_WIDTH, 0), tags.get(_HEIGHT, 0)
    if min(width, height, samples) < 1:
        raise DataError(
            f"{layout.path}: page {page} of {width} x {height} pixels with {samples} samples; expected at least 1"
        )
    return width * height * samples * max(tags.get(_DEPTH, 1), 1) * max(bits, 1) // 8
