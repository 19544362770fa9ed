"""Binary masks of one grid as one label map: a folder or a glob of files named by what they show (TotalSegmentator).

Files of a glob that differ in numbers alone (frame_1, frame_2) are the frames of a series.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError, SeveralArrays, SeveralComponents, SeveralSteps, VvgtError
from vvgt_cli.volume.readers import READERS, is_glob, volume_name
from vvgt_cli.volume.reading import ReadOptions, Segment, Volume, check_memory, listed
from vvgt_cli.volume.registry import read_volume
from vvgt_cli.volume.stored import planes
from vvgt_cli.volume.tiff import PICTURES, SUFFIXES
from vvgt_cli.volume.tiff.pages import check_pages
from vvgt_cli.volume.tiff.slices import by_number, matching

VALUES = (".img", ".img.gz", ".brik", ".brik.gz")  # of a header that is beside them


def hold_volumes(files: Sequence[Path]) -> bool:
    """Tell whether files each hold a volume, and are not the slices of one."""
    if any(file.suffix.lower() not in SUFFIXES for file in files):
        return True
    try:
        return bool(files) and check_pages(files[0]) > 1
    except (DataError, OSError):  # which is reported where it is read
        return False


def mask_files(source: str | Path) -> list[Path]:
    """Return the files of a folder or a glob that is a set of masks, sorted by name; an empty list for any other."""
    folder = Path(source).is_dir()
    if not folder and not is_glob(str(source)):
        return []
    kinds = [reader for reader in READERS if reader.holds is None and not (reader.nameable or reader.resamples)]
    suffixes = tuple(suffix for reader in kinds for suffix in reader.suffixes if suffix not in (*PICTURES, *VALUES))
    there = Path(source).iterdir() if folder else matching(str(source))
    named = (p for p in there if p.name.lower().endswith(suffixes) and p.name[0] != "." and p.is_file())
    files = sorted(named, key=by_number)
    numbered = not folder and len({re.sub(r"\d+", "", path.name) for path in files}) == 1
    if len(files) < 2 or numbered or not hold_volumes(files):
        return []
    dated = [(path, path.stat().st_mtime_ns) for path in files]
    ends = [next((kind for one in some if (kind := _kind(*one))), 0) for some in (dated, dated[::-1])]
    return files if max(ends) >= 0 else []


@lru_cache(maxsize=1024)
def _kind(path: Path, date: int) -> int:
    """Return 1 if a file of this date holds a mask, 0 if an empty one, and -1 if anything else."""
    try:
        return int(_inside(path, ReadOptions())[1].any())
    except (VvgtError, OSError, ValueError):  # reported when it is read
        return -1


def _inside(path: Path, options: ReadOptions) -> tuple[Volume, np.ndarray]:
    """Read a mask: its volume, and whether each voxel (nz, ny, nx) is inside; raise DataError for other values."""
    volume = read_volume(str(path), replace(options, stored=True, packed=True))
    inside, level = np.zeros(volume.data.shape, bool), 0.0
    for within, plane in zip(inside, planes(volume), strict=True):
        values = volume.slope * plane + volume.intercept
        within[...] = values != 0
        there = values[within]
        level = level or float(there[0] if there.size else 0)
        if there.size and (level < 0 or (there != level).any()):
            odd = level if level < 0 else there[there != level][0]
            raise DataError(f"{path}: values such as {odd:g}; expected a mask, of 0 and one other value")
    return volume, inside


def read_masks(source: Path, options: ReadOptions) -> Volume:
    """Read a folder or glob of masks, one at a time, as one label map whose segments are named by the files.

    Values are uint8, or uint16 for more than 255 files: the place of the file by name, from 1. Voxels of several masks
    are those of the smallest, and empty masks are left out; a message says so. The last map stays in memory.

    Raises:
        DataError: a file that is damaged, no mask, or on another grid than the first; all are empty.
        UsageError: options that a file does not take.
    """
    files = mask_files(source)
    dates = tuple(path.stat().st_mtime_ns for path in files)
    return _formed(source, tuple(files), dates, replace(options, crop=None, mask=None, keep_largest=None))


@lru_cache(maxsize=1)
def _formed(source: Path, files: Sequence[Path], dates: Sequence[int], options: ReadOptions) -> Volume:
    """Return the label map of masks; ``dates`` are those of the files."""
    kind = np.min_scalar_type(len(files))
    first, labels = None, np.zeros(0, kind)
    sizes, shared = np.zeros(len(files) + 1, np.int64), np.zeros(len(files) + 1, np.int64)
    named = list[Segment]()
    for number, path in enumerate(files, 1):
        try:
            volume, inside = _inside(path, options)
        except (DataError, SeveralArrays, SeveralComponents, SeveralSteps) as error:
            way = "leave it out of the masks, or read frames of a series by a glob with --labels none"
            text = str(error) if isinstance(error, DataError) else f"{str(error).partition(';')[0]}; expected one mask"
            raise DataError(f"{text} ({way})") from None
        if first is None:
            check_memory(kind.itemsize * inside.size, str(source))
            first, labels, sizes[0] = volume, np.zeros(inside.shape, kind), inside.size + 1
        volume.check_grid(str(path), first, str(files[0]), "masks of one label map share it (give others as --layer)")
        held, sizes[number] = labels[inside], np.count_nonzero(inside)
        shared += np.bincount(held, minlength=len(shared))
        shared[number] = np.count_nonzero(held)
        labels[inside] = np.where(sizes[number] < sizes[held], number, held)
        own = volume.segments[0] if volume.segments and len(volume.segments) == 1 else Segment(number)
        named.append(replace(own, number=number, name=own.name or volume_name(path)))
    assert first is not None
    segments = tuple(one for one in named if sizes[one.number])
    if not segments:
        raise DataError(f"{source}: {len(files)} masks, all empty; expected one with a voxel")
    text = f"{source}: {len(files)} binary masks are read as one label map, named by the files"
    for which, what in ((sizes == 0, "empty, and left out"), (shared > 0, "in several: voxels go to the smaller one")):
        if which[1:].any():
            text += f"; {listed([volume_name(files[int(k)]) for k in np.flatnonzero(which[1:])], ', ')}: {what}"
    warnings.warn(f"{text} (as --layer each, they add up; a glob with --labels none: frames of a series)", stacklevel=2)
    labels.flags.writeable = False
    name = (source if source.is_dir() else files[0].parent).resolve().name or "masks"
    return replace(first, data=labels, name=name, slope=1.0, intercept=0.0, segments=segments)
