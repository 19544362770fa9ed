"""DICOM: a folder or zip archive of one or more series, or one file (several frames allowed). Read by pydicom.

Geometry: DICOM PS3.3, C.7.6.2 (Image Plane Module), C.7.6.16 (multi-frame functional groups), C.8.4 (nuclear medicine)
and C.8.8.3 (dose grids); Siemens mosaics as nibabel and dcm2niix have them. Slices are ordered by their positions along
the normal of the image plane; names are not used.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.dicom.pet import in_suv
from vvgt_cli.volume.dicom.segmentation import is_segmentation, names_of, read_segmentation
from vvgt_cli.volume.dicom.series import Source, choose_series, headers_in, is_of, one_stack, read_file
from vvgt_cli.volume.dicom.volumes import ATTRIBUTES, one_volume
from vvgt_cli.volume.reading import ReadOptions, Volume, check_memory, need, printable, select_component

HOUNSFIELD = "HU"  # Rescale Type (0028,1054), and what CT's is where it is absent (PS3.3, C.8.2.1.1.5)
ANGLE = 1e-3  # of a unit normal: how far slices may be tilted against each other
EVEN = 0.01  # of the spacing: how far a slice may be off
ROUNDED = 0.25  # of the spacing: how far it may be off by the rounding of its position; a missing slice is 0.5
MOVIE = (0x00181063, 0x00181065)  # Frame Time and its vector: what frames that follow in time are counted by
_REAL = "RealWorldValueMappingSequence"
_VECTORS = [key for key in ATTRIBUTES if key.endswith("Vector")]  # of frames of nuclear medicine
CODECS = {  # what pydicom decodes a coding with, by words of its name, the first that fits
    "JPEG-LS": "pyjpegls",
    "JPEG 2000": "pylibjpeg pylibjpeg-openjpeg",
    "JPEG": "pylibjpeg pylibjpeg-libjpeg",
}


@dataclass(frozen=True)
class _Slice:
    """A frame, or a tile of a mosaic.

    Attributes:
        source: its file.
        frame: its number in the file.
        header: of its file.
        position: (3,) of the centre of its first pixel; without one, multiples of the spacing asked for.
        rows: (2, 3) unit vectors along a row (x) and down a column (y).
        spacing: (x, y).
        scaling: slope, intercept.
        hounsfield: the header says that the scaling gives Hounsfield units.
        placed: the header states a position.
        tiles: along each edge of a mosaic; 1 for other images.
        facts: values of the attributes by which volumes of a series differ.
        instance: number of the image in its series, and of the frame in it.
        real: slope, intercept (NaN in a table) and unit of each mapping to real-world values.
        scaled: the header states a scale or a unit besides.
    """

    source: Source
    frame: int
    header: Any
    position: np.ndarray
    rows: np.ndarray
    spacing: tuple[float, float]
    scaling: tuple[float, float]
    hounsfield: bool
    placed: bool = True
    tiles: int = 1
    facts: dict[str, Any] = field(default_factory=dict)
    real: frozenset[tuple[float, float, str]] = frozenset()
    scaled: bool = False

    @property
    def instance(self) -> float:
        return float(self.header.get("InstanceNumber") or 0)


def read_dicom(path: Path, options: ReadOptions) -> Volume:
    """Read one series of a folder or zip archive, or the frames of one file.

    ``options.time`` chooses one of several volumes in a series (times, echoes, phases, b-values). Slices at uneven
    distances are resampled to ``options.dims``, or taken as even with ``options.spacing``.

    Raises:
        DataError: pydicom is not installed, no images, slices that are missing, tilted or of different sizes.
        UsageError: several series and none chosen (``array`` is a series' number, UID or description), or several
            volumes (`SeveralSteps`).
    """
    need("pydicom", "dicom", str(path), "DICOM")
    title, chosen, rest = choose_series(headers_in(path), options.array, path)
    file, header = chosen[0]
    if is_segmentation(header):
        if path.is_dir():
            raise DataError(
                f"{path}: a segmentation (DICOM SEG) of {names_of(header)}; give its file, {file}, or the images that "
                "it was made on"
            )
        options.step(1, str(path))
        if options.dims or rest:
            raise UsageError(f"{path}: a segmentation, one volume on a grid of its own; leave out --dims and --array")
        return read_segmentation(path, options)
    number, _, name = rest.partition("/")
    name, stack = (name, int(number)) if number.isdecimal() else (rest, None)
    mosaic = next((_mosaic(file) for file, header in chosen if is_of("MOSAIC", header)), None)
    slices = [s for file, header in chosen for s in _frames(file, header, mosaic, options)]
    slices = one_volume(one_stack(slices, _alike, stack, title, path), options, name, path)
    slices, unit = _in_real_world(slices, path)
    if unit is None or options.suv == "bw":
        slices, unit = in_suv(slices, [header for _, header in chosen], options.suv, path)
    normal = np.cross(*slices[0].rows)
    slices.sort(key=lambda s: float(s.position @ normal))
    spacing, direction, heights = _geometry(slices, path, options)
    values, (slope, intercept) = _pixels(slices, path)
    values, (slope, intercept) = select_component(
        values, options.component, str(path), label="each pixel", scaling=(slope, intercept)
    )
    reference = slices[0].header.get("FrameOfReferenceUID")
    volume = Volume(
        values, spacing, tuple(slices[0].position.tolist()), direction,
        f"{path.resolve().name.removesuffix('.dcm').removesuffix('.zip')}{title}", slope, intercept,
        "LPS" if slices[0].placed else None, all(s.hounsfield for s in slices),
        None if reference is None else str(reference),
        modality=printable(str(slices[0].header.get("Modality", "")))[:16], value_unit=unit,
    )  # fmt: skip
    return volume if heights is None else _resampled(volume, heights, options, path)


def _resampled(volume: Volume, heights: np.ndarray, options: ReadOptions, path: Path) -> Volume:
    """Return a volume of slices at ``heights`` (n,) above the first, sampled on the grid asked for."""
    from vvgt_cli.volume.vtk.resample import resample

    x, y = (step * np.arange(n) for step, n in zip(volume.spacing, volume.dims[:2], strict=False))
    values = volume.data * np.float64(volume.slope) + volume.intercept
    sampled = resample([x, y, heights], values.ravel(), options.dims, str(path), volume.name)
    origin = tuple((np.array(volume.origin) + volume.axes @ np.array(sampled.origin)).tolist())
    place: dict[str, Any] = {"spacing": sampled.spacing, "origin": origin, "slope": 1.0, "intercept": 0.0}
    return replace(volume, data=sampled.data, name=sampled.name, **place)


def _mosaic(source: Source) -> tuple[int, np.ndarray | None]:
    """Return the number of slices in a Siemens mosaic, their direction (3,) if stated; raise DataError without one."""
    header = read_file(source)
    count, normal = header.get((0x0019, 0x100A)), None
    if any("CSA HEADER" in str(header.get((0x0029, element), "")) for element in range(0x10, 0x20)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # nibabel's, of readers that are not used here
            csa = need("nibabel.nicom.csareader", "dicom", str(source), "a Siemens mosaic")
        stated = csa.get_csa_header(header, "image")
        normal = None if stated is None else csa.get_slice_normal(stated)
        count = count or (None if stated is None else csa.get_n_mosaic(stated))
    n = int(getattr(count, "value", count) or 0)
    if n < 1:
        raise DataError(
            f"{source}: a mosaic that does not say how many slices it has; expected Siemens' NumberOfImagesInMosaic: "
            "try dcm2niix"
        )
    return n, normal


def _frames(
    source: Source, header: Any, mosaic: tuple[int, np.ndarray | None] | None, options: ReadOptions
) -> Iterator[_Slice]:
    """Yield the frames of a file: one, those of functional groups or of a stack, the tiles of a mosaic."""
    n = int(header.get("NumberOfFrames", 1) or 1)
    per_frame = header.get("PerFrameFunctionalGroupsSequence")
    shared = (header.get("SharedFunctionalGroupsSequence") or [None])[0]
    if per_frame and len(per_frame) != n:
        raise DataError(f"{source}: {n} frames, but places for {len(per_frame)}; check that the file is whole")
    stacked = n > 1 and not per_frame and header.get("DoseGridScaling") is None
    if stacked and header.get("FrameIncrementPointer") in MOVIE:
        raise DataError(f"{source}: {n} frames of a film (its frames follow in time); expected slices of a volume")
    for k in range(n):
        frame = _frame(source, header, [g for g in (per_frame[k] if per_frame else None, shared) if g is not None], k,
                       options, stacked)  # fmt: skip
        if not stacked and mosaic is not None and is_of("MOSAIC", header):
            yield from _tiles(frame, *mosaic)
        else:
            yield frame


def _frame(source: Source, header: Any, groups: list[Any], k: int, options: ReadOptions, stacked: bool) -> _Slice:
    """Describe frame ``k`` by its functional ``groups``, the header, and the detector of nuclear medicine."""
    detector = (header.get("DetectorInformationSequence") or [{}])[0]

    def item(sequence: str, keyword: str, key: str = "") -> Any:
        for group in groups:
            if sequence in group and keyword in group[sequence][0]:
                return group[sequence][0][keyword].value
        return header.get(key or keyword, detector.get(keyword))

    position = item("PlanePositionSequence", "ImagePositionPatient")
    cosines = item("PlaneOrientationSequence", "ImageOrientationPatient")
    between = item("PixelMeasuresSequence", "PixelSpacing")
    placed = position is not None and cosines is not None
    stated = {"ImagePositionPatient": position, "ImageOrientationPatient": cosines, "PixelSpacing": between}
    missing = [key for key, value in stated.items() if value is None]
    if options.spacing is None and missing:
        width = "" if between is None else f" (PixelSpacing is {between[1]:g} x {between[0]:g})"
        raise DataError(
            f"{source}: no {', '.join(missing)}{width}; expected it, or --spacing X Y Z to stack images in the "
            "order of their numbers"
        )
    x, y, z = options.spacing or (1.0, 1.0, 1.0)
    if not placed:
        number = k if stacked else float(header.get("InstanceNumber") or 0)
        position, cosines = [0.0, 0.0, number * z], [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    between = (y, x) if between is None else between
    rows = np.array([float(c) for c in cosines]).reshape(2, 3)
    if (
        not np.isfinite(rows).all()
        or abs(np.linalg.norm(rows, axis=1) - 1).max() > ANGLE
        or abs(rows[0] @ rows[1]) > ANGLE
    ):
        raise DataError(f"{source}: ImageOrientationPatient {list(cosines)}; expected two unit vectors at right angles")
    place = np.array([float(c) for c in position])
    normal = np.cross(rows[0], rows[1])
    if stacked and placed:
        place = place + _stack_offset(source, header, k, options) * normal
    slope, intercept, unit = (
        item("PixelValueTransformationSequence", f"Rescale{w}") for w in ("Slope", "Intercept", "Type")
    )
    scaling = (1.0 if slope is None else float(slope), 0.0 if intercept is None else float(intercept))
    if (dose := header.get("DoseGridScaling")) is not None:
        scaling = (float(dose), 0.0)
        place = place + _dose_offset(source, header, k, normal)
    table = (header.get("ModalityLUTSequence") or [None])[0]
    if table is not None:
        scaling, intercept, unit = (1.0, 0.0), 0.0, table.get("ModalityLUTType")
    hounsfield = header.get("Modality") == "CT" and intercept is not None and (unit or HOUNSFIELD) == HOUNSFIELD
    activity = header.get("Modality") == "PT" and bool(header.get("Units"))
    scaled = activity or scaling != (1, 0) or unit not in (None, "", "US")  # unspecified
    real = _mappings((*groups, header)) if dose is None and table is None else frozenset()
    facts = {key: _fact(item(sequence, keyword, key) if sequence else header.get(key), k if key in _VECTORS else None)
             for key, (_, sequence, keyword) in ATTRIBUTES.items()}  # fmt: skip
    facts = {key: value for key, value in facts.items() if value is not None}
    return _Slice(source, k, header, place, rows, (float(between[1]), float(between[0])), scaling, hounsfield, placed,
                  facts=facts, real=real, scaled=scaled)  # fmt: skip


def _mappings(groups: Sequence[Any]) -> frozenset[tuple[float, float, str]]:
    """Return slope, intercept and unit of the mappings to real-world values (PS3.3, C.7.6.16.2.11)."""
    found = set()
    for mapping in next((group[_REAL] for group in groups if group.get(_REAL)), ()):
        code = str((mapping.get("MeasurementUnitsCodeSequence") or [{}])[0].get("CodeValue", ""))
        unit = "" if code == "1" else printable(code)[:40].replace("[hnsf'U]", HOUNSFIELD)
        numbers = (mapping.get(f"RealWorldValue{word}") for word in ("Slope", "Intercept"))
        slope, intercept = (math.nan if number is None else float(number) for number in numbers)
        found.add((slope, intercept, unit))
    return frozenset(found)


def _in_real_world(slices: list[_Slice], path: Path) -> tuple[list[_Slice], str | None]:
    """Return slices whose ``scaling`` gives real-world values, and their unit, if all slices can be mapped to one.

    Otherwise, as where another scale is stated or a slice has several mappings, slices stay as they are, and the unit
    is None; a warning says so unless the scales are the same.
    """
    mappings = [next(iter(s.real)) for s in slices if len(s.real) == 1 and not s.scaled]
    numbers = [mapping[:2] for mapping in mappings]
    units = {unit for _, _, unit in mappings}
    if len(mappings) == len(slices) and len(units) == 1 and np.isfinite(numbers).all():
        unit = units.pop()
        hounsfield = unit == HOUNSFIELD and slices[0].header.get("Modality") == "CT"
        return [replace(s, scaling=n, hounsfield=hounsfield) for s, n in zip(slices, numbers, strict=True)], unit
    if not all(np.allclose(mapping[:2], s.scaling, rtol=1e-6, atol=0) for s in slices for mapping in s.real):
        warnings.warn(f"{path}: its RealWorldValueMapping is not applied", stacklevel=3)
    return slices, None


def _fact(value: Any, k: int | None) -> Any:
    """Return an attribute as something to compare: a number, a text, or a tuple of texts; of a vector entry ``k``."""
    if value is None or isinstance(value, str):
        return value or None
    if k is not None:
        return float(value[k]) if not isinstance(value, int) else float(value)
    if isinstance(value, int | float):
        return float(value)
    return tuple(map(str, value))


def _stack_offset(source: Source, header: Any, k: int, options: ReadOptions) -> float:
    """Return how far frame ``k`` is from the first along the normal (PS3.3, C.8.4.8): its sign is a direction."""
    step = header.get("SpacingBetweenSlices")
    if step is None:
        step = options.spacing[2] if options.spacing else header.get("SliceThickness")
        if step is None:
            raise DataError(f"{source}: frames without SpacingBetweenSlices; expected it, or --spacing X Y Z")
    order = header.get("SliceVector")
    number = k if order is None else int(order if isinstance(order, int) else order[k]) - 1
    return float(step) * number


def _dose_offset(source: Source, header: Any, k: int, normal: np.ndarray) -> np.ndarray:
    """Return how far plane ``k`` of a dose grid (RTDOSE) is from its ImagePositionPatient (PS3.3, C.8.8.3.2)."""
    n = int(header.get("NumberOfFrames", 1) or 1)
    offsets = [float(z) for z in header.get("GridFrameOffsetVector") or ([0.0] if n == 1 else [])]
    if len(offsets) != n:
        raise DataError(f"{source}: a dose grid of {n} planes with {len(offsets)} offsets; expected one for each")
    if offsets[0] == 0:
        return offsets[k] * normal
    return np.array([0.0, 0.0, offsets[k] - float(header.ImagePositionPatient[2])])  # these are heights themselves


def _tiles(mosaic: _Slice, n: int, stated: np.ndarray | None) -> Iterator[_Slice]:
    """Yield the ``n`` slices of a mosaic; its position is that of a slice of its own size around the same centre.

    Tiles have whole pixels; what they do not fill on the right and below is padding (as nibabel and dcm2niix have it).
    """
    header, edge = mosaic.header, math.ceil(math.sqrt(n))
    rows, columns = int(header.Rows), int(header.Columns)
    if min(rows, columns) < edge:
        raise DataError(
            f"{mosaic.source}: a mosaic of {columns} x {rows} pixels with {n} slices; expected {edge} tiles a side"
        )
    normal = np.cross(mosaic.rows[0], mosaic.rows[1])
    if stated is not None and float(normal @ stated) < 0:
        normal = -normal
    step = float(header.get("SpacingBetweenSlices") or header.get("SliceThickness") or 0)
    if step <= 0:
        raise DataError(f"{mosaic.source}: a mosaic without SpacingBetweenSlices; expected it")
    shift = (columns - columns / edge) / 2 * mosaic.spacing[0], (rows - rows / edge) / 2 * mosaic.spacing[1]
    first = mosaic.position + np.array(shift) @ mosaic.rows
    for k in range(n):
        yield replace(mosaic, frame=k, position=first + k * step * normal, tiles=edge)


def _alike(a: _Slice, b: _Slice) -> bool:
    """Tell whether two slices have one size, orientation and pixel spacing."""
    same = (
        all(a.header.get(k) == b.header.get(k) for k in ("Rows", "Columns", "SamplesPerPixel")) and a.tiles == b.tiles
    )
    return bool(same and np.allclose(a.rows, b.rows, atol=ANGLE) and np.allclose(a.spacing, b.spacing, rtol=1e-4))


def _geometry(
    slices: list[_Slice], path: Path, options: ReadOptions
) -> tuple[tuple[float, float, float], tuple[float, ...], np.ndarray | None]:
    """Find spacing (x, y, z) and direction (row-major); slices that shift sideways evenly are sheared.

    The third is None, or the heights (n,) of slices at uneven distances, which are to be resampled.

    Raises:
        DataError: uneven distances and no way chosen to read them, slices that shift sideways unevenly.
        UsageError: another grid is asked for of even slices.
    """
    first = slices[0]
    normal = np.cross(*first.rows)
    if len(slices) == 1:
        if options.dims is not None:
            raise UsageError(f"{path}: one slice; leave out --dims")
        thickness = float(first.header.get("SliceThickness") or first.spacing[0])
        return options.spacing_or((*first.spacing, thickness)), _direction(first, normal), None
    positions = np.array([s.position for s in slices])
    heights = (positions - positions[0]) @ normal
    uneven = _uneven(slices, heights)
    if not uneven and options.dims is not None:
        raise UsageError(f"{path}: its slices lie at even distances; leave out --dims")
    if uneven and options.dims is None and options.spacing is None:
        steps = np.diff(heights)
        worst = int(np.abs(steps - np.median(steps)).argmax())
        raise DataError(
            f"{path}: slices {steps.min():g} to {steps.max():g} mm apart (at {slices[worst].source.name}); expected "
            "even distances: is a slice missing? --dims X Y Z resamples them to a regular grid, --spacing X Y Z takes "
            "them as even"
        )
    whole = positions[-1] - positions[0]
    aside = positions - positions[0] - np.outer(heights / heights[-1], whole)
    along = whole / (len(slices) - 1)
    if np.abs(aside).max() > EVEN * max(heights[-1] / (len(slices) - 1), *first.spacing) * len(slices):
        raise DataError(
            f"{path}: slices shift sideways unevenly; expected them above each other, or tilted by one angle"
        )
    length = float(np.linalg.norm(along))
    direction, spacing = _direction(first, along / length), options.spacing_or((*first.spacing, length))
    return spacing, direction, heights * (length * (len(slices) - 1) / heights[-1]) if options.dims else None


def _uneven(slices: list[_Slice], heights: np.ndarray) -> bool:
    """Tell whether distances are uneven beyond `EVEN`, and beyond what rounded positions explain."""
    steps = np.diff(heights)
    if np.abs(steps - np.median(steps)).max() <= EVEN * np.median(steps):
        return False
    step = heights[-1] / (len(slices) - 1)
    texts = [str(getattr(c, "original_string", c)) for s in slices for c in s.header.get("ImagePositionPatient") or ()]
    rounding = 10.0 ** -max((len(text.partition(".")[2]) for text in texts), default=16)
    return bool(np.abs(heights - step * np.arange(len(slices))).max() > EVEN * step + min(rounding, ROUNDED * step))


def _direction(first: _Slice, third: np.ndarray) -> tuple[float, ...]:
    return tuple(np.column_stack([*first.rows, third]).ravel().tolist())


def _pixels(slices: list[_Slice], path: Path) -> tuple[np.ndarray, tuple[float, float]]:
    """Read (slices, rows, columns, samples) values and their scaling; differing scalings are applied, as float32."""
    first, header = slices[0], slices[0].header
    shape = (int(header.Rows) // first.tiles, int(header.Columns) // first.tiles, int(header.get("SamplesPerPixel", 1)))
    if header.get("PhotometricInterpretation") == "PALETTE COLOR":
        warnings.warn(f"{path}: its palette is for display; values are as they are stored", stacklevel=3)
    alike = len({s.scaling for s in slices}) == 1
    out: np.ndarray | None = None
    loaded: tuple[Source, np.ndarray] | None = None
    for z, s in enumerate(slices):
        if loaded is None or loaded[0] != s.source:
            if z == 0:
                check_memory(len(slices) * int(np.prod(shape)) * 2, str(path))
            loaded = (s.source, _decoded(s))
        plane = loaded[1].reshape(-1, *shape)[s.frame]
        if not alike:
            plane = (plane * s.scaling[0] + s.scaling[1]).astype(np.float32)
        if out is None:
            check_memory(len(slices) * plane.nbytes, str(path))
            out = np.empty((len(slices), *shape), plane.dtype.newbyteorder("="))
        if plane.dtype.newbyteorder("=") != out.dtype:
            raise DataError(f"{s.source}: pixels of type {plane.dtype}; expected {out.dtype} as in the first slice")
        out[z] = plane
    if out is None:
        raise DataError(f"{path}: no slices")
    return out, first.scaling if alike else (1.0, 0.0)


def _decoded(one: _Slice) -> np.ndarray:
    """Decode a file's pixels by its modality look-up table, a mosaic tile by tile."""
    from pydicom.pixels.processing import apply_modality_lut

    dataset = read_file(one.source)
    stored, high = (one.header.get(key) for key in ("BitsStored", "HighBit"))
    syntax = dataset.file_meta.TransferSyntaxUID
    packed = not syntax.is_transfer_syntax or syntax.is_compressed  # a codec has bits of its own
    if not packed and None not in (stored, high) and high != stored - 1:
        raise DataError(
            f"{one.source}: HighBit {high} with BitsStored {stored}; expected {stored - 1} (DICOM, PS3.5, 8.1.1): "
            "export it again with values in the low bits"
        )
    try:
        values: np.ndarray = dataset.pixel_array
    except (NotImplementedError, RuntimeError) as error:  # a codec that pydicom does not have
        package = next((package for name, package in CODECS.items() if name in syntax.name), None)
        raise DataError(
            f"{one.source}: pixels coded as {syntax.name} cannot be decoded ({' '.join(str(error).split())[:200]}); "
            + (f"try: pip install {package}" if package else "convert them to an uncompressed syntax first")
        ) from error
    if "ModalityLUTSequence" in dataset:
        values = apply_modality_lut(values, dataset)
    if one.tiles > 1:
        rows, columns = (n // one.tiles for n in values.shape[:2])
        values = values[: rows * one.tiles, : columns * one.tiles]
        values = values.reshape(one.tiles, rows, one.tiles, columns).swapaxes(1, 2)
    return values
