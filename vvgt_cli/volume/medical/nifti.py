"""NIfTI-1 and NIfTI-2, single files (``.nii``, ``.nii.gz``) and pairs (``.hdr`` + ``.img``).

Read here because VTK's reader leaves slope and intercept to the caller. Plain files are memory-mapped.
Format: nifti1.h and nifti2.h (NIMH); scaling as section "DATA SCALING" has it: slope 0 means none.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import any_case, load_block
from vvgt_cli.volume.components import select_component
from vvgt_cli.volume.headers import unit_rows
from vvgt_cli.volume.medical import NIFTI_MAGIC, byte_order, is_nifti
from vvgt_cli.volume.medical.frames import Frames, load_frames, read_head
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import volume_name
from vvgt_cli.volume.types import FLAT, IDENTITY, Volume

DTYPES = {
    2: "u1",
    4: "i2",
    8: "i4",
    16: "f4",
    64: "f8",
    256: "i1",
    512: "u2",
    768: "u4",
    1024: "i8",
    1280: "u8",
}
_COLORS = {128: 3, 2304: 4}  # bytes a voxel
_OTHERS = {
    1: "bits",
    32: "complex64",
    1536: "128-bit floats",
    1792: "complex128",
    2048: "complex256",
}
HEADER = 540  # bytes of the longer one


@dataclass(frozen=True)
class Header:
    """What a NIfTI header says: ``dims`` fastest first, ``pixdim`` with pixdim[0], sform rows 3 x 4."""

    dims: tuple[int, ...]
    dtype: np.dtype
    single: bool
    offset: int
    slope: float
    intercept: float
    pixdim: tuple[float, ...]
    qform: tuple[float, ...] | None
    sform: tuple[float, ...] | None
    unit: float = 1.0  # mm
    samples: int = 0  # bytes of a voxel that is a colour
    start: float = 0.0  # of time, in its unit
    time_unit: str = ""  # where the header says one
    unit_known: bool = False  # of lengths


def parse_header(head: bytes, name: str) -> Header:
    """Parse the first 348 (NIfTI-1) or 540 (NIfTI-2) bytes.

    Raises:
        DataError: no NIfTI header, a type without real numbers, or sizes below 1.
    """
    found = byte_order(head)
    if found is None or not is_nifti(head):
        raise DataError(f"{name}: no NIfTI header (348 or 540 bytes with the magic n+1, ni1, n+2 or ni2)")
    order, version = found

    def get(fmt: str, at: int) -> tuple[Any, ...]:
        return struct.unpack_from(order + fmt, head, at)

    if version == 1:
        magic, dim, (code,), pixdim = head[344:348], get("8h", 40), get("h", 70), get("8f", 76)
        offset, slope, intercept = get("3f", 108)
        q_code, s_code = get("2h", 252)
        quatern, sform, units, (start,) = get("6f", 256), get("12f", 280), head[123], get("f", 136)
    else:
        magic, dim, (code,), pixdim = head[4:8], get("8q", 16), get("h", 12), get("8d", 104)
        (offset,), (slope, intercept) = get("q", 168), get("2d", 176)
        q_code, s_code = get("2i", 344)
        quatern, sform, (units,), (start,) = get("6d", 352), get("12d", 400), get("i", 500), get("d", 216)
    if not 1 <= dim[0] <= 7 or min(dim[1 : dim[0] + 1]) < 1:
        raise DataError(f"{name}: dim {dim}; expected 1 to 7 axes of at least 1 voxel each")
    if code not in DTYPES and code not in _COLORS:
        raise DataError(
            f"{name}: values are {_OTHERS.get(code, f'of unknown type {code}')}; expected real numbers (convert it "
            "to one channel first)"
        )
    if not math.isfinite(offset) or offset < 0:
        raise DataError(f"{name}: vox_offset {offset}; expected 0 or more")
    slope, intercept = scaling(slope, intercept, name)
    single = NIFTI_MAGIC[magic]
    least = {1: 352, 2: 544}[version] if single else 0
    return Header(
        dim[1 : dim[0] + 1],
        np.dtype(order + DTYPES.get(code, "u1")),
        single,
        max(int(offset), least),
        slope,
        intercept,
        pixdim,
        quatern if q_code > 0 else None,
        sform if s_code > 0 else None,
        {1: 1e3, 3: 1e-3}.get(units & 7, 1.0),  # metres, micrometres
        _COLORS.get(code, 0),
        start,
        {8: "s", 16: "ms", 24: "us"}.get(units & 0x38, ""),
        units & 7 in (1, 2, 3),
    )


def scaling(slope: float, intercept: float, name: str) -> tuple[float, float]:
    """Slope and intercept; slope 0 or NaN means that the values are not scaled."""
    if slope == 0 or math.isnan(slope):
        return 1.0, 0.0
    if not math.isfinite(slope) or not math.isfinite(intercept):
        raise DataError(f"{name}: scl_slope {slope}, scl_inter {intercept}; expected finite numbers")
    return slope, intercept


def _place(header: Header) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], str | None]:
    """Spacing, direction (row-major), origin and space: sform, else qform, else pixdim (nifti1.h, methods 3, 2, 1).

    A form that is not finite, or whose axes lie in a plane, is passed over. Of pixdim alone no space is known.
    """
    steps = tuple(abs(p) for p in header.pixdim[1:4])
    if header.sform is not None and all(map(math.isfinite, header.sform)):
        m = header.sform
        lengths, direction = unit_rows([[m[4 * row + column] for row in range(3)] for column in range(3)])
        if min(lengths) > 0 and abs(np.linalg.det(np.reshape(direction, (3, 3)))) > FLAT:
            return _in_mm(header, lengths), direction, _in_mm(header, (m[3], m[7], m[11])), "RAS"
    if header.qform is not None and all(map(math.isfinite, header.qform)):
        return _in_mm(header, steps), _rotation(header), _in_mm(header, header.qform[3:]), "RAS"
    return steps, IDENTITY, (0.0, 0.0, 0.0), None


def _in_mm(header: Header, lengths: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(header.unit * length for length in lengths)


def _rotation(header: Header) -> tuple[float, ...]:
    """Row-major, of the quaternion (a, b, c, d) with a >= 0; pixdim[0] < 0 turns the third axis round."""
    assert header.qform is not None
    b, c, d = header.qform[:3]
    rest = 1.0 - (b * b + c * c + d * d)
    a = math.sqrt(max(0.0, rest))
    if rest < 1e-7:  # half a turn, rounded: nifti1_io.c makes a unit of the other three
        length = math.hypot(b, c, d)
        a, b, c, d = 0.0, b / length, c / length, d / length
    flip = -1.0 if header.pixdim[0] < 0 else 1.0
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

    Where the fourth axis is the only one beyond space, ``component`` is taken for it too.

    sform, else qform, else pixdim say where voxels are; slope and intercept go into the volume.

    Raises:
        DataError: a header that is damaged or does not fit the data, or complex values.
        UsageError: several components, or time steps (`SeveralSteps`), and none chosen.
    """
    head, zipped = read_head(path, HEADER)
    return read_parsed(parse_header(head, str(path)), path, zipped, options)


def read_parsed(header: Header, path: Path, zipped: bool, options: ReadOptions) -> Volume:
    """The volume of the header in ``path``, a file that may be ``zipped``; arguments and errors as `read_nifti`."""
    source = path
    if not header.single:
        image = other_of_pair(path, ".img")
        if image is None:
            raise DataError(f"{path}: the header of a pair, without its .img file beside it")
        source, zipped = image, image.suffix.lower() == ".gz"
    if header.samples:
        spatial = (*header.dims, 1, 1)[:3]
        return _placed(header, _colors(header, source, zipped, spatial, path, options), path, options)
    frames = Frames(source, header.dtype, header.dims, header.offset, zipped, header.slope, header.intercept)
    if header.time_unit:
        frames = replace(frames, start=header.start, step=header.pixdim[4], unit=header.time_unit)
    field, (slope, intercept) = load_frames(frames, options, str(path))
    return _placed(replace(header, slope=slope, intercept=intercept), field, path, options)


def _colors(
    header: Header, source: Path, zipped: bool, spatial: tuple[int, ...], path: Path, options: ReadOptions
) -> np.ndarray:
    """One component of RGB or RGBA voxels, (nz, ny, nx)."""
    if math.prod(header.dims[3:]) > 1:
        raise DataError(f"{path}: colours of {math.prod(header.dims[3:])} time steps; expected one volume of colours")
    shape, offset = (*reversed(spatial), header.samples), header.offset
    if zipped:
        block = load_block(source, header.dtype, shape, encoding="gzip", skip=offset)
    else:
        block = load_block(source, header.dtype, shape, offset=offset)
    return select_component(block, options.component, str(path), label="its colour", color=True)[0]


def _placed(header: Header, field: np.ndarray, path: Path, options: ReadOptions) -> Volume:
    """The volume of a field (nz, ny, nx), where the header says."""
    spacing, direction, origin, space = _place(header)
    steps = tuple(s if n > 1 or s else 1.0 for s, n in zip(spacing, reversed(field.shape), strict=True))
    return Volume(
        field,
        options.spacing_or(steps),
        origin,
        direction,
        volume_name(path),
        header.slope,
        header.intercept,
        space,
        unit="mm" if header.unit_known else "",
    )
