"""DICOM: a folder of one or more series, or one file (several frames allowed). Read by pydicom.

Geometry: DICOM PS3.3, C.7.6.2 (Image Plane Module), C.7.6.16 (multi-frame functional groups) and C.8.8.3
(dose grids). Slices are ordered by
their positions along the normal of the image plane; names and instance numbers are not used.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.components import select_component
from vvgt_cli.volume.dicom_seg import is_segmentation, names_of, read_segmentation
from vvgt_cli.volume.dicom_select import Files, choose_series, one_stack
from vvgt_cli.volume.libraries import library_errors, need
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import Reader, register
from vvgt_cli.volume.types import Volume

MOST = 100_000  # files
TRIED = 1000  # files of a folder that are looked at to see whether it holds DICOM
HOUNSFIELD = "HU"  # Rescale Type (0028,1054), and what CT's is where it is absent (PS3.3, C.8.2.1.1.5)
ANGLE = 1e-3  # of a unit normal: how far slices may be tilted against each other
EVEN = 0.01  # of the spacing: how far a slice may be off
CODECS = {  # what pydicom decodes a coding with, by words of its name, the first that fits
    "JPEG-LS": "pyjpegls",
    "JPEG 2000": "pylibjpeg pylibjpeg-openjpeg",
    "JPEG": "pylibjpeg pylibjpeg-libjpeg",
}


def _is_dicom(head: bytes) -> bool:
    return head[128:132] == b"DICM"


def _files(folder: Path) -> Iterator[Path]:
    """The DICOM files of a folder and the folders in it, sorted by name."""
    seen = 0
    for root, folders, names in os.walk(folder):
        folders.sort()
        for name in sorted(names):
            seen += 1
            if seen > MOST:
                raise DataError(f"{folder}: more than {MOST} files; expected the folder of one series")
            path = Path(root, name)
            if name != "DICOMDIR" and _has_dicom_prefix(path):
                yield path


def _holds(folder: Path) -> bool:
    """Whether there is a DICOM file among the first `TRIED` of a folder and the folders in it."""
    every = (Path(root, name) for root, _, names in os.walk(folder) for name in names)
    return any(map(_has_dicom_prefix, islice(every, TRIED)))


def _has_dicom_prefix(path: Path) -> bool:
    try:
        if not path.is_file():  # a pipe would wait
            return False
        with open(path, "rb") as file:
            return _is_dicom(file.read(132))
    except OSError:
        return False


@dataclass(frozen=True)
class _Slice:
    """A frame: its file's header, its number in the file, and where it is."""

    path: Path
    frame: int
    header: Any
    position: np.ndarray  # (3,) of the centre of its first pixel
    rows: np.ndarray  # (2, 3) unit vectors along a row (x) and down a column (y)
    spacing: tuple[float, float]  # (x, y)
    scaling: tuple[float, float]  # slope, intercept
    hounsfield: bool  # what the scaling gives, as the header says


def read_dicom(path: Path, options: ReadOptions) -> Volume:
    """Read one series of a folder, or the frames of one file.

    Raises:
        DataError: pydicom is not installed, no images, slices that are missing, tilted or of different sizes.
        UsageError: several series and none chosen (``array`` is a series' number, UID or description).
    """
    pydicom = need("pydicom", "dicom", str(path), "DICOM")
    with library_errors(str(path), "DICOM"):
        files = _files(path) if path.is_dir() else [path]
        headers = [(file, pydicom.dcmread(file, stop_before_pixels=True)) for file in files]
        title, chosen, stack = choose_series(headers, options.array, path)
        if is_segmentation(chosen[0][1]):
            return _segmentation(path, chosen, options)
        slices = [s for file, header in chosen for s in _frames(file, header)]
        slices = _ordered(one_stack(slices, _alike, stack, title, path))
        spacing, direction = _steps(slices, path)
        values, (slope, intercept) = _pixels(pydicom, slices, path)
    field, (slope, intercept) = select_component(
        values, options.component, str(path), label="each pixel", scaling=(slope, intercept)
    )
    told = all(s.hounsfield for s in slices)
    reference = slices[0].header.get("FrameOfReferenceUID")
    return Volume(
        field, options.spacing_or(spacing), tuple(slices[0].position.tolist()), direction,
        f"{path.resolve().name.removesuffix('.dcm')}{title}", slope, intercept, "LPS", told,
        None if reference is None else str(reference),
    )  # fmt: skip


def _segmentation(path: Path, chosen: Files, options: ReadOptions) -> Volume:
    """The label map of a file; of a folder the error names the file, whose own table goes with it."""
    if path.is_dir():
        raise DataError(
            f"{path}: a segmentation (DICOM SEG) of {names_of(chosen[0][1])}; give its file, {chosen[0][0]}, or the "
            "images that it was made on"
        )
    return read_segmentation(path, options)


def _frames(path: Path, header: Any) -> Iterator[_Slice]:
    """The frames of a file: one, or those that functional groups place, or the planes of a dose grid."""
    n = int(header.get("NumberOfFrames", 1) or 1)
    dose = header.get("DoseGridScaling")
    per_frame = header.get("PerFrameFunctionalGroupsSequence")
    shared = (header.get("SharedFunctionalGroupsSequence") or [None])[0]
    if n > 1 and not per_frame and dose is None:
        raise DataError(f"{path}: {n} frames without functional groups; expected a position for each")
    if per_frame and len(per_frame) != n:
        raise DataError(f"{path}: {n} frames, but places for {len(per_frame)}; check that the file is whole")
    for k in range(n):
        groups = [g for g in (per_frame[k] if per_frame else None, shared) if g is not None]

        def item(sequence: str, keyword: str, groups: list[Any] = groups) -> Any:
            for group in groups:
                if sequence in group and keyword in group[sequence][0]:
                    return group[sequence][0][keyword].value
            return header.get(keyword)

        position = item("PlanePositionSequence", "ImagePositionPatient")
        cosines = item("PlaneOrientationSequence", "ImageOrientationPatient")
        between = item("PixelMeasuresSequence", "PixelSpacing")
        if position is None or cosines is None or between is None:
            raise DataError(f"{path}: no ImagePositionPatient, ImageOrientationPatient and PixelSpacing; expected all")
        slope = item("PixelValueTransformationSequence", "RescaleSlope")
        intercept = item("PixelValueTransformationSequence", "RescaleIntercept")
        unit = item("PixelValueTransformationSequence", "RescaleType") or HOUNSFIELD
        hounsfield = header.get("Modality") == "CT" and intercept is not None and unit == HOUNSFIELD
        rows = np.array([float(c) for c in cosines]).reshape(2, 3)
        lengths = np.linalg.norm(rows, axis=1)
        if not np.isfinite(rows).all() or abs(lengths - 1).max() > ANGLE or abs(rows[0] @ rows[1]) > ANGLE:
            raise DataError(
                f"{path}: ImageOrientationPatient {list(cosines)}; expected two unit vectors at right angles"
            )
        scaling = (1.0 if slope is None else float(slope), 0.0 if intercept is None else float(intercept))
        place = np.array([float(c) for c in position])
        if dose is not None:
            scaling = (float(dose), 0.0)
            place = place + _dose_offset(path, header, n, k, np.cross(rows[0], rows[1]))
        yield _Slice(path, k, header, place, rows, (float(between[1]), float(between[0])), scaling, hounsfield)


def _dose_offset(path: Path, header: Any, n: int, k: int, normal: np.ndarray) -> np.ndarray:
    """How far plane k of a dose grid (RTDOSE) is from its ImagePositionPatient (PS3.3, C.8.8.3.2)."""
    offsets = [float(z) for z in header.get("GridFrameOffsetVector") or ([0.0] if n == 1 else [])]
    if len(offsets) != n:
        raise DataError(f"{path}: a dose grid of {n} planes with {len(offsets)} offsets; expected one for each")
    if offsets[0] == 0:
        return offsets[k] * normal
    return np.array([0.0, 0.0, offsets[k] - float(header.ImagePositionPatient[2])])  # these are heights themselves


def _alike(a: _Slice, b: _Slice) -> bool:
    """Whether two slices have one size, orientation and pixel spacing."""
    same = all(a.header.get(k) == b.header.get(k) for k in ("Rows", "Columns", "SamplesPerPixel"))
    return bool(same and np.allclose(a.rows, b.rows, atol=ANGLE) and np.allclose(a.spacing, b.spacing, rtol=1e-4))


def _ordered(slices: list[_Slice]) -> list[_Slice]:
    """By position along the normal."""
    first = slices[0]
    normal = np.cross(first.rows[0], first.rows[1])
    return sorted(slices, key=lambda s: float(s.position @ normal))


def _steps(slices: list[_Slice], path: Path) -> tuple[tuple[float, float, float], tuple[float, ...]]:
    """Spacing (x, y, z) and direction (row-major) from the positions; slices that shift sideways evenly are sheared."""
    first = slices[0]
    normal = np.cross(first.rows[0], first.rows[1])
    if len(slices) == 1:
        thickness = float(first.header.get("SliceThickness") or first.spacing[0])
        return (*first.spacing, thickness), _direction(first, normal)
    positions = np.array([s.position for s in slices])
    steps = np.diff(positions @ normal)
    step = float(np.median(steps))
    if step <= 0 or steps.min() < EVEN * step:
        raise DataError(
            f"{path}: {len(slices)} slices, several in one place (times or echoes in one series); expected one a "
            "position"
        )
    worst = int(np.abs(steps - step).argmax())
    if abs(steps[worst] - step) > EVEN * step:
        raise DataError(
            f"{path}: slices {steps.min():g} to {steps.max():g} mm apart (at {slices[worst].path.name}); expected even "
            "distances: is a slice missing?"
        )
    along = (positions[-1] - positions[0]) / (len(slices) - 1)
    uneven = positions - positions[0] - np.arange(len(slices))[:, None] * along
    uneven -= np.outer(uneven @ normal, normal)
    if np.abs(uneven).max() > EVEN * max(step, *first.spacing) * len(slices):
        raise DataError(
            f"{path}: slices shift sideways unevenly; expected them above each other, or tilted by one angle"
        )
    length = float(np.linalg.norm(along))
    return (*first.spacing, length), _direction(first, along / length)


def _direction(first: _Slice, third: np.ndarray) -> tuple[float, ...]:
    return tuple(np.column_stack([*first.rows, third]).ravel().tolist())


def _pixels(pydicom: Any, slices: list[_Slice], path: Path) -> tuple[np.ndarray, tuple[float, float]]:
    """(slices, rows, columns, samples) stored values and their scaling; differing scalings are applied (float32)."""
    header = slices[0].header
    shape = (int(header.Rows), int(header.Columns), int(header.get("SamplesPerPixel", 1)))
    alike = len({s.scaling for s in slices}) == 1
    out: np.ndarray | None = None
    loaded: tuple[Path, np.ndarray] | None = None
    for z, s in enumerate(slices):
        if loaded is None or loaded[0] != s.path:
            if z == 0:
                check_memory(len(slices) * int(np.prod(shape)) * 2, str(path))
            loaded = (s.path, _decoded(pydicom, s.path))
        frames = loaded[1].reshape(-1, *shape)
        plane = frames[s.frame]
        if not alike:
            plane = (plane * s.scaling[0] + s.scaling[1]).astype(np.float32)
        if out is None:
            check_memory(len(slices) * plane.nbytes, str(path))
            out = np.empty((len(slices), *shape), plane.dtype)
        if plane.dtype != out.dtype:
            raise DataError(f"{s.path}: pixels of type {plane.dtype}; expected {out.dtype} as in the first slice")
        out[z] = plane
    if out is None:
        raise DataError(f"{path}: no slices")
    return out, slices[0].scaling if alike else (1.0, 0.0)


def _decoded(pydicom: Any, path: Path) -> np.ndarray:
    dataset = pydicom.dcmread(path)
    try:
        result: np.ndarray = dataset.pixel_array
        return result
    except (NotImplementedError, RuntimeError) as error:  # a codec that pydicom does not have
        syntax = dataset.file_meta.TransferSyntaxUID
        package = next((package for name, package in CODECS.items() if name in syntax.name), None)
        raise DataError(
            f"{path}: pixels coded as {syntax.name} cannot be decoded ({' '.join(str(error).split())[:200]}); "
            + (f"try: pip install {package}" if package else "convert them to an uncompressed syntax first")
        ) from error


register(Reader("DICOM", (".dcm",), _is_dicom, read_dicom, named_arrays=True, holds=_holds))
