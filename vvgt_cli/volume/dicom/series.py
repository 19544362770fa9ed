"""The choice of the images in a DICOM folder that make the volume: one series, and in it one stack of slices.

Localisers (scouts), segmentations and single images of another orientation are skipped where one stack remains, and a
warning says so; where several remain, the error lists them.

Files of a folder or a zip archive are found by content (`vvgt_cli.volume.dicom.is_dicom`).
"""

from __future__ import annotations

import os
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, SeveralArrays, UsageError
from vvgt_cli.volume.dicom import is_dicom
from vvgt_cli.volume.dicom.pet import TAGS as PET
from vvgt_cli.volume.dicom.segmentation import is_segmentation
from vvgt_cli.volume.dicom.volumes import ATTRIBUTES, FEW
from vvgt_cli.volume.microscopy.image import Bounded
from vvgt_cli.volume.reading import check_memory, listed, printable

Source = Path | zipfile.Path

HEAD = 1024  # bytes that tell DICOM from other formats
MAX_FILES = 100_000  # files
TRIED = 1000  # files of a folder that are looked at to see whether it holds DICOM
TAGS: list[Any] = [  # all that is read of a header but its pixels: scanners' hold up to a megabyte of other things
    *ATTRIBUTES,
    *PET,
    *("SOPClassUID", "SOPInstanceUID", "Modality", "SeriesDescription", "SeriesInstanceUID", "SeriesNumber"),
    *("InstanceNumber", "ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing", "FrameOfReferenceUID"),
    *("Rows", "Columns", "SamplesPerPixel", "NumberOfFrames", "PhotometricInterpretation", "SliceThickness"),
    *("SpacingBetweenSlices", "RescaleSlope", "RescaleIntercept", "RescaleType", "DoseGridScaling", "SliceVector"),
    *("GridFrameOffsetVector", "ModalityLUTSequence", "PixelRepresentation", "SharedFunctionalGroupsSequence"),
    *("PerFrameFunctionalGroupsSequence", "DetectorInformationSequence", "FrameIncrementPointer", "SegmentSequence"),
    *("RealWorldValueMappingSequence", "BitsStored", "HighBit"),
]


def is_zip(path: Path) -> bool:
    """Tell whether a file is a zip archive."""
    with path.open("rb") as file:
        return file.read(4) == b"PK\x03\x04"


def _is_dicom_file(path: Source) -> bool:
    try:
        if not path.is_file():  # a pipe would wait
            return False
        with path.open("rb") as file:
            return is_dicom(file.read(HEAD))
    except OSError:
        return False


def holds_dicom(folder: Path) -> bool:
    """Tell whether there is a DICOM file among the first `TRIED` of a folder and the folders in it."""
    return any(map(_is_dicom_file, islice(_every(folder), TRIED)))


def _every(path: Path) -> Iterator[Source]:
    """Walk the files of a folder and the folders in it, or of a zip archive, sorted by name."""
    if not path.is_dir():
        archive = zipfile.ZipFile(path)
        check_memory(sum(info.file_size for info in archive.infolist()), str(path))
        yield from (zipfile.Path(archive, name) for name in sorted(archive.namelist()) if not name.endswith("/"))
        return
    for root, folders, names in os.walk(path):
        folders.sort()
        yield from (Path(root, name) for name in sorted(names))


def read_file(source: Source, pixels: bool = True) -> Any:
    """Read one file as a pydicom.Dataset: whole, or the elements of `TAGS` alone."""
    import pydicom
    from pydicom.uid import ExplicitVRBigEndian, ExplicitVRLittleEndian, ImplicitVRLittleEndian

    tags: Any = None if pixels else TAGS
    with Bounded(source) if isinstance(source, Path) else BytesIO(source.read_bytes()) as stream:
        dataset = pydicom.dcmread(stream, force=True, stop_before_pixels=not pixels, specific_tags=tags)
    if "TransferSyntaxUID" not in dataset.file_meta:  # nothing says how it is coded: as it was found to be
        implicit, little = dataset.original_encoding
        syntax = ImplicitVRLittleEndian if implicit else ExplicitVRLittleEndian if little else ExplicitVRBigEndian
        dataset.file_meta.TransferSyntaxUID = syntax
    return dataset


def headers_in(path: Path) -> list[tuple[Source, Any]]:
    """Read the headers of the DICOM files of a folder, a zip archive, or of one file; copies of an image are skipped.

    A DICOMDIR stands for its folder. The headers of one source are kept until another is read, as each step of a series
    asks for all of them.

    Raises:
        DataError: too many files, or a damaged archive.
    """
    path = path.parent if path.name == "DICOMDIR" else path
    files = [os.path.join(root, name) for root, _, names in os.walk(path) for name in names] or [str(path)]
    if len(files) > MAX_FILES:
        raise DataError(f"{path}: more than {MAX_FILES} files; expected the folder of one series")
    states = (os.lstat(file) for file in files)
    return _headers(path, tuple((state.st_size, state.st_mtime_ns) for state in states))


@lru_cache(maxsize=1)
def _headers(path: Path, _states: tuple[tuple[int, int], ...]) -> list[tuple[Source, Any]]:
    files = (
        [path]
        if path.is_file() and not is_zip(path)
        else [s for s in _every(path) if s.name != "DICOMDIR" and _is_dicom_file(s)]
    )
    unique: dict[Any, tuple[Source, Any]] = {}
    for source in files:
        header = read_file(source, pixels=False)
        keys = ("SOPInstanceUID", "ImagePositionPatient", "InstanceNumber", "AcquisitionTime")
        key = tuple(str(header.get(key, "")) for key in keys)
        unique.setdefault(key if key[0] else source, (source, header))
    if copies := len(files) - len(unique):
        warnings.warn(f"{path}: skipped {copies} files that are copies of others", stacklevel=2)
    return list(unique.values())


LOCALISER = "LOCALIZER"
_SPACE = ("sagittal", "coronal", "axial")

_PLACES = ("ImagePositionPatient", "PerFrameFunctionalGroupsSequence", "DetectorInformationSequence")

Files = list[tuple[Source, Any]]


def choose_series(headers: Sequence[tuple[Source, Any]], wanted: str | None, path: Path) -> tuple[str, Files, str]:
    """Choose the series asked for, or the only one.

    ``wanted`` is number, UID or description of a series; after it, or alone where there is one series, ``/K``, the
    number of a stack in it from 1, and the name of one of its volumes.

    Returns:
        The suffix of the volume's name, the files of the series, and the part of ``wanted`` that names a stack or a
        volume, "" where there is none.

    Raises:
        DataError: no images.
        UsageError: several series and none chosen, or none of that name.
    """
    series: dict[str, Files] = {}
    for file, header in headers:
        if "Rows" in header and "Columns" in header:
            series.setdefault(str(header.get("SeriesInstanceUID", "")), []).append((file, header))
    if not series:
        kinds = Counter(printable(str(header.get("Modality", "?")))[:16] for _, header in headers)
        listing = ", ".join(f"{n} {kind}" for kind, n in kinds.items()) or "no DICOM files"
        structures = kinds["RTSTRUCT"] == kinds.total() > 0
        hint = "; of contours (RTSTRUCT) nothing is filled: export them as a label map or SEG" if structures else ""
        hint = "; unpack a zip of other files" if not kinds and str(path).lower().endswith(".zip") else hint
        raise DataError(f"{path}: no DICOM images ({listing}); expected files with rows and columns of pixels{hint}")
    if wanted is None:
        return "", _only(series, path), ""
    wanted = wanted.strip("/")
    ends = [len(wanted), *(k for k in range(len(wanted) - 1, 0, -1) if wanted[k] == "/")]
    for end in ends:
        if chosen := _named(series, wanted[:end]):
            return f":{wanted}", chosen, wanted[end:].strip("/")
    if len(series) == 1 and not wanted.partition("/")[0].isdecimal():
        return f":{wanted}", next(iter(series.values())), wanted
    raise UsageError(f"{path}: no one series {wanted!r}; it has {_listed(series)}; choose with --series SERIES")


def _only(series: dict[str, Files], path: Path) -> Files:
    """Return the single series of spatially located images, ignoring scouts and segmentations."""
    aside = {
        uid: files
        for uid, files in series.items()
        if all(is_of(LOCALISER, h) or is_segmentation(h) or not any(key in h for key in _PLACES) for _, h in files)
    }
    left = {uid: f for uid, f in series.items() if uid not in aside} or series
    if len(left) > 1:
        text = (
            f"{path}: several series: {_listed(series)}; choose one by number, UID or description with --series SERIES"
        )
        titles = [str(f[0][1].get("SeriesDescription", "")).strip() for f in series.values()]
        raise SeveralArrays(text, "--series", list(series), titles)
    if len(left) < len(series):
        warnings.warn(
            f"{path}: skipped: {_listed(aside)} (localisers, segmentations, images without a position)", stacklevel=2
        )
    return next(iter(left.values()))


def _named(series: dict[str, Files], wanted: str) -> Files:
    """Return the one series with this number, UID or description, else nothing."""
    fits = []
    for uid, files in series.items():
        keys = (str(files[0][1].get(key, "")).strip() for key in ("SeriesNumber", "SeriesDescription"))
        fits += [files] if wanted in (uid, *keys) else []
    return fits[0] if len(fits) == 1 else []


def _listed(series: dict[str, Files]) -> str:
    """List series for an error: number, description, modality, slices, UID."""
    parts = []
    for uid, files in series.items():
        header = files[0][1]
        slices = sum(int(h.get("NumberOfFrames", 1) or 1) for _, h in files)
        parts.append(
            f"{header.get('SeriesNumber', '?')} {str(header.get('SeriesDescription', '')).strip()[:64]!r} "
            f"({header.get('Modality', '?')}, {slices} slice{'s' * (slices != 1)}, {uid})"
        )
    return listed(parts)


def is_of(kind: str, header: Any) -> bool:
    """Tell whether images are of a kind, a word of their Image Type."""
    return kind in [str(word).upper() for word in header.get("ImageType") or []]


def one_stack(
    slices: list[Any], alike: Callable[[Any, Any], bool], number: int | None, title: str, path: Path
) -> list[Any]:
    """Return the slices of one size and orientation: the stack asked for, or the only one of more than `FEW` slices.

    ``alike`` tells whether two slices may lie in one stack; ``number`` counts stacks from 1. Raise SeveralArrays or
    UsageError where it does not choose one.
    """
    stacks: list[list[Any]] = []
    for s in slices:
        home = next((stack for stack in stacks if alike(stack[0], s)), None)
        if home is None:
            stacks.append([s])
        else:
            home.append(s)
    name = title.removeprefix(":").rpartition("/")[0] if number is not None else title.removeprefix(":")
    name = name or str(slices[0].header.get("SeriesNumber") or slices[0].header.get("SeriesInstanceUID") or "?")
    listing = listed([f"{name}/{k}: {_of(stack)}" for k, stack in enumerate(stacks, 1)])
    if number is not None:
        if not 1 <= number <= len(stacks):
            raise UsageError(f"{path}: no stack {name}/{number}; it has {listing}; choose with --series SERIES/STACK")
        return stacks[number - 1]
    if len(stacks) == 1:
        return stacks[0]
    real = [stack for stack in stacks if not all(is_of(LOCALISER, s.header) for s in stack)] or stacks
    large = [stack for stack in real if len(stack) > FEW] if len(real) > 1 else real
    if len(large) != 1:
        raise SeveralArrays(
            f"{path}: slices that differ in size, orientation or pixel spacing: {listing}; choose one with --series "
            "SERIES/STACK", "--series", [f"{name}/{k}" for k in range(1, len(stacks) + 1)], list(map(_of, stacks)),
        )  # fmt: skip
    rest = "; ".join(f"{name}/{k}: {_of(stack)}" for k, stack in enumerate(stacks, 1) if stack is not large[0])
    warnings.warn(f"{path}: skipped, of another size or orientation: {rest[:500]}", stacklevel=2)
    return large[0]


def _of(stack: list[Any]) -> str:
    first = stack[0]
    normal = np.abs(np.cross(first.rows[0], first.rows[1]))
    plane = _SPACE[int(normal.argmax())] if normal.max() > 0.95 else "oblique"
    scout = ", localiser" if is_of(LOCALISER, first.header) else ""
    size = f"{first.header.get('Columns')} x {first.header.get('Rows')}"
    return f"{len(stack)} {plane} slice{'s' * (len(stack) != 1)} of {size}{scout}"
