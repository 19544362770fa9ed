"""Volumes as many files: a folder or a glob of TIFF slices, one page each, sorted by the numbers in their names."""

from __future__ import annotations

import glob
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import Reader, register
from vvgt_cli.volume.tiff import SUFFIXES, read_tiff
from vvgt_cli.volume.tiff_stored import checked, lazy_files
from vvgt_cli.volume.types import Volume

MOST = 100_000  # files


def by_number(path: Path) -> list[tuple[int, str]]:
    """Sorting key of a file name: runs of digits by value."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name) if part]


def matching(pattern: str) -> list[Path]:
    """The files of a glob, sorted by the numbers in their names."""
    return sorted((path for path in map(Path, glob.glob(pattern)) if path.is_file()), key=by_number)


def slices_of(folder: Path) -> list[Path]:
    """The TIFF files in a folder, sorted by the numbers in their names."""
    files = (p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
    return sorted((p for p in files if p.is_file()), key=by_number)


def read_folder(folder: Path, options: ReadOptions) -> Volume:
    """Read a folder of TIFF slices.

    Raises:
        DataError: as `read_slices`.
    """
    return read_slices(slices_of(folder), options, str(folder), folder.resolve().name)


def read_slices(files: list[Path], options: ReadOptions, source: str, name: str) -> Volume:
    """Slice z is file z, with rows from the top as y; the spacing is the first file's.

    Raises:
        DataError: slices of different sizes or types, files of several pages, more files than `MOST`.
        UsageError: colour slices and no component chosen.
    """
    if len(files) > MOST:
        raise DataError(f"{source}: {len(files)} files; expected at most {MOST} slices")
    if not files:
        raise DataError(f"{source}: no TIFF slices")

    def plane_of(path: Path) -> Volume:
        volume = read_tiff(path, replace(options, stored=False))
        if volume.data.shape[0] != 1:
            raise DataError(
                f"{path}: {volume.data.shape[0]} slices in one of {len(files)} files; expected one slice a file (of an "
                "OME set give one of the files alone)"
            )
        return volume

    first = plane_of(files[0])
    plane = first.data
    if options.stored:
        field: Any = lazy_files(files, plane, lambda path: plane_of(path).data, source)
        return Volume(field, first.spacing, name=name)
    check_memory(len(files) * plane.nbytes, source)
    out = np.empty((len(files), *plane.shape[1:]), plane.dtype)
    for z, path in enumerate(files):
        out[z] = checked(plane_of(path).data if z else plane, plane, path, files[0])[0]
    return Volume(out, first.spacing, name=name)


def read_glob(pattern: str, options: ReadOptions) -> Volume | None:
    """The volume of a glob of TIFF slices; None where no file fits the pattern.

    Raises:
        DataError: files of other formats.
    """
    files = matching(pattern)
    if not files:
        return None
    odd = next((path for path in files if path.suffix.lower() not in SUFFIXES), None)
    if odd is not None:
        raise DataError(
            f"{pattern}: {odd.name} is no TIFF slice; expected slices ({', '.join(SUFFIXES)}), one "
            "file, or frames of a series with a number in -o, as out_{:04d}.ply"
        )
    return read_slices(files, options, pattern, re.sub(r"[\W_]+$", "", files[0].stem.rstrip("0123456789")) or "slices")


READER = register(
    Reader("TIFF slices", (), lambda head: False, read_folder, holds=lambda folder: bool(slices_of(folder)))
)
