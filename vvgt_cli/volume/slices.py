"""Volumes as many files: a folder or a glob of slices (TIFF, PNG, BMP, JPEG), in the order of their numbers."""

from __future__ import annotations

import glob
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.pictures import KINDS, picture_planes
from vvgt_cli.volume.readers import Reader, register
from vvgt_cli.volume.scan_logs import log_spacing
from vvgt_cli.volume.slice_names import by_number, in_order, listed
from vvgt_cli.volume.tiff import SUFFIXES as TIFF
from vvgt_cli.volume.tiff import read_tiff
from vvgt_cli.volume.tiff_stored import checked, lazy_files
from vvgt_cli.volume.types import Volume

MOST = 100_000  # files
SUFFIXES = (*TIFF, *(suffix for suffixes in KINDS.values() for suffix in suffixes))


def matching(pattern: str) -> list[Path]:
    """The files of a glob, sorted by the numbers in their names."""
    return sorted((path for path in map(Path, glob.glob(pattern)) if path.is_file()), key=by_number)


def slices_of(folder: Path) -> list[Path]:
    """Return the slices in a folder, sorted by the numbers in their names: of the format that has most, TIFF if equal.

    One picture alone is none.
    """
    files = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".") and p.is_file()]
    slices = _of_one_kind(sorted(files, key=by_number))
    return slices if len(slices) > 1 or not slices or slices[0].suffix.lower() in TIFF else []


def _of_one_kind(files: list[Path]) -> list[Path]:
    """Return the files of the format that most of them have."""
    kinds = [[p for p in files if p.suffix.lower() in suffixes] for suffixes in (TIFF, *KINDS.values())]
    return max(kinds, key=len)


def read_folder(folder: Path, options: ReadOptions) -> Volume:
    """Read a folder of slices.

    Raises:
        DataError: as `read_slices`.
    """
    slices = slices_of(folder)
    others = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file() and p not in set(slices)]
    return read_slices(slices, options, str(folder), folder.resolve().name, sorted(others, key=by_number))


def read_slices(
    files: list[Path], options: ReadOptions, source: str, name: str, others: list[Path] | None = None
) -> Volume:
    """Read slices, file z with rows from the top as y; the spacing is the first file's, else that of a scanner's log.

    Args:
        files: of one format.
        options: see `ReadOptions`.
        source, name: for messages, of the volume.
        others: files beside them that are not read, which a warning says.

    Raises:
        DataError: slices of different sizes or types, names of several stacks, files of several pages, more files than
            `MOST`.
        UsageError: colour slices and no component chosen.
    """
    if len(files) > MOST:
        raise DataError(f"{source}: {len(files)} files; expected at most {MOST} slices")
    if not files:
        raise DataError(f"{source}: no slices ({', '.join(SUFFIXES)})")
    if others:
        warnings.warn(f"{source}: {listed(others)} skipped: not of the format of most slices", stacklevel=2)
    files, step = in_order(files, source)

    def page_of(path: Path, slices: int = 1) -> Volume:
        how = replace(options, stored=False, spacing=options.spacing if slices > 1 else (1.0, 1.0, 1.0))
        volume = read_tiff(path, how, slices)
        if volume.data.shape[0] != 1:
            raise DataError(
                f"{path}: {volume.data.shape[0]} slices in one of {len(files)} files; expected one slice a file (of an "
                "OME set give one of the files alone)"
            )
        return volume

    if files[0].suffix.lower() in TIFF:
        first, read = page_of(files[0], len(files)), lambda path: page_of(path).data
    else:
        read = picture_planes(files, options, source)
        first = Volume(read(files[0]), options.spacing_or((1.0, 1.0, 1.0)))
    plane, spacing, unit = first.data, first.spacing, first.unit
    if not unit and (options.spacing is not None or spacing == (1.0, 1.0, 1.0)):
        spacing, unit = log_spacing(files[0], first.dims[:2], step, options.spacing) or (spacing, unit)
    if options.stored:
        field: Any = lazy_files(files, plane, read, source)
        return Volume(field, spacing, name=name, unit=unit)
    check_memory(len(files) * plane.nbytes, source)
    out = np.empty((len(files), *plane.shape[1:]), plane.dtype)
    for z, path in enumerate(files):
        out[z] = checked(read(path) if z else plane, plane, path, files[0])[0]
    return Volume(out, spacing, name=name, unit=unit)


def read_glob(pattern: str, options: ReadOptions) -> Volume | None:
    """Return the volume of a glob of slices; None where no file fits the pattern.

    Raises:
        DataError: files of other formats.
    """
    files = matching(pattern)
    if not files:
        return None
    slices = _of_one_kind(files)
    if not slices:
        raise DataError(
            f"{pattern}: {files[0].name} is no slice; expected slices ({', '.join(SUFFIXES)}), one file, or frames of a "
            "series with a number in -o, as out_{:04d}.ply"
        )
    name = re.sub(r"[\W_]+$", "", slices[0].stem.rstrip("0123456789")) or "slices"
    return read_slices(slices, options, pattern, name, [path for path in files if path not in set(slices)])


READER = register(
    Reader(
        "slices", (), lambda head: False, read_folder,
        holds=lambda folder: bool(slices_of(folder)), within=("TIFF", "picture"),
    )
)  # fmt: skip
