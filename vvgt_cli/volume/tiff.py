"""TIFF stacks (``.tif``, ``.tiff``), one page a slice, read with OpenImageIO.

The directories are walked first: the pages must agree, and their sizes are checked against the file. Pixels are
decoded by OpenImageIO because VTK's reader takes only 8- and 16-bit unsigned and 32-bit float pages, and returns the
pages before the damage of a damaged file as if that were all.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory, size_text
from vvgt_cli.volume.components import select_component
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.registry import Reader, register, volume_name
from vvgt_cli.volume.types import Volume

SUFFIXES = (".tif", ".tiff")
_WIDTH, _HEIGHT, _BITS, _SAMPLES, _SUBFILE = 256, 257, 258, 277, 254
_FIELD = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q"}
_MAX_PAGES = 1 << 20
_MAX_RATIO = 1 << 15  # fax codes blank pages in next to nothing; deflate is at 1032


@dataclass(frozen=True)
class _Page:
    width: int
    height: int
    bits: int
    samples: int


def pages(path: Path) -> list[_Page | None]:
    """The page sizes from the file's directories; None for a page that is a thumbnail or a mask.

    Raises:
        DataError: a directory outside the file or in a circle.
    """
    with open(path, "rb") as file:
        head = file.read(16)
        order = "<" if head[:2] == b"II" else ">"
        (version,) = struct.unpack_from(order + "H", head, 2)
        big = version == 43
        (offset,) = struct.unpack_from(order + ("Q" if big else "I"), head, 8 if big else 4)
        number, entry, link = ("Q", "HHQ8s", "Q") if big else ("H", "HHI4s", "I")
        found: list[_Page | None] = []
        seen: set[int] = set()
        while offset:
            if offset in seen or len(seen) >= _MAX_PAGES:
                raise DataError(f"{path}: page {len(seen)} of the TIFF file points back to an earlier one")
            seen.add(offset)
            file.seek(offset)
            (n,) = struct.unpack(order + number, file.read(struct.calcsize(number)))
            step = struct.calcsize("<" + entry)
            table = file.read(min(n, 4096) * step)
            found.append(_page(table, order, entry, step, file))
            file.seek(offset + struct.calcsize(number) + n * step)
            (offset,) = struct.unpack(order + link, file.read(struct.calcsize(link)))
    return found


def _page(table: bytes, order: str, entry: str, step: int, file: object) -> _Page | None:
    tags: dict[int, int] = {}
    for at in range(0, len(table) - step + 1, step):
        tag, kind, _n, value = struct.unpack_from(order + entry, table, at)
        if kind in _FIELD:
            tags[tag] = struct.unpack_from(order + _FIELD[kind], value)[0]
    if tags.get(_SUBFILE, 0) & 5:
        return None
    samples = tags.get(_SAMPLES, 1)
    # BitsPerSample lies elsewhere in the file when there are several: 8 is the least that matters for a size check.
    bits = tags.get(_BITS, 1) if samples <= 2 else 8
    return _Page(tags.get(_WIDTH, 0), tags.get(_HEIGHT, 0), bits, samples)


def read_tiff(path: Path, options: ReadOptions) -> Volume:
    """Read a TIFF stack: page k is slice z = k, rows from the top are y. Resolution tags are not spacing.

    Raises:
        DataError: pages of different sizes, damaged pages, or sizes that the file cannot hold.
        UsageError: colour pages and no component chosen.
    """
    try:
        found = pages(path)
    except struct.error as error:
        raise DataError(f"{path}: its TIFF directories are cut short; check that the file is whole") from error
    wanted = [k for k, page in enumerate(found) if page is not None]
    sizes = {(p.width, p.height, p.samples) for p in found if p is not None}
    if len(sizes) != 1:
        raise DataError(f"{path}: pages of {len(sizes)} sizes {sorted(sizes)[:4]}; expected slices of one size")
    width, height, samples = sizes.pop()
    if min(width, height, samples) < 1:
        raise DataError(f"{path}: pages of {width} x {height} pixels with {samples} samples; expected at least 1")
    file_size = path.stat().st_size
    least = width * height * samples * len(wanted)
    if least > file_size * _MAX_RATIO:
        raise DataError(f"{path}: {size_text(file_size)} cannot hold {len(wanted)} pages of {width} x {height} pixels")
    values = _decode(path, wanted, (height, width, samples))
    field, _ = select_component(values, options.component, str(path), label="each page")
    return Volume(field, options.spacing_or((1.0, 1.0, 1.0)), name=volume_name(path))


def _decode(path: Path, wanted: list[int], shape: tuple[int, int, int]) -> np.ndarray:
    """(pages, height, width, samples) by OpenImageIO, in the file's own type."""
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # numbers as stored, not multiplied by alpha
    config.attribute("oiio:RawColor", 1)
    image = oiio.ImageInput.open(str(path), config)
    if image is None:
        raise DataError(f"{path}: cannot be read as TIFF ({_one_line(oiio.geterror())})")
    out: np.ndarray | None = None
    try:
        for z, page in enumerate(wanted):
            spec = image.spec() if image.seek_subimage(page, 0) else None
            if spec is not None and (spec.height, spec.width, spec.nchannels) != shape:
                raise DataError(
                    f"{path}: page {page} is {spec.width} x {spec.height} x {spec.nchannels} when decoded; expected "
                    f"{shape[1]} x {shape[0]} x {shape[2]} (palettes are not scalars: convert to grey first)"
                )
            pixels = None if spec is None else image.read_image(page, 0, 0, spec.nchannels, spec.format)
            if pixels is None:
                raise DataError(f"{path}: page {page} is damaged ({_one_line(image.geterror())})")
            if out is None:
                check_memory(len(wanted) * pixels.nbytes, str(path))
                out = np.empty((len(wanted), *shape), pixels.dtype)
            if pixels.dtype != out.dtype:
                raise DataError(f"{path}: page {page} has type {pixels.dtype}, the first one {out.dtype}")
            out[z] = pixels.reshape(shape)
    finally:
        image.close()
    if out is None:
        raise DataError(f"{path}: a TIFF file without pages")
    return out


def _one_line(text: str) -> str:
    return " ".join(text.split())[:200] or "no message"


def _sniff(head: bytes) -> bool:
    return head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


register(Reader("TIFF", SUFFIXES, _sniff, read_tiff))
