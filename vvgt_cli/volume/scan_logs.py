"""Voxel sizes in the logs that micro-CT scanners leave beside their slices: SkyScan (NRecon) and Nikon (X-Tek)."""

from __future__ import annotations

import warnings
from pathlib import Path

from vvgt_cli.errors import DataError
from vvgt_cli.volume.headers import MAX_HEADER, Fields

_SUFFIXES = (".log", ".xtekct", ".xtekvolume")
_KEYS = {  # sizes along x, y and z, by what names them
    "xtekct/voxelsizex": ("xtekct/voxelsizex", "xtekct/voxelsizey", "xtekct/voxelsizez"),
    "reconstruction/pixel size (um)": ("reconstruction/pixel size (um)",) * 3,
    "acquisition/image pixel size (um)": ("acquisition/image pixel size (um)",) * 3,
}
_PIXELS = {
    "xtekct": ("xtekct/voxelsx", "xtekct/voxelsy"),
    "reconstruction": ("reconstruction/result image width (pixels)", "reconstruction/result image height (pixels)"),
}
Spacing = tuple[float, float, float]


def log_spacing(first: Path, size: tuple[int, int], step: int, stated: Spacing | None) -> tuple[Spacing, str] | None:
    """Return voxel sizes (x, y, z) and their unit by the log beside a stack of slices; None where none counts.

    Args:
        first: the first slice. Of several logs those count whose names its name begins with, the longest most.
        size: (x, y) pixels of the slices, which must be those of the log.
        step: of the numbers in the slices' names.
        stated: sizes that replace those of the log.

    Raises:
        DataError: a size in the log that is no number above 0.
    """
    paths = [p for p in sorted(first.parent.iterdir()) if p.suffix.lower() in _SUFFIXES and p.is_file()]
    logs = [log for path in paths if (log := _fields(path)).keys() & _KEYS.keys()]
    own = [log for log in logs if first.name.startswith(Path(log.name).stem)]
    if not logs:
        return None
    log = max(own or logs, key=lambda log: (len(Path(log.name).stem), Path(log.name).suffix.lower()))
    key = next(key for key in _KEYS if key in log)
    unit = log.get("xtekct/units", "mm") if key.startswith("xtekct") else "um"
    if stated is not None:
        return stated, unit
    x, y, z = (_number(log, k) for k in _KEYS[key])
    between = max(step, int(_number(log, "reconstruction/section to section step", 1)))
    text = f"{log.name}: voxel sizes {x:g} {y:g} {z * between:g} {unit}"
    pixels = [int(_number(log, k, n)) for k, n in zip(_PIXELS.get(key.partition("/")[0], ()), size, strict=False)]
    if not own and len({tuple(log.get(k) for k in _KEYS) for log in logs}) > 1:
        text += f" are not used: {len(logs)} logs lie there, none named as the slices; try --spacing X Y Z"
    elif pixels and tuple(pixels) != size:
        text += f" are of {pixels[0]} x {pixels[1]} pixels and not used: the slices have {size[0]} x {size[1]}; try "
        text += "--spacing with these sizes if they are cut out, or with a multiple if they are binned"
    else:
        if step > 1:
            warnings.warn(f"{text}: numbers of slices go in steps of {step}", stacklevel=2)
        return (x, y, z * between), unit
    warnings.warn(text, stacklevel=2)
    return None


def _fields(path: Path) -> Fields:
    """Return the fields of a log, ``section/key`` in lower case."""
    fields, section = Fields(str(path)), ""
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for line in file.read(MAX_HEADER).splitlines():
            key, equals, value = line.partition("=")
            section = line.strip().strip("[]").lower() if line.startswith("[") else section
            if equals:
                fields.setdefault(f"{section}/{key.strip().lower()}", value.strip())
    return fields


def _number(log: Fields, key: str, default: float = 0.0) -> float:
    values = log.floats(key, log[key]) if key in log else [default]
    if len(values) != 1 or values[0] <= 0:
        raise DataError(f"{log.name}: {key} is {log.get(key)!r}; expected a number above 0; try --spacing X Y Z")
    return values[0]
