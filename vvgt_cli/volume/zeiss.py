"""Zeiss (``.czi``): one scene of a file, region by region; tiles of a mosaic are put together. Read by pylibCZIrw."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.channels import (
    EXTRA,
    Box,
    Color,
    Picture,
    choose_image,
    hex_color,
    picture_volume,
    safe_xml,
)  # fmt: skip
from vvgt_cli.volume.libraries import library_errors, need
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import Reader, register, volume_name
from vvgt_cli.volume.types import Volume
from vvgt_cli.volume.zeiss_segments import check_segments

MICROMETRE = 1e-6
PIXELS = {
    "Gray8": ("uint8", 1), "Gray16": ("uint16", 1), "Gray32Float": ("float32", 1), "Bgr24": ("uint8", 3),
    "Bgr48": ("uint16", 3), "Bgra32": ("uint8", 4),
}  # fmt: skip
TILE = 512  # pixels along the edge of what is read together
MOST = 1 << 31  # of an axis


def read_czi(path: Path, options: ReadOptions) -> Volume:
    """Read one scene of a CZI file; spacing in micrometres.

    Raises:
        DataError: pylibCZIrw is not installed, a damaged file, axes or pixels that are none of a volume.
        UsageError: several scenes, channels or time steps and none chosen.
    """
    czi = need("pylibCZIrw.czi", EXTRA, str(path), "CZI")
    check_segments(path)
    with library_errors(str(path), "CZI"), czi.open_czi(str(path)) as file:
        box = {str(a): (int(b), int(e)) for a, (b, e) in file.total_bounding_box_no_pyramid.items()}
        odd = [a for a, (b, e) in box.items() if a not in "TCZYX" and e - b > 1]
        if odd or not {"Y", "X"} <= set(box) or any(not 0 <= e - b <= MOST for b, e in box.values()):
            raise DataError(f"{path}: axes {box}; expected X and Y, and Z, T and C at most")
        scene, (x, y, width, height) = _scene(file, box, options, path)
        kinds = {str(kind) for kind in file.pixel_types.values()}
        if len(kinds) != 1 or not kinds <= set(PIXELS):
            raise DataError(f"{path}: pixels of types {', '.join(sorted(kinds))}; expected one of {', '.join(PIXELS)}")
        dtype, samples = PIXELS[kinds.pop()]
        first = {a: box.get(a, (0, 1))[0] for a in "TCZ"}
        times, channels, slices = (max(e - b, 1) for b, e in (box.get(a, (0, 1)) for a in "TCZ"))
        spacing, names, colors = _metadata(file.raw_metadata, channels, path)
        planes = {a: n for a, n in first.items() if a in box}
        picture = Picture(
            times, channels * samples, (slices, height, width), np.dtype(dtype),
            _reader(path, scene, (x, y), planes, samples, dtype), (1, TILE, TILE), spacing,
            names=names if samples == 1 else (), colors=colors, rgb=samples > 1 and channels == 1,
        )  # fmt: skip
        name = volume_name(path) + (f":{scene}" if scene else "")
        return picture_volume(picture, options, str(path), name)


def _scene(file: Any, box: dict[str, tuple[int, int]], options: ReadOptions, path: Path) -> tuple[int | None, Any]:
    """Number of the scene asked for, None where there are none, and its (x, y, width, height)."""
    scenes = {
        int(k): (int(r.x), int(r.y), int(r.w), int(r.h)) for k, r in file.scenes_bounding_rectangle_no_pyramid.items()
    }
    if not scenes:
        (x0, x1), (y0, y1) = box["X"], box["Y"]
        scenes = {-1: (x0, y0, x1 - x0, y1 - y0)}
    keys = sorted(scenes)
    facts = [f"{scenes[k][2]} x {scenes[k][3]} pixels" for k in keys]
    number = choose_image([f"scene {max(k, 0)}" for k in keys], facts, options.array, "scenes", str(path))
    found = keys[number]
    if min(scenes[found][2:]) < 1 or max(scenes[found][2:]) > MOST:
        raise DataError(f"{path}: a scene of {facts[number]}; expected at least one; check that the file is whole")
    return None if found < 0 else found, scenes[found]


def _reader(
    path: Path, scene: int | None, corner: tuple[int, int], first: dict[str, int], samples: int, dtype: str
) -> Any:
    """Reads boxes, a region of a slice at a time; samples of colours are blue first in the file."""
    turn = Lock()  # one file, one reader: workers may have threads

    @cache
    def opened() -> Any:
        from pylibCZIrw import czi

        return czi.CziReader(str(path))

    def read(time: int, channel: int, box: Box) -> np.ndarray:
        z, y, x = box
        region = (corner[0] + x.start, corner[1] + y.start, x.stop - x.start, y.stop - y.start)
        number, sample = divmod(channel, samples)
        sample = 2 - sample if sample < 3 and samples > 1 else sample
        out = np.empty([k.stop - k.start for k in box], dtype)
        with turn, library_errors(str(path), "CZI"):
            for k in range(z.start, z.stop):
                at = {"T": time, "C": number, "Z": k}
                plane = {a: n + at[a] for a, n in first.items()}
                found = opened().read(roi=region, plane=plane, **({} if scene is None else {"scene": scene}))
                out[k - z.start] = found[..., sample]
        return out

    return read


def _metadata(xml: str, channels: int, path: Path) -> tuple[Any, list[str], list[Color]]:
    """Spacing (x, y, z) in micrometres, and names and colours of the channels."""
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
    """Of a length in metres."""
    try:
        value = float(text or "nan") / MICROMETRE
    except ValueError:
        return None
    return float(f"{value:.12g}") if math.isfinite(value) and value > 0 else None


register(Reader("CZI", (".czi",), lambda head: head.startswith(b"ZISRAWFILE"), read_czi, named_arrays=True, times=True))
