"""Zeiss (``.czi``): one scene of a file, tile by tile; tiles of a mosaic are put together.

libCZI (pylibCZIrw) is not used, as damaged files can end the process in it, and czifile of 2019, as it knows no
Zstandard (docs/log/readers.md).

Format: "ZEN File Format for CZI", version 1.2.2, chapter 3 (segments, directory entries of schema DV); Zstandard as
https://github.com/ZEISS/libczi has it. All sizes are compared with the file; tiles are unpacked to their size and no
further.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory, size_text
from vvgt_cli.volume.microscopy.image import (
    EXTRA,
    MAX_XML,
    Bounded,
    Color,
    Micrograph,
    choose_image,
    hex_color,
    picture_volume,
    safe_xml,
)
from vvgt_cli.volume.reading import ReadOptions, Slices, Volume, need, volume_name
from vvgt_cli.volume.space import MICROMETRE
from vvgt_cli.volume.stored import put_overlap

SEGMENT = struct.Struct("<16sqq")  # name, bytes set aside, bytes used
HEADER = struct.Struct("<iiii16s16siqqiq")  # the 8th and 9th: where directory and metadata are
ENTRY, DIMENSION = struct.Struct("<2siqiiB5si"), struct.Struct("<4siifi")
DATA = struct.Struct("<iiq")  # of a tile: bytes of metadata, attachment, pixels
LISTING, DETAILS = 128, 256  # bytes before the entries of a directory; of a tile before its metadata, at least
PIXELS = {
    0: ("uint8", 1), 1: ("uint16", 1), 2: ("float32", 1), 3: ("uint8", 3), 4: ("uint16", 3), 8: ("float32", 3),
    9: ("uint8", 4), 12: ("int32", 1), 13: ("float64", 1),
}  # fmt: skip
NONE, JPEG_XR, ZSTD, ZSTD_HEADED = 0, 4, 5, 6
OTHERS = {1: "JPEG", 2: "LZW"}
MAX_SIDE = 1 << 31  # pixels from the first to the last of an axis
SPARSE = 1000  # times as many pixels as all tiles have


@dataclass(frozen=True)
class CziTile:
    """A tile of the finest level.

    Attributes:
        at: first index along axes such as C, Z, T and S; of tiles above each other M counts up.
        x, y, width, height: pixels.
        pixel, compression: numbers of the format.
        place, size: of its bytes in the file.
    """

    at: dict[str, int]
    x: int
    y: int
    width: int
    height: int
    pixel: int
    compression: int
    place: int
    size: int


def tiles_of(path: Path) -> tuple[list[CziTile], str]:
    """Read the tiles and the metadata, XML; raise DataError for segments beyond the file, or impossible numbers."""
    size = path.stat().st_size
    with Bounded(path) as file:

        def take(form: struct.Struct, place: int, what: str) -> tuple[Any, ...]:
            _fits(path, size, place, form.size, what)
            file.seek(place)
            return form.unpack(file.read(form.size))

        head = take(HEADER, SEGMENT.size, "its header")
        listing, metadata, xml = head[7], head[8], ""
        if metadata:
            (length,) = take(struct.Struct("<i"), metadata + SEGMENT.size, "metadata")
            _fits(path, size, metadata + SEGMENT.size + DETAILS, length, "metadata")
            if length > MAX_XML:
                raise DataError(f"{path}: metadata of {size_text(length)}; expected at most {size_text(MAX_XML)}")
            file.seek(metadata + SEGMENT.size + DETAILS)
            xml = file.read(length).rstrip(b"\0").decode("utf-8", "replace")
        name, _, _ = take(SEGMENT, listing, "a directory of tiles")
        (count,) = take(struct.Struct("<i"), listing + SEGMENT.size, "a directory of tiles")
        if name.rstrip(b"\0") != b"ZISRAWDIRECTORY":
            raise DataError(f"{path}: no directory of tiles where its header says; check that the CZI file is whole")
        _fits(path, size, listing, count * ENTRY.size, "the directory of tiles")
        place = listing + SEGMENT.size + LISTING
        tiles = []
        for _ in range(count):
            _, pixel, start, part, compression, _, _, axes = take(ENTRY, place, "an entry of the directory")
            place += ENTRY.size
            _fits(path, size, place, axes * DIMENSION.size, "an entry of the directory")
            dimensions = [take(DIMENSION, place + k * DIMENSION.size, "an axis of a tile") for k in range(axes)]
            place += axes * DIMENSION.size
            if part:
                raise DataError(f"{path}: tiles in other files (part {part}); expected one file: export it as one")
            spans = {
                a.rstrip(b"\0").decode("ascii", "replace"): (first, n, n if kept == 0 else kept)
                for a, first, n, _, kept in dimensions
            }
            if any(n != kept for _, n, kept in spans.values()):
                continue  # of a coarser level
            lengths = take(DATA, start + SEGMENT.size, "a tile")
            begin = start + SEGMENT.size + max(DETAILS, DATA.size + ENTRY.size + axes * DIMENSION.size) + lengths[0]
            _fits(path, size, begin, lengths[2], "a tile")
            _fits(path, size, start, min(lengths), "a tile")
            tiles.append(_tile(spans, (pixel, compression, begin, lengths[2]), path))
    if not tiles:
        raise DataError(f"{path}: no tiles; expected at least one")
    return tiles, xml


def _tile(spans: dict[str, tuple[int, int, int]], facts: tuple[int, int, int, int], path: Path) -> CziTile:
    if not {"X", "Y"} <= set(spans) or any(not (1 <= n < MAX_SIDE and abs(k) < MAX_SIDE) for k, n, _ in spans.values()):
        raise DataError(f"{path}: a tile of {str(spans)[:200]}; expected X and Y of at least one pixel")
    (x, width, _), (y, height, _) = spans["X"], spans["Y"]
    at = {a: first for a, (first, _, _) in spans.items() if a not in "XY"}
    return CziTile(at, x, y, width, height, *facts)


def _fits(path: Path, size: int, place: int, length: int, what: str) -> None:
    if not (place >= 0 and 0 <= length <= size - place):
        raise DataError(f"{path}: {what} of {length} bytes at byte {place} of {size}; check that the CZI file is whole")


def pixels_of(tile: CziTile, path: Path) -> np.ndarray:
    """Read a tile, (height, width, samples), blue first; raise DataError for damage, or an unknown compression."""
    kind, samples = PIXELS[tile.pixel]
    shape, dtype = (tile.height, tile.width, samples), np.dtype(kind).newbyteorder("<")
    need_bytes = tile.height * tile.width * samples * dtype.itemsize
    if tile.compression == NONE:
        if tile.size < need_bytes:
            raise DataError(
                f"{path}: a tile of {tile.size} bytes; {tile.width} x {tile.height} pixels need {need_bytes}"
            )
        return np.memmap(path, dtype, "r", tile.place, shape)
    check_memory(2 * need_bytes, f"{path}: a tile of {tile.width} x {tile.height}")
    with Bounded(path) as file:
        file.seek(tile.place)
        data = file.read(tile.size)
    if tile.compression in (ZSTD, ZSTD_HEADED):
        data = _zstd(data, need_bytes, tile.compression == ZSTD_HEADED, path)
    elif tile.compression == JPEG_XR:
        return _jpeg_xr(data, shape, dtype, path)
    else:
        name = OTHERS.get(tile.compression, f"number {tile.compression}")
        raise DataError(f"{path}: compression {name}; expected none, Zstandard or JPEG XR: export it with one of them")
    return np.frombuffer(data, dtype).reshape(shape)


def _zstd(data: bytes, size: int, headed: bool, path: Path) -> bytes:
    """Decompress Zstandard data, behind a header that may say that high bytes follow all low ones."""
    codec = need("numcodecs.zstd", EXTRA, str(path), "CZI with Zstandard")
    split = False
    if headed:
        length = data[0]
        if length not in (1, 3):
            raise DataError(f"{path}: a Zstandard head of {length} bytes; expected 1 or 3; is the file whole?")
        split = length == 3 and data[1] == 1 and bool(data[2] & 1)
        data = data[length:]
    out = bytearray(size)
    codec.decompress(data, out)
    return np.frombuffer(out, np.uint8).reshape(2, -1).T.tobytes() if split else bytes(out)


def _jpeg_xr(data: bytes, shape: tuple[int, int, int], dtype: np.dtype, path: Path) -> np.ndarray:
    try:
        import imagecodecs
    except ImportError:
        raise DataError(f"{path}: JPEG XR, which needs imagecodecs; try: pip install imagecodecs") from None
    if shape[2] > 1:
        raise DataError(f"{path}: colours in JPEG XR, whose order is not known here; export them as Zstandard")
    return np.asarray(imagecodecs.jpegxr_decode(data)).reshape(shape).astype(dtype, copy=False)


TILE = 512  # pixels along the edge of what is read together, at least


def read_czi(path: Path, options: ReadOptions) -> Volume:
    """Read one scene of a CZI file; spacing in micrometres."""
    every, xml = tiles_of(path)
    scene, tiles = _scene(every, options, path)
    at = {a: [t.at.get(a, 0) for t in tiles] for a in {a for t in tiles for a in t.at}}
    ends = {a: (min(some), max(some)) for a, some in at.items()}
    odd = [a for a, (lo, hi) in ends.items() if a not in "TCZMS" and hi > lo]
    kinds = {tile.pixel for tile in tiles}
    if odd or len(kinds) != 1 or not kinds <= set(PIXELS):
        raise DataError(
            f"{path}: axes {', '.join(sorted(ends))} (several along {', '.join(odd) or 'none'}), "
            f"pixels of types {sorted(kinds)}; expected several of T, C and Z at most, and one of {sorted(PIXELS)}"
        )
    dtype, samples = PIXELS[kinds.pop()]
    x, y, width, height = _bounds(tiles)
    times, channels, slices = (ends[a][1] - ends[a][0] + 1 if a in ends else 1 for a in "TCZ")
    filled = sum(t.width * t.height for t in tiles)
    if times * channels * slices * width * height > SPARSE * filled:
        raise DataError(f"{path}: tiles of {filled} pixels far apart; check that the CZI file is whole")
    spacing, names, colors = _metadata(xml, channels, path)
    first = {a: ends[a][0] for a in "TCZ" if a in ends}
    read = partial(_read, path, _by_plane(tiles, first), (x, y), samples, np.dtype(dtype))
    chunk = max(TILE, max(t.height for t in tiles)), max(TILE, max(t.width for t in tiles))
    picture = Micrograph(
        times, channels * samples, (slices, height, width), np.dtype(dtype), read, (1, *chunk), spacing,
        names=names if samples == 1 else (), colors=colors, rgb=samples > 1 and channels == 1,
    )  # fmt: skip
    name = volume_name(path) + ("" if scene is None else f":{scene}")
    return picture_volume(picture, options, str(path), name)


def _scene(tiles: list[CziTile], options: ReadOptions, path: Path) -> tuple[int | None, list[CziTile]]:
    """Return the number of the scene asked for, None where there is one, and its tiles."""
    scenes: dict[int, list[CziTile]] = {}
    for tile in tiles:
        scenes.setdefault(tile.at.get("S", 0), []).append(tile)
    keys = sorted(scenes)
    facts = ["{2} x {3} pixels".format(*_bounds(scenes[k])) for k in keys]
    number = choose_image([f"scene {k}" for k in keys], facts, options.array, "scenes", str(path))
    return keys[number] if len(keys) > 1 else None, scenes[keys[number]]


def _bounds(tiles: Sequence[CziTile]) -> tuple[int, int, int, int]:
    """Return the left and upper edge of the tiles, and the width and height of all of them together."""
    x, y = min(t.x for t in tiles), min(t.y for t in tiles)
    return x, y, max(t.x + t.width for t in tiles) - x, max(t.y + t.height for t in tiles) - y


Planes = dict[tuple[int, ...], list[CziTile]]


def _by_plane(tiles: list[CziTile], first: dict[str, int]) -> Planes:
    """Group the tiles by (time, channel, slice), those that lie above others last."""
    planes: Planes = {}
    for tile in sorted(tiles, key=lambda t: t.at.get("M", 0)):
        key = tuple(tile.at.get(a, 0) - first.get(a, 0) for a in "TCZ")
        planes.setdefault(key, []).append(tile)
    return planes


def _read(
    path: Path, planes: Planes, corner: tuple[int, int], samples: int, dtype: np.dtype, time: int, channel: int,
    box: Slices,
) -> np.ndarray:  # fmt: skip
    """Read a box, 0 where no tile is. Samples of colours are blue first in the file."""
    z, y, x = box
    number, sample = divmod(channel, samples)
    sample = 2 - sample if sample < 3 and samples > 1 else sample
    out, first = np.zeros([k.stop - k.start for k in box], dtype), [k.start for k in box]
    for k in range(z.start, z.stop):
        for tile in planes.get((time, number, k), ()):
            left, top = tile.x - corner[0], tile.y - corner[1]
            if x.start - tile.width < left < x.stop and y.start - tile.height < top < y.stop:
                put_overlap(out, first, pixels_of(tile, path)[None, ..., sample], (k, top, left))
    return out


def _metadata(xml: str, channels: int, path: Path) -> tuple[Any, list[str], list[Color]]:
    """Return spacing (x, y, z) in micrometres, and names and colours of the channels."""
    root = safe_xml(xml, str(path)) if xml.strip() else None
    if root is None:
        return (None, None, None), [], []
    spacing = {d.get("Id"): _micrometres(d.findtext("Value")) for d in root.findall(".//Scaling/Items/Distance")}
    stated = root.findall(".//Information/Image/Dimensions/Channels/Channel")[:channels]
    stated = stated if len(stated) == channels else []
    display = {c.get("Id"): c.findtext("Color") for c in root.findall(".//DisplaySetting/Channels/Channel")}
    colors = [hex_color(display.get(c.get("Id")) or c.findtext("Color")) for c in stated]
    return tuple(spacing.get(a) for a in "XYZ"), [c.get("Name") or "" for c in stated], colors


def _micrometres(text: str | None) -> float | None:
    """Convert a length in metres, as text, to micrometres; None where there is none or it is not positive."""
    value = float(text or "nan") / MICROMETRE
    return float(f"{value:.12g}") if math.isfinite(value) and value > 0 else None
