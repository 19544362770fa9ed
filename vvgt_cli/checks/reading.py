"""Cases of volume reading: every type and byte order, odd grids, values that are not finite, files that lie."""

from __future__ import annotations

import gzip
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.errors import DataError
from vvgt_cli.volume import ReadOptions, Volume, read_volume, statistics
from vvgt_cli.volume.headers import DTYPES
from vvgt_cli.volume.options import parse_dtype

STAGE = "reading"


def _extremes(kind: str) -> np.ndarray:
    """(3, 4, 5) values of a type, its least and greatest among them; NaN and infinities of floats."""
    dtype = np.dtype(kind)
    rng = np.random.default_rng(0)
    if dtype.kind == "f":
        data = rng.normal(size=(3, 4, 5)).astype(dtype)
        data.flat[:5] = [np.finfo(dtype).max, np.finfo(dtype).tiny, np.nan, np.inf, -np.inf]
        return data
    limits = np.iinfo(dtype)
    data = rng.integers(limits.min, limits.max, (3, 4, 5), dtype=dtype, endpoint=True)
    data.flat[:2] = [limits.min, limits.max]
    return data


def _same(read: Volume, written: np.ndarray) -> Figure:
    back = np.asarray(read.data)
    require(back.shape == written.shape, f"shape {back.shape}, {written.shape} written")
    alike = back.astype(written.dtype).tobytes() == written.tobytes()
    return Figure("voxels that differ", float(0 if alike else np.count_nonzero(back != written) or 1), 0)


def _raw(kind: str, order: str, header: int = 0, packed: bool = False) -> Figure:
    written = _extremes(kind)
    content = b"\7" * header + written.astype(parse_dtype(kind, order)).tobytes()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("v.raw.gz" if packed else "v.raw")
        path.write_bytes(gzip.compress(content) if packed else content)
        return _same(read_volume(str(path), ReadOptions((5, 4, 3), kind, order, header)), written)


def _nrrd(endian: str) -> Figure:
    written = _extremes("float32")
    header = f"NRRD0004\ntype: float\ndimension: 3\nsizes: 5 4 3\nendian: {endian}\nencoding: raw\n\n"
    data = written.astype({"little": "<f4", "big": ">f4"}[endian]).tobytes()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "v.nrrd"
        path.write_bytes(header.encode() + data)
        return _same(read_volume(str(path)), written)


def _statistics(data: np.ndarray) -> Figure:
    """Against numpy in float64; the worst of range and counts."""
    numbers = statistics(Volume(data))
    values = data.astype(np.float64)
    finite = values[np.isfinite(values)]
    require(numbers.nan_count == np.isnan(values).sum(), f"{numbers.nan_count} NaN counted")
    require(numbers.inf_count == np.isinf(values).sum(), f"{numbers.inf_count} infinite voxels counted")
    require(numbers.finite_count == finite.size, f"{numbers.finite_count} of {finite.size} voxels in the histogram")
    require(np.isfinite(numbers.edges).all() and (np.diff(numbers.edges) > 0).all(), "edges that do not ascend")
    scale = max(abs(finite.min()), abs(finite.max()), 1e-300)
    off = max(abs(numbers.lo / scale - finite.min() / scale), abs(numbers.hi / scale - finite.max() / scale))
    return Figure("range, relative", float(off), 0)


def _refused(make: Callable[[Path], object]) -> Figure:
    """1 where nothing, or something other than a one-line `DataError`, is raised."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            make(Path(folder))
        except DataError as error:
            require("\n" not in str(error), "an error of several lines")
            return Figure("accepted", 0, 0)
    return Figure("accepted", 1, 0)


def _cut(size: int, folder: Path) -> Volume:
    path = folder / "v_4x4x4_uint16.raw"
    path.write_bytes(bytes(size))
    return read_volume(str(path))


def _header_that_lies(folder: Path) -> Volume:
    path = folder / "v.nrrd"
    path.write_bytes(b"NRRD0004\ntype: float\ndimension: 3\nsizes: 100000 100000 100000\nencoding: raw\n\n" + bytes(64))
    return read_volume(str(path))


def _spacing(spacing: tuple[float, float, float]) -> Figure:
    """The unit frame's longest edge is 2, whatever the spacing."""
    frame = Volume(np.zeros((3, 4, 5), np.uint8), spacing).unit_frame()
    return Figure("longest half edge off 1", abs(max(frame.half) - 1), 1e-12)


GRIDS = {
    "one voxel": np.array([[[3.0]]]),
    "one slice": np.arange(12.0).reshape(1, 3, 4),
    "constant": np.full((3, 3, 3), 7, np.int16),
    "range 1e-30": np.linspace(0, 1e-30, 60).reshape(3, 4, 5),
    "range 1e30": np.linspace(-1e30, 1e30, 60).reshape(3, 4, 5),
    "range 1e308 to both sides": np.linspace(-1.0, 1.0, 60).reshape(3, 4, 5) * 1e308,
    "NaN and infinite voxels": np.array([np.nan, np.inf, -np.inf, 1, 2, 3, np.nan, 5.0]).reshape(2, 2, 2),
    "all 16-bit values": np.arange(65536, dtype=np.uint16).reshape(16, 64, 64),
    "signed, big-endian": np.arange(-32768, 32767, 137, dtype=np.int16)[:448].astype(">i2").reshape(7, 8, 8),
}


def cases() -> Iterator[Case]:
    """All of them."""
    for kind in DTYPES:
        orders = ("little",) if np.dtype(kind).itemsize == 1 else ("little", "big")
        for order in orders:
            yield Case(STAGE, f"raw {kind}, {order}-endian", partial(_raw, kind, order))
    yield Case(STAGE, "raw after an odd header", partial(_raw, "float64", "big", 13))
    yield Case(STAGE, "raw in gzip", partial(_raw, "int16", "big", 5, True))
    for endian in ("little", "big"):
        yield Case(STAGE, f"NRRD, {endian}-endian", partial(_nrrd, endian))
    for name, data in GRIDS.items():
        yield Case(STAGE, f"statistics: {name}", partial(_statistics, data))
    for size in (0, 127, 129):
        yield Case(STAGE, f"raw of {size} bytes that should have 128", partial(_refused, partial(_cut, size)))
    yield Case(STAGE, "header of 4 PB", partial(_refused, _header_that_lies))
    nothing = Volume(np.full((2, 2, 2), np.nan))
    yield Case(STAGE, "nothing but NaN", partial(_refused, lambda _: statistics(nothing)))
    for spacing in ((1.0, 1000.0, 1.0), (1e-30, 1e-30, 1e-27), (1e30, 1.0, 1.0)):
        name = ":".join(f"{s:g}" for s in spacing)
        yield Case(STAGE, f"spacing {name}", partial(_spacing, spacing))
