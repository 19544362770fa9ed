"""Raw volumes: plain values, x fastest, laid out as the name or the options say.

Names follow open-scivis-datasets: ``name_XxYxZ_dtype.raw``, little-endian.
"""

from __future__ import annotations

import re
import sys
import warnings
from itertools import permutations
from pathlib import Path
from typing import IO

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.blocks import Packed, check_memory, fill, load_block, size_text
from vvgt_cli.volume.options import ReadOptions, parse_dtype
from vvgt_cli.volume.reading import Volume, select_component, volume_name

_NAME = re.compile(r"(?:^|_)(\d+)x(\d+)x(\d+)_(u?int(?:8|16|32|64)|float(?:16|32|64))\.raw(?:\.gz)?$", re.IGNORECASE)
RUNS, LENGTH = 64, 512  # runs of neighbouring values that are sampled for the order of axes, and values in each
LESS = 0.5  # ratio of neighbours' differences, in another order of axes to the given one, below which it is suggested
LEAST = 4  # voxels along an axis below which the order cannot be inferred


def parse_name(name: str) -> tuple[tuple[int, int, int], str] | None:
    """Parse (x, y, z) dims and dtype of an open-scivis name; None for other names."""
    match = _NAME.search(name)
    if match is None:
        return None
    return (int(match[1]), int(match[2]), int(match[3])), match[4].lower()


def layout(name: str, options: ReadOptions) -> tuple[tuple[int, int, int], np.dtype]:
    """Return dims (x, y, z) and dtype: the options', else the name's; raise UsageError if neither says."""
    dims, dtype = parse_name(name) or (None, None)
    dims, dtype = options.dims or dims, options.dtype or dtype
    if dims is None or dtype is None:
        missing = " and ".join(f for f, v in (("--dims X Y Z", dims), ("--dtype TYPE", dtype)) if v is None)
        raise UsageError(
            f"{name}: raw values of unknown layout; give {missing}"
            + ("" if name == "standard input" else ", or name it NAME_XxYxZ_TYPE.raw (as ct_256x256x128_uint16.raw)")
        )
    if min(dims) < 1:
        raise DataError(f"{name}: dims {' x '.join(map(str, dims))}; expected at least 1 along each axis")
    return dims, parse_dtype(dtype, options.byte_order)


def _mismatch(name: str, size: str, dims: tuple[int, int, int], dtype: np.dtype, header: int) -> DataError:
    need = dims[0] * dims[1] * dims[2] * dtype.itemsize + header
    return DataError(
        f"{name}: {size}, but {' x '.join(map(str, dims))} voxels of {dtype.name} after a header of {header} bytes "
        f"make {size_text(need)}; check --dims X Y Z, --dtype and --header-bytes"
    )


def guess_dims(data: np.ndarray) -> tuple[int, int, int] | None:
    """Guess dimensions (x, y, z) in another order, in which neighbouring values differ by less than half as much.

    Neighbouring rows and slices of a volume are alike; read in another order than they were written they are not.

    ``data`` are (nz, ny, nx), contiguous; mapped ones are read in a few places only.

    Returns:
        The order in which neighbours differ least, or None where that given is no worse, or nothing can be inferred.
    """
    given = data.shape[::-1]
    orders = sorted(set(permutations(given)), key=lambda order: order != given)  # the given one first: it wins ties
    if len(orders) == 1 or min(given) < LEAST or not data.flags.c_contiguous:
        return None
    flat, reach = data.reshape(-1), LENGTH + max(x * y for x, y, _ in orders)
    if reach >= flat.size:
        return None
    index = np.linspace(0, flat.size - reach, RUNS).astype(np.int64)[:, None] + np.arange(LENGTH)
    lags = sorted({lag for x, y, _ in orders for lag in (x, x * y)})
    with np.errstate(invalid="ignore", over="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy's, of a mean of nothing but NaN
        here = flat[index].astype(np.float64)
        differs = {lag: float(np.nanmean(np.abs(flat[index + lag].astype(np.float64) - here))) for lag in lags}
    unlike = [differs[x] + differs[x * y] for x, y, _ in orders]
    best = int(np.argmin(unlike))
    return orders[best] if np.isfinite(unlike).all() and unlike[best] < LESS * unlike[0] else None


def _volume(data: np.ndarray, name: str, source: str, options: ReadOptions) -> Volume:
    field, _ = select_component(data[..., None], options.component, source)
    likelier = guess_dims(field)
    if likelier is not None:
        warnings.warn(
            f"{source}: read as {' x '.join(map(str, field.shape[::-1]))}, neighbours differ more than twice as "
            f"much as they would in another order; did you mean --dims {' '.join(map(str, likelier))}?",
            stacklevel=2,
        )
    return Volume(field, spacing=options.spacing_or((1.0, 1.0, 1.0)), name=name)


def read_raw(path: Path, options: ReadOptions) -> Volume:
    """Read a raw file; plain files are memory-mapped, ``.gz`` ones decompressed."""
    dims, dtype = layout(path.name, options)
    need = dims[0] * dims[1] * dims[2] * dtype.itemsize + options.header_bytes
    encoding, size = "gzip" if path.name.lower().endswith(".gz") else "raw", path.stat().st_size
    if encoding == "raw" and size != need:
        raise _mismatch(str(path), f"the file has {size_text(size)}", dims, dtype, options.header_bytes)
    packed = options.packed and options.component is None
    skip = options.header_bytes
    data = load_block(path, dtype, dims[::-1], encoding=encoding, skip=skip, packed=packed, alone=True)
    if isinstance(data, Packed):
        return Volume(data, spacing=options.spacing_or((1.0, 1.0, 1.0)), name=volume_name(path))
    return _volume(data, volume_name(path), str(path), options)


def read_stdin(options: ReadOptions, stream: IO[bytes] | None = None) -> Volume:
    """Read raw values from standard input (or ``stream``); needs dims and dtype. Errors are those of `Reader.read`."""
    if options.array is not None:
        raise UsageError(f"standard input: raw values have no named arrays; leave out --array {options.array}")
    dims, dtype = layout("standard input", options)
    need = dims[0] * dims[1] * dims[2] * dtype.itemsize
    check_memory(need, "standard input")
    stream = stream or sys.stdin.buffer
    header = options.header_bytes
    skipped = len(stream.read(header)) if header else 0
    data, filled = fill(stream, need)
    got = skipped + filled
    if got < need + header:
        raise _mismatch("standard input", f"{size_text(got)} came", dims, dtype, header)
    if stream.read(1):
        raise _mismatch("standard input", f"more than {size_text(got)} came", dims, dtype, header)
    return _volume(data.view(dtype).reshape(dims[::-1]), "stdin", "standard input", options)
