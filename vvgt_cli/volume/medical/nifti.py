"""NIfTI-1 and NIfTI-2 (``.nii``, ``.nii.gz``, pairs of ``.hdr`` and ``.img``), and Analyze 7.5 with SPM's variants.

NIfTI is read here because VTK's reader leaves slope and intercept to the caller. Plain files are memory-mapped.
Formats: nifti1.h and nifti2.h (NIMH); scaling as section "DATA SCALING" has it: slope 0 means none. dbh.h (Mayo
Clinic); SPM's scale factor, offset and origin as spm_hread.m has them.
"""

from __future__ import annotations

import math
import re
import struct
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import any_case, load_block, read_head
from vvgt_cli.volume.medical import NIFTI_MAGIC, byte_order, is_analyze, is_nifti
from vvgt_cli.volume.reading import MAX_HEADER, ReadOptions, select_component, unit_rows, volume_name
from vvgt_cli.volume.segments import segments_in, segments_of_xml
from vvgt_cli.volume.types import FLAT, IDENTITY, Volume

_DTYPES = {
    2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8",
}  # fmt: skip
_SPM = {130: "i1", 132: "u2", 136: "u4"}
_COLORS = {128: 3, 2304: 4}  # bytes a voxel
_OTHERS = {1: "bits", 32: "complex64", 1536: "128-bit floats", 1792: "complex128", 2048: "complex256"}
_VECTORS = {*range(1004, 1011), 2003, 2004, *range(2006, 2010), 2016, 2017}  # intents (nifti1.h, FSL's) of components
_LABELS = 1002  # NIFTI_INTENT_LABEL
HEADER = 540  # bytes of the longer one


@dataclass(frozen=True)
class Header:
    """The header of a NIfTI or Analyze file: ``dims`` fastest first, ``pixdim`` with pixdim[0], sform rows 3 x 4."""

    dims: tuple[int, ...]
    dtype: np.dtype
    single: bool
    offset: int
    slope: float
    intercept: float
    pixdim: tuple[float, ...]
    qform: tuple[float, ...] | None = None
    sform: tuple[float, ...] | None = None
    unit: float = 0.0  # in mm; 0 unknown
    samples: int = 0  # bytes of a voxel that is a colour
    start: float = 0.0  # of time, in its unit
    time_unit: str = ""  # where the header states one
    labels: bool = False  # values are, by the intent


def parse_header(head: bytes, name: str) -> Header:
    """Parse the first 348 (NIfTI-1) or 540 (NIfTI-2) bytes; raise DataError if no volume of real numbers begins so."""
    form = byte_order(head)
    if form is None or not is_nifti(head):
        raise DataError(f"{name}: no NIfTI header (348 or 540 bytes with the magic n+1, ni1, n+2 or ni2)")
    order, version = form

    def get(fmt: str, at: int) -> tuple[Any, ...]:
        return struct.unpack_from(order + fmt, head, at)

    if version == 1:
        magic, dim, (code,), pixdim = head[344:348], get("8h", 40), get("h", 70), get("8f", 76)
        offset, slope, intercept = get("3f", 108)
        q_code, s_code = get("2h", 252)
        quatern, sform, units, (start,) = get("6f", 256), get("12f", 280), head[123], get("f", 136)
        (intent,) = get("h", 68)
    else:
        magic, dim, (code,), pixdim = head[4:8], get("8q", 16), get("h", 12), get("8d", 104)
        (offset,), (slope, intercept) = get("q", 168), get("2d", 176)
        q_code, s_code = get("2i", 344)
        quatern, sform, (units, intent), (start,) = get("6d", 352), get("12d", 400), get("2i", 500), get("d", 216)
    if not 1 <= dim[0] <= 7 or min(dim[1 : dim[0] + 1]) < 1:
        raise DataError(f"{name}: dim {dim}; expected 1 to 7 axes of at least 1 voxel each")
    if code not in _DTYPES and code not in _COLORS:
        raise DataError(
            f"{name}: values are {_OTHERS.get(code, f'of unknown type {code}')}; expected real numbers (convert it "
            "to one channel first)"
        )
    if not math.isfinite(offset) or offset < 0:
        raise DataError(f"{name}: vox_offset {offset}; expected 0 or more")
    single = NIFTI_MAGIC[magic]
    least = {1: 352, 2: 544}[version] if single else 0
    dims = dim[1 : dim[0] + 1]
    return Header(
        (*dims[:3], 1, dims[3]) if intent in _VECTORS and len(dims) == 4 else dims,
        np.dtype(order + _DTYPES.get(code, "u1")),
        single,
        max(int(offset), least),
        *_scaling(slope, intercept, name),
        pixdim,
        quatern if q_code > 0 else None,
        sform if s_code > 0 else None,
        {1: 1e3, 2: 1.0, 3: 1e-3}.get(units & 7, 0.0),  # metres, millimetres, micrometres
        _COLORS.get(code, 0),
        start,
        {8: "s", 16: "ms", 24: "us"}.get(units & 0x38, ""),
        intent == _LABELS and code in _DTYPES and np.dtype(_DTYPES[code]).kind in "iu",
    )


def _scaling(slope: float, intercept: float, name: str) -> tuple[float, float]:
    """Return slope and intercept; slope 0 or NaN means that the values are not scaled."""
    if slope == 0 or math.isnan(slope):
        return 1.0, 0.0
    if not math.isfinite(slope) or not math.isfinite(intercept):
        raise DataError(f"{name}: scl_slope {slope}, scl_inter {intercept}; expected finite numbers")
    return slope, intercept


def _place(header: Header) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], str | None]:
    """Return spacing, direction (row-major), origin and space: sform, else qform, else pixdim (nifti1.h, 3, 2, 1).

    Lengths are in the file's unit. A form that is not finite, or whose axes lie in a plane, is ignored. With pixdim
    alone no space is known.
    """
    steps = tuple(abs(p) for p in header.pixdim[1:4])
    if header.sform is not None and all(map(math.isfinite, header.sform)):
        matrix = np.reshape(header.sform, (3, 4))
        lengths, direction = unit_rows(matrix[:, :3].T)
        if min(lengths) > 0 and abs(np.linalg.det(np.reshape(direction, (3, 3)))) > FLAT:
            return lengths, direction, tuple(matrix[:, 3].tolist()), "RAS"
    if header.qform is not None and all(map(math.isfinite, header.qform)):
        return steps, _rotation(header.qform, header.pixdim[0]), header.qform[3:], "RAS"
    return steps, IDENTITY, (0.0, 0.0, 0.0), None


def _rotation(qform: tuple[float, ...], qfac: float) -> tuple[float, ...]:
    """Return the row-major matrix of the quaternion (a, b, c, d) with a >= 0; qfac < 0 turns the third axis round."""
    b, c, d = qform[:3]
    rest = 1.0 - (b * b + c * c + d * d)
    a = math.sqrt(max(0.0, rest))
    if rest < 1e-7:  # half a turn, rounded: nifti1_io.c makes a unit of the other three
        length = math.hypot(b, c, d)
        a, b, c, d = 0.0, b / length, c / length, d / length
    flip = -1.0 if qfac < 0 else 1.0
    rows = (
        (a * a + b * b - c * c - d * d, 2 * (b * c - a * d), flip * 2 * (b * d + a * c)),
        (2 * (b * c + a * d), a * a + c * c - b * b - d * d, flip * 2 * (c * d - a * b)),
        (2 * (b * d - a * c), 2 * (c * d + a * b), flip * (a * a + d * d - b * b - c * c)),
    )
    return tuple(v for row in rows for v in row)


def other_of_pair(path: Path, suffix: str) -> Path | None:
    """Return the ``.img`` of a ``.hdr``, or the reverse, gzip-compressed or not, in any case; None without one."""
    stem = re.sub(r"\.\w+(\.gz)?$", "", path.name, flags=re.IGNORECASE)
    files = [any_case(path.with_name(stem + suffix + packed)) for packed in ("", ".gz")]
    return next((file for file in files if file.is_file()), None)


def read_nifti(path: Path, options: ReadOptions) -> Volume:
    """Read a NIfTI file; plain files are memory-mapped. The fourth axis is time, those beyond it are components.

    The fourth is of components, too, where the intent is a vector. Where it is the only one beyond space, ``component``
    is taken for it in any case.

    sform, else qform, else pixdim say where voxels are; slope and intercept go into the volume. An extension with a
    table of labels in XML (Workbench, TotalSegmentator) gives its segments.
    """
    head, encoding = read_head(path, HEADER)
    header = parse_header(head, str(path))
    volume = _volume(header, path, encoding, options)
    volume = replace(volume, segments=()) if header.labels else volume
    if not header.single:
        return volume
    text = read_head(path, min(header.offset, MAX_HEADER))[0]
    if not (table := re.search(rb"<LabelTable\b.*?</LabelTable>", text, re.DOTALL)):
        return volume
    return replace(volume, segments=segments_in(lambda: segments_of_xml(table[0]), str(path)))


def _volume(header: Header, path: Path, encoding: str, options: ReadOptions) -> Volume:
    """Return the volume of the header in ``path``, whose file has an ``encoding``."""
    source = path
    if not header.single:
        image = other_of_pair(path, ".img")
        if image is None:
            raise DataError(f"{path}: the header of a pair, without its .img file beside it")
        source, encoding = image, "gzip" if image.suffix.lower() == ".gz" else "raw"
    if header.samples:
        n = math.prod(header.dims[3:])
        if n > 1:
            raise DataError(f"{path}: colours of {n} time steps; expected one volume of colours")
        shape = (*reversed((*header.dims, 1, 1)[:3]), header.samples)
        block = load_block(source, header.dtype, shape, encoding=encoding, skip=header.offset)
        field = select_component(block, options.component, str(path), label="its colour", color=True)[0]
        slope, intercept = 1.0, 0.0  # colours are not scaled (nifti1.h)
    else:
        frames = Frames(source, header.dtype, header.dims, header.offset, encoding, header.slope, header.intercept)
        if header.time_unit:
            frames = replace(frames, start=header.start, step=header.pixdim[4], unit=header.time_unit)
        field, (slope, intercept) = load_frames(frames, options, str(path))
    spacing, direction, first, space = _place(header)
    unit, mm = "mm" if header.unit else "", header.unit or 1.0
    steps = tuple(mm * s if n > 1 or s else 1.0 for s, n in zip(spacing, reversed(field.shape), strict=True))
    origin = tuple(mm * o for o in first)
    return Volume(
        field, options.spacing_or(steps), origin, direction, volume_name(path), slope, intercept, space, unit=unit
    )


def read_analyze(path: Path, options: ReadOptions) -> Volume:
    """Read an Analyze pair by its ``.hdr`` or ``.img``; values are memory-mapped. Voxels lie in no anatomical space.

    A message says so, as the format does not store which side is left. SPM's scale factor, offset and origin are used.
    """
    if path.name.lower().endswith((".img", ".img.gz")):
        header = other_of_pair(path, ".hdr")
        if header is None:
            raise DataError(f"{path}: an image without its .hdr beside it; expected a pair, or raw values with --dims")
        from vvgt_cli.volume.registry import read_volume

        return read_volume(str(header), replace(options, crop=None, mask=None, keep_largest=None))  # later
    head, _ = read_head(path, HEADER)
    parsed, place = _parse_analyze(head, str(path))
    volume = _volume(parsed, path, "raw", options)
    warnings.warn(
        f"{path.name}: Analyze does not say which side is left; axes are taken as they are stored (a NIfTI file says)",
        stacklevel=2,
    )
    steps = [abs(step) for step in parsed.pixdim[1:4]]
    origin = tuple(-(at - 1) * step if at else 0.0 for at, step in zip(place, steps, strict=True))
    return replace(volume, origin=origin)


def _parse_analyze(head: bytes, name: str) -> tuple[Header, tuple[int, ...]]:
    """Parse a header, and SPM's origin: the voxel at (0, 0, 0), counted from 1; 0 where there is none."""
    form = byte_order(head)
    if form is None or not is_analyze(head):
        raise DataError(f"{name}: no Analyze header (348 bytes that begin with their number)")
    order = form[0]
    dim, (code,) = struct.unpack_from(order + "8h", head, 40), struct.unpack_from(order + "h", head, 70)
    pixdim = struct.unpack_from(order + "8f", head, 76)
    offset, slope, intercept = struct.unpack_from(order + "3f", head, 108)
    sizes = dim[1 : dim[0] + 1]
    while len(sizes) > 3 and sizes[-1] == 0:  # some writers leave axes beyond the third at 0
        sizes = sizes[:-1]
    if min(sizes) < 1:
        raise DataError(f"{name}: dim {dim}; expected 1 to 7 axes of at least 1 voxel each")
    kinds = _DTYPES | _SPM
    if code not in kinds:
        raise DataError(f"{name}: values of type {code}; expected real numbers (convert it to one channel first)")
    slope, intercept = _scaling(slope, intercept, name)
    intercept = intercept if math.isfinite(intercept) else 0.0
    header = Header(sizes, np.dtype(order + kinds[code]), False, int(abs(offset)), slope, intercept, pixdim)
    return header, struct.unpack_from(order + "3h", head, 253)


@dataclass(frozen=True)
class Frames:
    """Values in a file: ``dims`` fastest first, of which the fourth is time and those beyond it are components.

    ``offset`` counts decompressed bytes. ``start``, ``step`` and ``unit`` are of time, where the file states a unit.
    """

    path: Path
    dtype: np.dtype
    dims: tuple[int, ...]
    offset: int
    encoding: str
    slope: float = 1.0
    intercept: float = 0.0
    start: float = 0.0
    step: float = 0.0
    unit: str = ""


def load_frames(frames: Frames, options: ReadOptions, source: str) -> tuple[np.ndarray, tuple[float, float]]:
    """Load the volume (nz, ny, nx) that the options choose, memory-mapped where it is plain, and slope and intercept.

    Where the fourth axis is the only one beyond space, ``component`` is taken for it too. Errors are those of
    `Reader.read`.
    """
    spatial, offset = (*frames.dims, 1, 1)[:3], frames.offset
    times, rest = _times(frames, options, source)
    step, component = options.time or 0, options.component
    number = None  # of the one volume that must be loaded
    if rest == 1:
        number = step
    elif isinstance(component, int) and component < rest:
        number, component = component * times + step, None
    if number is not None:
        offset += number * math.prod(spatial) * frames.dtype.itemsize
        times, rest, step = 1, 1, 0
    scaling, encoding = (frames.slope, frames.intercept), frames.encoding
    if options.packed and encoding != "raw" and (rest, times, options.component) == (1, 1, None):
        packed = load_block(frames.path, frames.dtype, spatial[::-1], encoding=encoding, skip=offset, packed=True)
        return packed, scaling
    shape = (rest, times, *reversed(spatial))  # (c, t, z, y, x)
    block = load_block(frames.path, frames.dtype, shape, encoding=encoding, skip=offset)
    values, label = np.moveaxis(block[:, step], 0, -1), "the series" if rest > 1 else ""
    return select_component(values, component, source, label=label, scaling=scaling)


def _times(frames: Frames, options: ReadOptions, source: str) -> tuple[int, int]:
    """Count time steps and components; a lone fourth axis counts as components where a component is asked for."""
    times, rest = math.prod(frames.dims[3:4]), math.prod(frames.dims[4:])
    if options.time is None and options.component is not None and times > 1 == rest:
        return 1, times
    known = frames.unit and math.isfinite(frames.step) and frames.step > 0 and math.isfinite(frames.start)
    at = [frames.start + k * frames.step for k in range(times)] if known else None
    options.step(times, source, times=at, unit=frames.unit)
    return times, rest
