"""Voxel sizes in the logs that micro-CT scanners leave beside their slices: SkyScan (NRecon) and Nikon (X-Tek)."""

from __future__ import annotations

import warnings
from pathlib import Path

from vvgt_cli.volume.headers import MAX_HEADER, Fields

_SUFFIXES = (".log", ".xtekct", ".xtekvolume")
_SIZES = {  # field of the size along x: of those along y and z, of the pixels along x and y, and the unit
    "xtekct/voxelsizex": ("xtekct/voxelsizey", "xtekct/voxelsizez", "xtekct/voxels{}", "xy", "mm"),
    "reconstruction/pixel size (um)": ("", "", "reconstruction/result image {} (pixels)", ("width", "height"), "um"),
    "acquisition/image pixel size (um)": ("", "", "", "xy", "um"),
}
Spacing = tuple[float, float, float]


def log_spacing(first: Path, size: tuple[int, int], step: int, given: Spacing | None) -> tuple[Spacing, str] | None:
    """Return voxel sizes (x, y, z) and their unit by the log beside a stack of slices; None, and a warning, if unsure.

    Slices must have the ``size`` (x, y) in pixels that the log states. Their distance goes by the ``step`` of their
    numbers, or the log's. Sizes that are ``given`` replace the log's. If there are several logs, the one
    with the longest name that the name of the ``first`` slice begins with counts.

    Raises:
        DataError: a size in the log is no number.
    """
    paths = [path for path in sorted(first.parent.iterdir()) if path.suffix.lower() in _SUFFIXES and path.is_file()]
    logs = [log for path in paths if (log := _fields(path)).keys() & _SIZES.keys()]
    own = [log for log in logs if first.name.startswith(Path(log.name).stem)]
    if not logs:
        return None
    log = max(own or logs, key=lambda log: len(Path(log.name).stem))
    along_x = next(key for key in _SIZES if key in log)
    along_y, along_z, pixels, axes, unit = _SIZES[along_x]
    unit = log.get("xtekct/units") or unit
    if given is not None:
        return given, unit
    x, y, z = (log.floats(key, log.need(key), 1)[0] for key in (along_x, along_y or along_x, along_z or along_x))
    stated = [log[key] for axis in axes if (key := pixels.format(axis)) in log]
    between = "reconstruction/section to section step"
    z *= max(step, log.floats(between, log.get(between, "1"), 1)[0])
    if not own and len({tuple(map(log.get, _SIZES)) for log in logs}) > 1:
        problem = f"one of {len(logs)} logs, none named as the slices"
    elif stated and stated != [*map(str, size)]:
        problem = f"for {' x '.join(stated)} pixels, not for {size[0]} x {size[1]} (binned or cut out?)"
    else:
        return (x, y, z), unit
    warnings.warn(f"{log.name}: voxel sizes {x:g} {y:g} {z:g} {unit} not used: {problem}; try --spacing", stacklevel=2)
    return None


def _fields(path: Path) -> Fields:
    """Return the fields of a log, ``section/key`` in lower case."""
    fields, section = Fields(str(path)), ""
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for line in file.read(MAX_HEADER).splitlines():
            key, equals, value = line.partition("=")
            section = line.strip().strip("[]").lower() if line.startswith("[") else section
            fields.update({f"{section}/{key.strip().lower()}": value.strip()} if equals else {})
    return fields
