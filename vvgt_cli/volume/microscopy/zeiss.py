"""Zeiss (``.czi``): one scene of a file, tile by tile; tiles of a mosaic are put together.

libCZI (pylibCZIrw) is not used, as damaged files can end the process in it, and czifile of 2019, as it knows no
Zstandard (docs/log/readers.md).
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.libraries import library_errors
from vvgt_cli.volume.microscopy.image import Box, Color, Picture, choose_image, hex_color, picture_volume, safe_xml
from vvgt_cli.volume.microscopy.zeiss_tiles import PIXELS, SPARSE, Tile, pixels_of, tiles_of
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import volume_name
from vvgt_cli.volume.types import Volume

MICROMETRE = 1e-6
TILE = 512  # pixels along the edge of what is read together, at least


def read_czi(path: Path, options: ReadOptions) -> Volume:
    """Read one scene of a CZI file; spacing in micrometres.

    Raises:
        DataError: a damaged file, axes or pixels that are none of a volume, more pixels than tiles can fill.
        UsageError: several scenes, channels or time steps and none chosen.
    """
    with library_errors(str(path), "CZI"):
        every, xml = tiles_of(path)
        scene, tiles = _scene(every, options, path)
        ends = {
            a: (min(t.at.get(a, 0) for t in tiles), max(t.at.get(a, 0) for t in tiles)) for t in tiles for a in t.at
        }
        odd = [a for a, (lo, hi) in ends.items() if a not in "TCZMS" and hi > lo]
        kinds = {tile.pixel for tile in tiles}
        if odd or len(kinds) != 1 or not kinds <= set(PIXELS):
            raise DataError(
                f"{path}: axes {', '.join(sorted(ends))} (several along {', '.join(odd) or 'none'}), "
                f"pixels of types {sorted(kinds)}; expected several of T, C and Z at most, and one of {sorted(PIXELS)}"
            )
        dtype, samples = PIXELS[kinds.pop()]
        x, y = min(t.x for t in tiles), min(t.y for t in tiles)
        width, height = max(t.x + t.width for t in tiles) - x, max(t.y + t.height for t in tiles) - y
        times, channels, slices = (ends[a][1] - ends[a][0] + 1 if a in ends else 1 for a in "TCZ")
        filled = sum(t.width * t.height for t in tiles)
        if times * channels * slices * width * height > SPARSE * filled:
            raise DataError(f"{path}: tiles of {filled} pixels far apart; check that the CZI file is whole")
        spacing, names, colors = _metadata(xml, channels, path)
        first = {a: ends[a][0] for a in "TCZ" if a in ends}
        read = partial(_read, path, _by_plane(tiles, first), (x, y), samples, np.dtype(dtype))
        chunk = max(TILE, max(t.height for t in tiles)), max(TILE, max(t.width for t in tiles))
        picture = Picture(
            times, channels * samples, (slices, height, width), np.dtype(dtype), read, (1, *chunk), spacing,
            names=names if samples == 1 else (), colors=colors, rgb=samples > 1 and channels == 1,
        )  # fmt: skip
        name = volume_name(path) + ("" if scene is None else f":{scene}")
        return picture_volume(picture, options, str(path), name)


def _scene(tiles: list[Tile], options: ReadOptions, path: Path) -> tuple[int | None, list[Tile]]:
    """Return the number of the scene asked for, None where there is one, and its tiles."""
    found: dict[int, list[Tile]] = {}
    for tile in tiles:
        found.setdefault(tile.at.get("S", 0), []).append(tile)
    keys = sorted(found)
    facts = [
        f"{max(t.x + t.width for t in found[k]) - min(t.x for t in found[k])} x "
        f"{max(t.y + t.height for t in found[k]) - min(t.y for t in found[k])} pixels"
        for k in keys
    ]
    number = choose_image([f"scene {k}" for k in keys], facts, options.array, "scenes", str(path))
    return keys[number] if len(keys) > 1 else None, found[keys[number]]


Planes = dict[tuple[int, ...], list[Tile]]


def _by_plane(tiles: list[Tile], first: dict[str, int]) -> Planes:
    """Group the tiles by (time, channel, slice), those that lie above others last."""
    planes: Planes = {}
    for tile in sorted(tiles, key=lambda t: t.at.get("M", 0)):
        key = tuple(tile.at.get(a, 0) - first.get(a, 0) for a in "TCZ")
        planes.setdefault(key, []).append(tile)
    return planes


def _read(
    path: Path,
    planes: Planes,
    corner: tuple[int, int],
    samples: int,
    dtype: np.dtype,
    time: int,
    channel: int,
    box: Box,
) -> np.ndarray:
    """Read a box, 0 where no tile is. Samples of colours are blue first in the file."""
    z, y, x = box
    number, sample = divmod(channel, samples)
    sample = 2 - sample if sample < 3 and samples > 1 else sample
    out = np.zeros([k.stop - k.start for k in box], dtype)
    for k in range(z.start, z.stop):
        for tile in planes.get((time, number, k), ()):
            left, top = tile.x - corner[0], tile.y - corner[1]
            x0, x1 = max(left, x.start), min(left + tile.width, x.stop)
            y0, y1 = max(top, y.start), min(top + tile.height, y.stop)
            if x0 < x1 and y0 < y1:
                found = pixels_of(tile, path)[y0 - top : y1 - top, x0 - left : x1 - left, sample]
                out[k - z.start, y0 - y.start : y1 - y.start, x0 - x.start : x1 - x.start] = found
    return out


def _metadata(xml: str, channels: int, path: Path) -> tuple[Any, list[str], list[Color]]:
    """Return spacing (x, y, z) in micrometres, and names and colours of the channels."""
    root = safe_xml(xml, str(path)) if xml.strip() else None
    if root is None:
        return (None, None, None), [], []
    spacing = {d.get("Id"): _micrometres(d.findtext("Value")) for d in root.findall(".//Scaling/Items/Distance")}
    found = root.findall(".//Information/Image/Dimensions/Channels/Channel")[:channels]
    shown = root.findall(".//DisplaySetting/Channels/Channel")
    display = {c.get("Id"): c.findtext("Color") for c in shown}
    names = [c.get("Name") or "" for c in found]
    colors = [hex_color(display.get(c.get("Id")) or c.findtext("Color")) for c in found]
    if len(found) != channels:
        names, colors = [], []
    return tuple(spacing.get(a) for a in "XYZ"), names, colors


def _micrometres(text: str | None) -> float | None:
    """Convert a length in metres, as text, to micrometres; None where there is none or it is not positive."""
    value = float(text or "nan") / MICROMETRE
    return float(f"{value:.12g}") if math.isfinite(value) and value > 0 else None
