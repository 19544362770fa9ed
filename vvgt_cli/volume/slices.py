"""Volumes as many files: a folder or a glob of TIFF slices, one page each, sorted by the numbers in their names."""

from __future__ import annotations

import glob
import re
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import Reader, register
from vvgt_cli.volume.tiff import SUFFIXES, read_tiff
from vvgt_cli.volume.types import Volume

MOST = 100_000  # files


def by_number(path: Path) -> list[tuple[int, str]]:
    """Sorting key of a file name: runs of digits by value."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name) if part]


def matching(pattern: str) -> list[Path]:
    """The files of a glob, sorted by the numbers in their names."""
    return sorted((path for path in map(Path, glob.glob(pattern)) if path.is_file()), key=by_number)


def _slices(folder: Path) -> list[Path]:
    files = (p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
    return sorted((p for p in files if p.is_file()), key=by_number)


def read_folder(folder: Path, options: ReadOptions) -> Volume:
    """Read a folder of TIFF slices.

    Raises:
        DataError: as `read_slices`.
    """
    return read_slices(_slices(folder), options, str(folder), folder.resolve().name)


def read_slices(files: list[Path], options: ReadOptions, source: str, name: str) -> Volume:
    """Slice z is file z, with rows from the top as y; the spacing is the first file's.

    Raises:
        DataError: slices of different sizes or types, files of several pages, more files than `MOST`.
        UsageError: colour slices and no component chosen.
    """
    if len(files) > MOST:
        raise DataError(f"{source}: {len(files)} files; expected at most {MOST} slices")
    out: np.ndarray | None = None
    spacing = (1.0, 1.0, 1.0)
    for z, path in enumerate(files):
        volume = read_tiff(path, options)
        plane = volume.data
        if plane.shape[0] != 1:
            raise DataError(
                f"{path}: {plane.shape[0]} slices in one of {len(files)} files; expected one slice a file (of an OME "
                "set give one of the files alone)"
            )
        if out is None:
            check_memory(len(files) * plane.nbytes, source)
            out, spacing = np.empty((len(files), *plane.shape[1:]), plane.dtype), volume.spacing
        if plane.shape[1:] != out.shape[1:] or plane.dtype != out.dtype:
            raise DataError(
                f"{path}: {plane.shape[2]} x {plane.shape[1]} {plane.dtype}; expected {out.shape[2]} x {out.shape[1]} "
                f"{out.dtype} as in {files[0].name}"
            )
        out[z] = plane[0]
    if out is None:
        raise DataError(f"{source}: no TIFF slices")
    return Volume(out, spacing, name=name)


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
    Reader("TIFF slices", (), lambda head: False, read_folder, holds=lambda folder: bool(_slices(folder)))
)
