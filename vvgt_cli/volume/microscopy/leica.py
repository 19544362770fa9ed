"""Leica (``.lif``): one image of a file, mapped where it lies plainly. Read by liffile.

Channels have the colours of their look-up tables.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory, count, load_block
from vvgt_cli.volume.microscopy.image import EXTRA, Bounded, Color, Micrograph, choose_image, picture_volume, safe_xml
from vvgt_cli.volume.reading import ReadOptions, Slices, Volume, need, volume_name
from vvgt_cli.volume.space import MICROMETRE, metres

LUTS: dict[str, Color] = {
    "red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1), "cyan": (0, 1, 1), "magenta": (1, 0, 1),
    "yellow": (1, 1, 0), "gray": (1, 1, 1), "grey": (1, 1, 1),
}  # fmt: skip


def read_lif(path: Path, options: ReadOptions) -> Volume:
    """Read one image of a LIF file; spacing in micrometres."""
    liffile = need("liffile", EXTRA, str(path), "LIF")
    _check_header(path)
    with Bounded(path) as stream, liffile.LifFile(stream, squeeze=False) as file:
        images = list(file.images)
        facts = [_facts(i) for i in images]
        deep = [" Z" in text for text in facts]
        image = images[choose_image([i.path for i in images], facts, options.array, "images", str(path), deep)]
        inner = image.path if len(images) > 1 else ""
        name = volume_name(path) + (f":{inner}" if inner else "")
        return picture_volume(_picture(image, path), options, f"{path}:{inner}" if inner else str(path), name)


def _check_header(path: Path) -> None:
    """Refuse a header that is longer than the file, or not plain XML, before it is parsed."""
    with open(path, "rb") as file:
        head, size = file.read(13), path.stat().st_size
        length = 2 * struct.unpack("<I", head[9:13])[0] if len(head) == 13 else size
        if 13 + length > size:
            raise DataError(f"{path}: {size} bytes; its LIF header needs {13 + length}; check that the file is whole")
        check_memory(8 * length, str(path))
        safe_xml(file.read(length).decode("utf-16-le", "replace"), str(path))


def _facts(image: Any) -> str:
    """Describe an image, for an error."""
    try:
        return " x ".join(f"{n} {a}" for a, n in image.sizes.items() if n > 1) + f" {image.dtype}"
    except (ValueError, KeyError, AssertionError, OverflowError):
        return "not a volume"


def _picture(image: Any, path: Path) -> Micrograph:
    sizes = {a: int(n) for a, n in image.sizes.items() if a in "TCSZYX" or n > 1}
    odd = [a for a in sizes if a not in "TCSZYX"]
    if odd or min(sizes.values(), default=0) < 1 or not {"Y", "X"} <= set(sizes):
        raise DataError(f"{path}:{image.path}: axes {sizes}; expected X and Y, and Z, T, C or samples at most")
    block, shape = image.memory_block, tuple(sizes.values())
    if block.frames or block.offset < 0 or block.size != count(shape) * image.dtype.itemsize:
        raise DataError(
            f"{path}:{image.path}: {block.size} bytes for {sizes} of {image.dtype}; expected its pixels in one piece"
        )
    stored = load_block(path, image.dtype, shape, offset=block.offset)
    axes = [*(a for a in "TCSZYX" if a not in sizes), *sizes]
    stored = stored.reshape((1,) * (len(axes) - len(shape)) + shape)
    values = np.transpose(stored, [axes.index(a) for a in ("T", "C", "S", "Z", "Y", "X")])
    times, channels, samples, nz, ny, nx = values.shape
    stored_as = image.xml_element.findall("./Data/Image/ImageDescription/Channels/ChannelDescription")
    stored_as.sort(key=lambda one: int(one.get("BytesInc") or 0))
    if samples == 3 and [one.get("ChannelTag") for one in stored_as][:3] == ["3", "2", "1"]:  # blue, green, red
        values = values[:, :, ::-1]

    def read(time: int, channel: int, box: Slices) -> np.ndarray:
        return values[time, channel // samples, channel % samples][box]

    spacing, origin = _placed(image)
    names, colors = _channels(image) if samples == 1 else ([], [])
    return Micrograph(
        times, channels * samples, (nz, ny, nx), image.dtype, read, (1, ny, nx), spacing, origin,
        names, colors, rgb=samples > 1 and channels == 1, mapped=True,
    )  # fmt: skip


def _placed(image: Any) -> tuple[Any, Any]:
    """Return spacing and origin (x, y, z) in micrometres by the lengths from first to last voxel, which have signs."""
    spacing: dict[str, float] = {}
    origin: dict[str, float] = {}
    for axis in image.xml_element.findall("./Data/Image/ImageDescription/Dimensions/DimensionDescription"):
        name = {"1": "x", "2": "y", "3": "z"}.get(axis.get("DimID", ""))
        unit = (metres(axis.get("Unit", "")) or 0.0) / MICROMETRE
        size = int(axis.get("NumberOfElements", 1))
        if name and unit:
            first, length = float(axis.get("Origin", 0)) * unit, float(axis.get("Length", 0)) * unit
            if size > 1 and np.isfinite(length) and length:
                spacing[name] = length / (size - 1)
            origin[name] = first if np.isfinite(first) else 0.0
    return tuple(spacing.get(a) for a in "xyz"), tuple(origin.get(a, 0.0) for a in "xyz")


def _channels(image: Any) -> tuple[list[str], list[Color]]:
    """Return names and colours of the channels: those of the look-up tables where dyes are not named."""
    names, colors = [], []
    for channel in image.xml_element.findall("./Data/Image/ImageDescription/Channels/ChannelDescription"):
        properties = {p.findtext("Key"): p.findtext("Value") for p in channel.findall("ChannelProperty")}
        names.append(
            str(properties.get("DyeName") or channel.get("NameOfMeasuredQuantity") or channel.get("LUTName") or "")
        )
        colors.append(LUTS.get(channel.get("LUTName", "").lower()))
    return names if len(set(names)) == len(names) else [], colors
