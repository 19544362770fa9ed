"""Volumes as many files: a folder or a glob of slices (TIFF, PNG, BMP, JPEG), in the order of their numbers."""

from __future__ import annotations

import glob
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import volume_name
from vvgt_cli.volume.tiff import KINDS, SUFFIXES, TIFF
from vvgt_cli.volume.tiff.pictures import picture_planes
from vvgt_cli.volume.tiff.reader import read_tiff
from vvgt_cli.volume.tiff.scan_logs import log_spacing
from vvgt_cli.volume.tiff.slice_names import by_number, in_order, listed
from vvgt_cli.volume.tiff.stored import lazy_files
from vvgt_cli.volume.types import Volume

MOST = 100_000  # files


def matching(pattern: str) -> list[Path]:
    """List the files of a glob, sorted by the numbers in their names."""
    return sorted((path for path in map(Path, glob.glob(pattern)) if path.is_file()), key=by_number)


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
    """Read slices, slice z with rows from the top as y; the spacing is the first file's, else that of a scanner's log.

    Raises:
        DataError: slices of different sizes or types, names of several stacks, files of several pages, more files than
            `MOST`.
        UsageError: colour slices and no component chosen.
    """
    files, others = _of_one_format(files) if len(files) > 1 else (files, [])
    if len(files) > MOST:
        raise DataError(f"{source}: {len(files)} files; expected at most {MOST} slices")
    if not files:
        raise DataError(f"{source}: no slices ({', '.join(SUFFIXES)})")
    if others:
        warnings.warn(f"{source}: skipped {listed(others)}: not of the format of most slices", stacklevel=2)
    files, step = in_order(files, source)

    def page(path: Path, slices: int = 1) -> Volume:
        how = replace(options, stored=False, spacing=options.spacing if slices > 1 else (1.0, 1.0, 1.0))
        volume = read_tiff(path, how, slices)
        if volume.data.shape[0] != 1:
            text = f"{path}: {volume.data.shape[0]} slices in one of {len(files)} files; expected one slice a file"
            raise DataError(f"{text} (of an OME set give one of the files alone)")
        return volume

    read: Callable[[Path], np.ndarray]
    if files[0].suffix.lower() in TIFF:
        first = page(files[0], max(len(files), 2))
        plane, spacing, unit, read = first.data, first.spacing, first.unit, lambda path: page(path).data
    else:
        read = picture_planes(files, options, source)
        plane, spacing, unit = read(files[0]), options.spacing_or((1.0, 1.0, 1.0)), ""
    if not unit and spacing == options.spacing_or((1.0, 1.0, 1.0)):
        size = (plane.shape[2], plane.shape[1])
        spacing, unit = log_spacing(files[0], size, step, options.spacing) or (spacing, unit)
    field: Any = lazy_files(files, plane, read, source)
    if not options.stored:
        check_memory(field.nbytes, source)
        field = field[:]
    return Volume(field, spacing, name=name, unit=unit)


def read_glob(pattern: str, options: ReadOptions) -> Volume | None:
    """Return the volume of a glob of slices; None where no file fits the pattern.

    Raises:
        DataError: files of other formats.
    """
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
