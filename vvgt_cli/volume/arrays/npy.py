"""NumPy arrays (``.npy``, memory-mapped; ``.npz``), without pickle.

Format: https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html
"""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from tokenize import TokenError
from typing import IO

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.arrays.beside import Neighbour, choose_grid, with_neighbours
from vvgt_cli.volume.blocks import MAX_RATIO, check_memory, count, fill, load_block, size_text
from vvgt_cli.volume.labelled import Axis, labelled_volume
from vvgt_cli.volume.reading import ReadOptions, Volume, choose, volume_name

_HEADER = 1 << 16
MAX_BESIDE = 1 << 23  # bytes of an array of coordinates


def _header(stream: IO[bytes], source: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Read shape, whether the first axis is the fastest, and type; leave the stream at the values."""
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise DataError(f"{source}: .npy version {version}; expected 1.0 to 3.0")
    reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    try:
        shape, fortran, dtype = reader(stream, max_header_size=_HEADER)
    except (TokenError, SyntaxError, TypeError) as error:
        # numpy reads headers of Python 2 with a tokenizer, others as Python; of types it takes what it gets
        raise DataError(f"{source}: damaged .npy header ({error.args[0]}); check that it is whole") from error
    if dtype.kind not in "iufb":
        raise DataError(f"{source}: values of type {dtype}; expected integers or floats (objects are never unpickled)")
    return shape, fortran, dtype


def _volume(
    values: np.ndarray, shape: tuple[int, ...], fortran: bool, options: ReadOptions, source: str, name: str,
    beside: Mapping[str, Neighbour] | None = None,
) -> Volume:  # fmt: skip
    """Make a volume of values in file order; axes are z, y, x, and at most one of components at either end."""
    array = values.reshape(shape[::-1]).T if fortran else values.reshape(shape)
    choose_grid({(own := name.rpartition(":")[2]): (shape, values.dtype.name)}, own, source)
    axes = with_neighbours([Axis("", n) for n in shape], beside or {}, source, options.spacing is not None)
    return labelled_volume(array, array.dtype, axes, {}, options, source, name)


def read_npy(path: Path, options: ReadOptions) -> Volume:
    """Read a ``.npy`` file."""
    with open(path, "rb") as file:
        shape, fortran, dtype = _header(file, str(path))
        start = file.tell()
    values = load_block(path, dtype, (count(shape),), offset=start)
    return _volume(values, shape, fortran, options, str(path), volume_name(path))


def read_npz(path: Path, options: ReadOptions) -> Volume:
    """Read one array of a ``.npz`` file; one that is stored plainly is memory-mapped."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            members = {name: info for name, info in members.items() if info.filename.endswith(".npy")}
            name = _choose(archive, members, options.array, path)
            values, shape, fortran = _member(archive, members[name], path)
            small = [key for key, info in members.items() if info.file_size <= MAX_BESIDE and key != name]
            lines = {}
            for key in small:
                with suppress(zipfile.BadZipFile, EOFError, ValueError, zlib.error):  # objects, or damaged
                    lines[key] = np.load(io.BytesIO(archive.read(members[key])), allow_pickle=False)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        raise DataError(f"{path}: damaged .npz file ({str(error)[:200]}); check that it is whole") from error
    beside = {key: Neighbour.of(line.shape, lambda line=line: (line, {})) for key, line in lines.items()}
    return _volume(values, shape, fortran, options, f"{path}:{name}", f"{volume_name(path)}:{name}", beside)


def _choose(archive: zipfile.ZipFile, members: dict[str, zipfile.ZipInfo], wanted: str | None, path: Path) -> str:
    if not members:
        raise DataError(f"{path}: a zip file without .npy arrays; expected a .npz file")
    if wanted is not None:
        names = list(members)
        return names[choose(names, names, wanted.strip("/"), str(path))]
    shapes = {}
    for name, info in members.items():
        with archive.open(info) as stream:
            head = io.BytesIO(stream.read(_HEADER))
        try:
            shape, _, dtype = _header(head, f"{path}:{name}")
            shapes[name] = shape, dtype.name
        except (DataError, ValueError):
            continue
    return choose_grid(shapes or dict.fromkeys(members, ((1, 1), "")), None, str(path))


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> tuple[np.ndarray, tuple[int, ...], bool]:
    source = f"{path}:{info.filename}"
    with archive.open(info) as stream:
        shape, fortran, dtype = _header(stream, source)
        start, need = stream.tell(), count(shape) * dtype.itemsize
        if start + need != info.file_size or need > info.compress_size * MAX_RATIO["bzip2"] + 4096:
            raise DataError(
                f"{source}: {size_text(info.file_size)} in {size_text(info.compress_size)} of the zip file; expected "
                f"{size_text(start + need)} for {shape} values of {dtype}"
            )
        if info.compress_type == zipfile.ZIP_STORED:
            with open(path, "rb") as file:  # name and extra field may differ from those of the zip's directory
                file.seek(info.header_offset + 26)
                skip = sum(struct.unpack("<HH", file.read(4)))
            offset = info.header_offset + 30 + skip + start
            return load_block(path, dtype, (count(shape),), offset=offset), shape, fortran
        check_memory(need, source)
        values, filled = fill(stream, need)
    if filled < need:
        raise DataError(f"{source}: holds {filled} bytes of values, expected {need}; check that the file is whole")
    return values.view(dtype), shape, fortran
