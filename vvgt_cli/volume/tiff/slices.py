"""Volumes as many files: a folder or a glob of slices (TIFF, PNG, BMP, JPEG), in the order of their numbers."""

from __future__ import annotations

import glob
import math
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.headers import fields_of_sections
from vvgt_cli.volume.reading import ReadOptions, Volume, check_memory, listed, select_component, volume_name
from vvgt_cli.volume.stored import Slices, stored_or_loaded
from vvgt_cli.volume.tiff import KINDS, SUFFIXES, TIFF
from vvgt_cli.volume.tiff.decode import open_image
from vvgt_cli.volume.tiff.reader import read_tiff
from vvgt_cli.volume.types import float_dtype

MAX_FILES = 100_000  # files


def matching(pattern: str) -> list[Path]:
    """List the files of a glob, sorted by the numbers in their names, those of one name by their folders'."""
    files = [path for path in map(Path, glob.glob(pattern)) if path.is_file()]
    places = {p: [by_number(part) for part in (p, *p.parents)] for p in {path.parent for path in files}}
    return sorted(files, key=lambda path: (by_number(path), places[path.parent]))


def slices_of(folder: Path) -> list[Path]:
    """Return the slices in a folder, sorted by the numbers in their names; one picture is none."""
    slices = _of_one_format(list(folder.iterdir()))[0]
    return slices if len(slices) > 1 or not slices or slices[0].suffix.lower() in TIFF else []


def _of_one_format(files: list[Path]) -> tuple[list[Path], list[Path]]:
    """Return the slices of the format that most of some files have (TIFF if equal), and the other slices, sorted."""
    ours = (p for p in files if p.suffix.lower() in SUFFIXES and p.name[0] != "." and p.is_file())
    files = sorted(ours, key=by_number)
    formats = [[path for path in files if path.suffix.lower() in ends] for ends in (TIFF, *KINDS.values())]
    slices = max(formats, key=len)
    return slices, [p for kind in formats if kind is not slices for p in kind]


def read_slices(files: list[Path], options: ReadOptions, source: str, name: str) -> Volume:
    """Read slices, slice z with rows from the top as y; spacing is the first file's, else that of a scanner's log.

    Errors are those of `Reader.read`.
    """
    files, others = _of_one_format(files) if len(files) > 1 else (files, [])
    if len(files) > MAX_FILES:
        raise DataError(f"{source}: {len(files)} files; expected at most {MAX_FILES} slices")
    if not files:
        raise DataError(f"{source}: no slices ({', '.join(SUFFIXES)})")
    if others:
        names = listed([path.name for path in others], ", ", 3)
        warnings.warn(f"{source}: skipped {names}: not of the format of most slices", stacklevel=2)
    files, step = in_order(files, source)

    def page(path: Path, slices: int = 0) -> Volume:
        how = replace(options, stored=False, spacing=options.spacing if slices else (1.0, 1.0, 1.0))
        volume = read_tiff(path, how, slices)
        if volume.data.shape[0] != 1:
            text = f"{path}: {volume.data.shape[0]} slices in one of {len(files)} files; expected one slice a file"
            raise DataError(f"{text} (of an OME set give one of the files alone)")
        return volume

    def alike(path: Path) -> np.ndarray:
        volume = page(path)
        if (volume.slope, volume.intercept) != (first.slope, first.intercept):
            raise DataError(f"{path}: calibrated values of another scale than those of {files[0].name}; expected one")
        return volume.data

    read: Callable[[Path], np.ndarray]
    values: dict[str, Any] = {}
    if files[0].suffix.lower() in TIFF:
        first = page(files[0], max(len(files), 2))
        plane, spacing, unit, read = first.data, first.spacing, first.unit, alike
        values = {"slope": first.slope, "intercept": first.intercept, "value_unit": first.value_unit}
        values["origin"] = first.origin
    else:
        read = picture_planes(files, options, source)
        plane, spacing, unit = read(files[0]), options.spacing_or((1.0, 1.0, 1.0)), ""
    if not unit and spacing == options.spacing_or((1.0, 1.0, 1.0)):
        size = (plane.shape[2], plane.shape[1])
        spacing, unit = log_spacing(files[0], size, step, options.spacing) or (spacing, unit)
    shape = (len(files), *plane.shape[1:])
    part = partial(_part, files, plane, read)
    field = stored_or_loaded(part, plane.dtype, shape, (1, *plane.shape[1:]), source, options.stored)
    return Volume(field, spacing, name=name, unit=unit, **values)


def _part(files: list[Path], plane: np.ndarray, load: Callable[[Path], np.ndarray], slices: Slices) -> np.ndarray:
    """Read a box of slices; ``load`` reads one as (1, y, x), all as ``plane``, the first of them."""
    z, y, x = slices
    out = np.empty([s.stop - s.start for s in slices], plane.dtype)
    for row, file in zip(out, files[z], strict=True):
        values = load(file)
        if values.shape != plane.shape or plane.dtype not in (values.dtype, float_dtype(values.dtype)):
            raise DataError(
                f"{file}: {values.shape[2]} x {values.shape[1]} {values.dtype}; expected {plane.shape[2]} x "
                f"{plane.shape[1]} {plane.dtype} as in {files[0].name}"
            )
        row[...] = values[0, y, x]
    return out


def read_glob(pattern: str, options: ReadOptions) -> Volume | None:
    """Return the volume of a glob of slices, None where no file fits; raise DataError for files of other formats."""
    files = matching(pattern)
    if not files:
        return None
    odd = next((path for path in files if path.suffix.lower() not in SUFFIXES), None)
    if odd is not None:
        raise DataError(
            f"{pattern}: {odd.name} is no slice; expected slices ({', '.join(SUFFIXES)}), one file, or frames of a "
            "series with a number in -o, as out_{:04d}.ply"
        )
    return read_slices(files, options, pattern, re.sub(r"[\W_]+$", "", files[0].stem.rstrip("0123456789")) or "slices")


def read_folder(folder: Path, options: ReadOptions) -> Volume:
    """Read the slices in a folder, as `read_slices`."""
    return read_slices(list(folder.iterdir()), options, str(folder), folder.resolve().name)


def read_picture(path: Path, options: ReadOptions) -> Volume:
    """Read one picture as one slice, as `read_slices`."""
    return read_slices([path], options, str(path), volume_name(path))


_SAMPLED = 9  # pictures of a stack that tell whether it is in colour


def picture_planes(files: list[Path], options: ReadOptions, source: str) -> Callable[[Path], np.ndarray]:
    """Return what reads one of the pictures of a stack as (1, y, x).

    Their components are those of the richest of a few of them: red, green and blue that are equal count as one, and
    opacity as none if it is full.

    Raises:
        DataError: a damaged picture, or one with more components than those few.
        UsageError: colours and no component chosen (`SeveralComponents`).
    """
    picks = {files[round(k * (len(files) - 1) / (_SAMPLED - 1))] for k in range(_SAMPLED)}
    count = max(_simplest(read_pixels(path)).shape[2] for path in picks)

    def plane(path: Path) -> np.ndarray:
        pixels = read_pixels(path) if count > 1 else _simplest(read_pixels(path))
        if pixels.shape[2] == 1 and count > 1:
            grey = np.repeat(pixels, 3 if count > 2 else 1, axis=2)
            full = np.full_like(pixels, np.iinfo(pixels.dtype).max)
            pixels = grey if count == 3 else np.concatenate([grey, full], axis=2)
        if pixels.shape[2] < count or (count == 1 and pixels.shape[2] > 1):
            has = f"{path}: {pixels.shape[2]} components (colours, opacity)"
            raise DataError(f"{has}; expected {count} as in other pictures of {source}: convert it, or leave it out")
        return select_component(pixels[None, ..., :count], options.component, source, color=True)[0]

    return plane


def read_pixels(path: Path) -> np.ndarray:
    """Return the pixels of a picture, (rows, columns, samples) uint8 or uint16, turned as its Exif orientation says.

    Palettes are expanded, greys of fewer bits scaled to 8; colours are neither managed nor multiplied by opacity. The
    fourth byte of a BMP's pixels is dropped: most programs leave it 0.

    Raises:
        DataError: no picture, or a damaged one; not enough memory.
    """
    image, error = open_image(str(path))
    kind, pixels = ("", None) if image is None else (image.format_name(), None)
    if image is not None and kind in KINDS:
        spec = image.spec()
        check_memory(spec.image_bytes(), str(path))
        pixels = image.read_image(0, 0, 0, spec.nchannels, spec.format)
        error = image.geterror()  # also where a JPEG is cut short, whose rest is grey
    if pixels is None or error:
        text = " ".join(error.split())[:200] or f"content: {kind}"
        raise DataError(f"{path}: cannot be read ({text}); expected a whole PNG, BMP or JPEG picture")
    pixels = pixels.reshape(spec.height, spec.width, spec.nchannels)[..., : 3 if kind == "bmp" else None]
    turn = spec.get_int_attribute("Orientation", 1)
    pixels = pixels.swapaxes(0, 1) if turn > 4 else pixels
    return pixels[:: -1 if turn in (3, 4, 7, 8) else 1, :: -1 if turn in (2, 3, 6, 7) else 1]


def _simplest(pixels: np.ndarray) -> np.ndarray:
    """Return pixels without opacity that is full everywhere, and as grey if red, green and blue are equal."""
    if pixels.shape[2] in (2, 4) and (pixels[..., -1] == np.iinfo(pixels.dtype).max).all():
        pixels = pixels[..., :-1]
    return pixels[..., :1] if pixels.shape[2] == 3 and (pixels[..., 1:] == pixels[..., :1]).all() else pixels


_SUFFIXES = (".log", ".xtekct", ".xtekvolume")
_SIZES = {  # field of the size along x: of those along y and z, of the pixels along x and y, and the unit
    "xtekct/voxelsizex": ("xtekct/voxelsizey", "xtekct/voxelsizez", "xtekct/voxels{}", "xy", "mm"),
    "reconstruction/pixel size (um)": ("", "", "reconstruction/result image {} (pixels)", ("width", "height"), "um"),
    "acquisition/image pixel size (um)": ("", "", "", "xy", "um"),
}
Spacing = tuple[float, float, float]


def log_spacing(first: Path, size: tuple[int, int], step: int, spacing: Spacing | None) -> tuple[Spacing, str] | None:
    """Return voxel sizes (x, y, z) and their unit by the log beside a stack of slices; None, and a warning, if unsure.

    Slices must have the ``size`` (x, y) in pixels that the log states. Their distance goes by the ``step`` of their
    numbers, or the log's. Sizes that are given as ``spacing`` replace the log's. If there are several logs, the one
    with the longest name that the name of the ``first`` slice begins with counts.

    Raises:
        DataError: a size in the log is no number.
    """
    paths = [path for path in sorted(first.parent.iterdir()) if path.suffix.lower() in _SUFFIXES and path.is_file()]
    logs = [log for path in paths if (log := fields_of_sections(path)).keys() & _SIZES.keys()]
    own = [log for log in logs if first.name.startswith(Path(log.name).stem)]
    if not logs:
        return None
    log = max(own or logs, key=lambda log: len(Path(log.name).stem))
    along_x = next(key for key in _SIZES if key in log)
    along_y, along_z, pixels, axes, unit = _SIZES[along_x]
    unit = log.get("xtekct/units") or unit
    if spacing is not None:
        return spacing, unit
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


def by_number(path: Path) -> list[tuple[int, str]]:
    """Return the sorting key of a file name: runs of digits count by value."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name) if part]


def in_order(files: list[Path], source: str) -> tuple[list[Path], int]:
    """Return the files of a numbered series, sorted by the number that differs in every name, and its step.

    Files that are sorted by `by_number` but have no numbers in common stay in that order. Warnings name files that are
    skipped and numbers that are missing.

    Raises:
        DataError: several numbers vary independently (channels, times, positions), or several series count alike.
    """
    groups: dict[tuple[str, ...], list[Path]] = {}
    for path in files:
        groups.setdefault(tuple(re.split(r"\d+", path.name.lower())), []).append(path)
    main = max(groups.values(), key=len)
    alone = [group[0] for group in groups.values() if len(group) == 1]
    series = [path for group in groups.values() if len(group) > 1 for path in group]
    texts = [re.findall(r"\d+", path.name) for path in series]
    columns = [tuple(map(int, column)) for column in zip(*texts, strict=False)]
    if len(alone) >= len(main) or not columns:
        return files, 1
    if alone:
        names = listed([path.name for path in alone], ", ", 3)
        warnings.warn(f"{source}: skipped {names}: not numbered as the other slices", stacklevel=2)
    parts = re.split(r"(\d+)", main[0].name)
    for k in (k for k in range(len(columns) - 1) if parts[2 * k + 2] == "."):  # decimals: 0.5, 1.0, 1.5
        places = [float(f"{text[k]}.{text[k + 1]}") for text in texts]
        if len(_steps(places)) == 1:
            return [path for _, path in sorted(zip(places, series, strict=True))], 1
    counting = [column for column in columns if len(set(column)) == len(series)]
    if not counting:
        _refuse(main[0], series, columns, source)
        return sorted(series, key=by_number), 1
    numbers = min(counting, key=lambda column: (len(_steps(column)) > 1, max(column) - min(column)))
    step = int(min(_steps(numbers)))
    gaps = [n for a, b in pairwise(sorted(numbers)) for n in range(a + step, min(b, a + 5 * step), step)]
    if gaps:
        warnings.warn(f"{source}: no slices numbered {listed(gaps, ', ', 3)}; read as if evenly spaced", stacklevel=2)
    return [path for _, path in sorted(zip(numbers, series, strict=True))], step


def _steps(numbers: Sequence[float]) -> set[float]:
    return {round(b - a, 9) for a, b in pairwise(sorted(numbers))}


def _refuse(first: Path, series: list[Path], columns: list[tuple[int, ...]], source: str) -> None:
    """Raise `DataError` if the numbers in names fill more than half of a grid; warn if not: clock times do not."""
    parts = re.split(r"(\d+)", first.name)
    labels = [(re.findall(r"([A-Za-z]+)[-_= ]?$", part) or ["number"])[0] for part in parts[::2]]
    sizes = {k: len(set(column)) for k, column in enumerate(columns) if len(set(column)) > 1}
    ranges = ", ".join(f"{labels[k]} {min(columns[k])} to {max(columns[k])}" for k in sizes)
    text = f"{source}: no one number counts the slices in the names of its {len(series)} files ({ranges})"
    if 2 * len(series) <= math.prod(sizes.values()):
        warnings.warn(f"{text}; they are in the order of the first", stacklevel=3)
        return
    at = 1 + 2 * max(sizes, key=lambda k: (labels[k].lower() in ("z", "slice", "section"), sizes[k]), default=0)
    before, after = (glob.escape("".join(some)) for some in (parts[:at], parts[at + 1 :]))
    wide, narrow = (f"{before}{digits}{after}" for digits in ("*", "[0-9]" * len(parts[at])))
    matched = {tuple(re.split(r"\d+", path.name)) for path in series if path.match(wide)}
    way_out = Path(glob.escape(str(first.parent))) / (wide if len(matched) == 1 else narrow)
    raise DataError(f"{text}, so they look like several stacks; give one, as '{way_out}'")
