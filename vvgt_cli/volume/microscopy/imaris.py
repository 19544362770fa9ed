"""Imaris (``.ims``), an HDF5 file of a known layout: channels, time steps and a pyramid of levels. Read by h5py.

Format: Imaris 5.5 file format, https://imaris.oxinst.com/support/imaris-file-format.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.microscopy.image import Color, Micrograph, picture_volume
from vvgt_cli.volume.reading import ReadOptions, Slices, Volume, read_part, volume_name
from vvgt_cli.volume.space import MICROMETRE, metres

MAX_COUNT = 1_000_000  # time steps or channels


def is_imaris(file: Any) -> bool:
    """Tell whether an open HDF5 file is one of Imaris."""
    return "DataSet/ResolutionLevel 0/TimePoint 0/Channel 0/Data" in file and "DataSetInfo" in file


def read_imaris(file: Any, path: Path, options: ReadOptions, checked: Callable[[str], Any]) -> Volume:
    """Read a channel of a time step of an open file at ``options.level``.

    ``checked`` returns a path's dataset, and raises where its values must not be read.
    """
    if options.array is not None:
        raise UsageError(f"{path}: an Imaris file, which has one image; leave out --array {options.array}")
    levels, level = _count(file["DataSet"], "ResolutionLevel"), options.level or 0
    if level >= levels:
        raise UsageError(f"{path}: --level {level}: expected full, or 0 to {levels - 1}")
    times = _count(file[f"DataSet/ResolutionLevel {level}"], "TimePoint")
    channels = _count(file[f"DataSet/ResolutionLevel {level}/TimePoint 0"], "Channel")
    first = checked(_place(level, 0, 0))
    shape = _shape(file, level)
    for time in range(times) if options.time is None else [min(options.time, times - 1)]:
        for channel in range(channels):
            name = _place(level, time, channel)
            dataset = checked(name)
            if len(dataset.shape) != 3 or any(a < b for a, b in zip(dataset.shape, shape, strict=True)):
                raise DataError(f"{path}:/{name}: {dataset.shape}; expected at least the image's {shape}")
    image = file["DataSetInfo/Image"].attrs if "DataSetInfo/Image" in file else {}
    spacing, origin = _placed(image, shape)
    names, colors = zip(*(_channel(file, c) for c in range(channels)), strict=True)

    def read(time: int, channel: int, box: Slices) -> np.ndarray:  # datasets are padded to whole chunks
        return read_part(path, _place(level, time, channel), box)

    chunks = first.chunks or (1, *shape[1:])
    picture = Micrograph(times, channels, shape, first.dtype, read, chunks, spacing, origin, names, colors)
    return picture_volume(picture, options, str(path), volume_name(path))


def _place(level: int, time: int, channel: int) -> str:
    return f"DataSet/ResolutionLevel {level}/TimePoint {time}/Channel {channel}/Data"


def _count(group: Any, what: str) -> int:
    """Count the groups ``what 0``, ``what 1``, ... in a row."""
    return next(k for k in range(MAX_COUNT) if f"{what} {k}" not in group)


def _shape(file: Any, level: int) -> tuple[int, int, int]:
    """Return (nz, ny, nx) of a level, without the padding."""
    group = file[f"DataSet/ResolutionLevel {level}/TimePoint 0/Channel 0"]
    padded = group["Data"].shape
    sizes = [_text(group.attrs.get(f"ImageSize{axis}", "")) for axis in "ZYX"]
    if not all(text.isdecimal() and len(text) < 10 for text in sizes):
        sizes = [str(n) for n in padded]
    if len(padded) != 3 or len(sizes) != 3 or min(map(int, sizes)) < 1:
        raise DataError(f"{file.filename}: level {level} of {' x '.join(sizes)}; expected three sizes of at least 1")
    z, y, x = map(int, sizes)
    return z, y, x


def _text(value: Any) -> str:
    """Join an attribute, an array of single characters, to text."""
    characters = np.asarray(value)
    if characters.dtype.kind == "S":
        return characters.tobytes().replace(b"\0", b"").decode("utf-8", "replace").strip()
    return "".join(map(str, characters.ravel()[:4096])).strip()


def _placed(image: Any, shape: tuple[int, int, int]) -> tuple[Any, Any]:
    """Return spacing and origin (x, y, z) in micrometres by the extent of the image."""
    unit = (metres(_text(image.get("Unit", "")) or "um") or np.nan) / MICROMETRE
    spacing: list[float | None] = []
    origin = []
    for axis, size in enumerate(reversed(shape)):
        ends = [[float(word) for word in _text(image.get(f"Ext{end}{axis}", "")).split()] for end in ("Min", "Max")]
        width = (ends[1][0] - ends[0][0]) * unit / size if all(len(e) == 1 for e in ends) else 0.0
        known = np.isfinite(width) and width != 0
        spacing.append(width if known else None)
        origin.append(ends[0][0] * unit + width / 2 if known else 0.0)
    return tuple(spacing), tuple(origin)


def _channel(file: Any, number: int) -> tuple[str, Color]:
    """Return name and colour of a channel."""
    group = file.get(f"DataSetInfo/Channel {number}")
    if group is None:
        return "", None
    rgb = [float(word) for word in _text(group.attrs.get("Color", "")).split()]
    good = len(rgb) == 3 and all(0 <= v <= 1 for v in rgb) and any(rgb)
    name = _text(group.attrs.get("Name", ""))[:80]
    return "" if name == "(name not specified)" else name, (rgb[0], rgb[1], rgb[2]) if good else None
