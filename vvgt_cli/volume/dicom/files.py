"""The DICOM files of a folder or a zip archive: found by content, and their headers.

A file begins with a preamble and ``DICM`` (PS3.10, 7.1), or, as older programs wrote it, with the data set itself.
"""

from __future__ import annotations

import os
import warnings
import zipfile
from collections.abc import Iterator
from functools import lru_cache
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.dicom import is_dicom
from vvgt_cli.volume.dicom.volumes import ATTRIBUTES
from vvgt_cli.volume.microscopy.image import Bounded

Source = Path | zipfile.Path

HEAD = 1024  # bytes that tell DICOM from other formats
MOST = 100_000  # files
TRIED = 1000  # files of a folder that are looked at to see whether it holds DICOM
TAGS = [  # all that is read of a header but its pixels: those of scanners hold up to a megabyte of other things
    *ATTRIBUTES,
    *("SOPClassUID", "SOPInstanceUID", "Modality", "SeriesDescription", "SeriesInstanceUID", "SeriesNumber"),
    *("InstanceNumber", "ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing", "FrameOfReferenceUID"),
    *("Rows", "Columns", "SamplesPerPixel", "NumberOfFrames", "PhotometricInterpretation", "SliceThickness"),
    *("SpacingBetweenSlices", "RescaleSlope", "RescaleIntercept", "RescaleType", "DoseGridScaling", "SliceVector"),
    *("GridFrameOffsetVector", "ModalityLUTSequence", "PixelRepresentation", "SharedFunctionalGroupsSequence"),
    *("PerFrameFunctionalGroupsSequence", "DetectorInformationSequence", "FrameIncrementPointer", "SegmentSequence"),
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
    every = (Path(root, name) for root, _, names in os.walk(folder) for name in names)
    return any(map(_is_dicom_file, islice(every, TRIED)))


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
        found = pydicom.dcmread(stream, force=True, stop_before_pixels=not pixels, specific_tags=tags)
    if "TransferSyntaxUID" not in found.file_meta:  # nothing says how it is coded: as it was found to be
        implicit, little = found.original_encoding
        syntax = ImplicitVRLittleEndian if implicit else ExplicitVRLittleEndian if little else ExplicitVRBigEndian
        found.file_meta.TransferSyntaxUID = syntax
    return found


def headers_in(path: Path) -> list[tuple[Source, Any]]:
    """Read the headers of the DICOM files of a folder, a zip archive, or of one file; copies of an image are skipped.

    A DICOMDIR stands for its folder. The headers of one source are kept until another is read, as each step of a series
    asks for all of them.

    Raises:
        DataError: too many files, or a damaged archive.
    """
    path = path.parent if path.name == "DICOMDIR" else path
    files = [os.path.join(root, name) for root, _, names in os.walk(path) for name in names] or [str(path)]
    if len(files) > MOST:
        raise DataError(f"{path}: more than {MOST} files; expected the folder of one series")
    states = (os.lstat(file) for file in files)
    return _headers(path, tuple((state.st_size, state.st_mtime_ns) for state in states))


@lru_cache(maxsize=1)
def _headers(path: Path, _states: tuple[tuple[int, int], ...]) -> list[tuple[Source, Any]]:
    files = (
        [path]
        if path.is_file() and not is_zip(path)
        else [s for s in _every(path) if s.name != "DICOMDIR" and _is_dicom_file(s)]
    )
    found: dict[Any, tuple[Source, Any]] = {}
    for source in files:
        header = read_file(source, pixels=False)
        keys = ("SOPInstanceUID", "ImagePositionPatient", "InstanceNumber", "AcquisitionTime")
        key = tuple(str(header.get(key, "")) for key in keys)
        found.setdefault(key if key[0] else source, (source, header))
    if copies := len(files) - len(found):
        warnings.warn(f"{path}: skipped {copies} files that are copies of others", stacklevel=2)
    return list(found.values())
