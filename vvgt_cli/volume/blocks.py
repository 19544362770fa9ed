"""Blocks of numbers in files: mapped where stored plainly, decompressed within bounds otherwise.

Headers may lie, so every size is checked against the file, and against free memory, before anything is allocated.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import math
import mmap
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.resources import free_memory

# The most that each coding can expand: deflate 258 bytes from 2 bits, bzip2 about 900 kB from some 40 bytes.
MAX_RATIO = {"gzip": 1040, "zlib": 1040, "bzip2": 25000}
SHARE = 0.25  # of the free memory: what takes less is decompressed at once
LZMA_MEMORY = 1 << 28  # bytes of a dictionary: the strongest preset needs a quarter, a damaged header says gigabytes
_CHUNK = 1 << 20


def count(shape: tuple[int, ...]) -> int:
    """Multiply the sizes of a shape in exact integers (headers can overflow 64 bits)."""
    return math.prod(int(n) for n in shape)


def size_text(n_bytes: int) -> str:
    """Format a number of bytes for people: ``1234 bytes`` or ``3.2 GiB``."""
    return f"{n_bytes} bytes" if n_bytes < 1 << 20 else f"{n_bytes} bytes ({n_bytes / 2**30:.3g} GiB)"


MAPPED = "store it uncompressed (raw and .nhdr files are mapped, not loaded)"
AS_NUMBERS = "convert it to a format of plain numbers, such as .mrc, .vti or raw, which is mapped, not loaded"
IN_BLOCKS = "use 'vvgt convert', 'init', 'evaluate', 'render-views' or 'report', which process it in blocks"


def check_memory(need: int, what: str, instead: str = MAPPED) -> None:
    """Raise `DataError` if ``need`` bytes exceed the free memory; ``instead`` is what else may be done."""
    free = free_memory()
    if free is not None and need > free:
        raise DataError(
            f"{what}: needs {size_text(need)} of memory, {size_text(free)} are free; "
            f"give it {size_text(need - free)} more, or {instead}"
        )


def is_large(need: int) -> bool:
    """Tell whether ``need`` bytes are more than `SHARE` of the free memory."""
    free = free_memory()
    return free is not None and need > SHARE * free


class _ZlibStream:
    """``read(n)`` over a zlib stream in a file; it never holds more than it was asked for."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._engine = zlib.decompressobj()

    def read(self, n: int) -> bytes:
        while not self._engine.eof:
            data = self._engine.unconsumed_tail or self._file.read(_CHUNK)
            out = self._engine.decompress(data, n)
            if out:
                return out
            if not data:
                raise EOFError("the compressed data end too early")
        return b""


_OPENERS: dict[str, Callable[[IO[bytes]], Any]] = {
    "gzip": lambda file: gzip.GzipFile(fileobj=file),
    "bzip2": lambda file: bz2.BZ2File(file),
    "zlib": _ZlibStream,
}


_ENGINES: dict[str, Callable[[], Any]] = {
    "gzip": lambda: zlib.decompressobj(31),
    "zlib": zlib.decompressobj,
    "bzip2": bz2.BZ2Decompressor,
    "xz": lambda: lzma.LZMADecompressor(memlimit=LZMA_MEMORY),
}


def unpack(coding: str, data: bytes | memoryview, most: int) -> bytes:
    """Unpack at most ``most`` bytes of ``gzip``, ``zlib``, ``bzip2``, ``xz`` or one block of ``lz4``."""
    if coding == "lz4":
        import lz4.block

        return bytes(lz4.block.decompress(data, uncompressed_size=most))
    return bytes(_ENGINES[coding]().decompress(data, most))


def read_head(path: Path, size: int) -> tuple[bytes, str]:
    """Return the first bytes of a file, decompressed, and ``raw``, ``gzip`` or ``bzip2``, or raise DataError."""
    with open(path, "rb") as file:
        head = file.read(size)
        encoding = "gzip" if head[:2] == b"\x1f\x8b" else "bzip2" if head[:3] == b"BZh" else "raw"
        if encoding == "raw":
            return head, encoding
        file.seek(0)
        try:
            return _OPENERS[encoding](file).read(size), encoding
        except (OSError, EOFError, zlib.error) as error:
            raise _damaged(path, encoding, error) from error


def load_block(
    path: Path, dtype: np.dtype, shape: tuple[int, ...], *,
    offset: int = 0, encoding: str = "raw", skip: int = 0, packed: bool = False, alone: bool = False,
) -> np.ndarray:  # fmt: skip
    """Load the block of ``shape`` and ``dtype`` at byte ``offset`` of a file.

    ``dtype`` is with its byte order, ``shape`` slowest first. -1 as ``offset`` means that the block ends the file (raw
    only); ``skip`` counts decompressed bytes. ``encoding`` is ``raw`` (memory-mapped, read-only), ``gzip``, ``zlib``,
    ``bzip2`` or ``text``. ``packed``: slices are read front to back, so that a large compressed block of three axes may
    stay in its file. ``alone``: a message says of bytes behind a raw block, and a packed one with more is refused.

    Returns:
        `np.memmap` for ``raw``, else an array in memory, or `Packed`.

    Raises:
        DataError: the file is too short, the block cannot come from so few bytes, or memory does not suffice; for
            `Packed` the end is seen when it is read.
    """
    need = count(shape) * dtype.itemsize
    size = path.stat().st_size
    if offset < 0:
        offset = size - need
    if encoding == "raw":
        offset += skip
        if need < 1 or offset < 0 or offset + need > size:
            raise _too_short(path, size, shape, dtype, max(offset, 0))
        if alone and (behind := size - offset - need):
            more = f"{path}: {size_text(behind)} behind the values that its header declares are not read"
            warnings.warn(f"{more}; check sizes, type and components", stacklevel=3)
        return np.memmap(path, dtype=dtype, mode="r", offset=offset, shape=shape)
    if encoding == "text":
        if count(shape) > size:
            raise _too_short(path, size, shape, dtype, offset)
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
            return parse_numbers(text, offset, count(shape), dtype, path.name).reshape(shape)
    if size - offset <= 0 or need + skip > (size - offset) * MAX_RATIO[encoding] + 4096:
        raise DataError(
            f"{path.name}: {size_text(max(size - offset, 0))} of {encoding} data cannot hold the "
            f"{size_text(need + skip)} that its header declares; check the header's sizes and type"
        )
    if packed and len(shape) == 3 and is_large(need):
        return cast(np.ndarray, Packed(path, dtype, shape, encoding, (offset, skip), alone))
    return _decompressed(path, dtype, shape, offset, encoding, skip, alone)


def _too_short(path: Path, size: int, shape: tuple[int, ...], dtype: np.dtype, offset: int) -> DataError:
    dims = " x ".join(str(n) for n in reversed(shape))
    need = count(shape) * dtype.itemsize + offset
    if need == offset:
        return DataError(f"{path.name}: {dims} values; expected at least one along each axis")
    return DataError(
        f"{path.name}: the file has {size_text(size)}; {dims} values of {dtype.name} after {offset} bytes need "
        f"{size_text(need)}; check that the file is whole and that its header's sizes and type are right"
    )


def _decompressed(
    path: Path, dtype: np.dtype, shape: tuple[int, ...], offset: int, encoding: str, skip: int, alone: bool
) -> np.ndarray:
    need = count(shape) * dtype.itemsize
    check_memory(need, path.name)
    with open(path, "rb") as file:
        file.seek(offset)
        try:
            stream = _OPENERS[encoding](file)
            _discard(stream, skip)
            out, filled = fill(stream, need)
            more = filled == need and stream.read(1)  # reaches the trailer, and with it the checksum
        except (OSError, EOFError, zlib.error) as error:
            raise _damaged(path, encoding, error) from error
    if alone and more:
        raise _longer(path, encoding, need + skip)
    if filled < need:
        raise DataError(
            f"{path.name}: its {encoding} data hold {size_text(filled + skip)}, its header declares "
            f"{size_text(need + skip)}; check the header's sizes and type"
        )
    return out.view(dtype).reshape(shape)


def _longer(path: Path, encoding: str, need: int) -> DataError:
    return DataError(f"{path.name}: its {encoding} data hold more than {size_text(need)}; check --dims and --dtype")


def _damaged(path: Path, encoding: str, error: Exception) -> DataError:
    return DataError(f"{path.name}: damaged {encoding} data ({error}); try to fetch the file again")


class Packed:
    """A compressed array (nz, ny, nx) that stays in its file: type, sizes, and slabs of slices read front to back.

    Slabs that follow each other are decompressed once; an earlier one begins again at the file's start.
    """

    ndim = 3

    def __init__(
        self, path: Path, dtype: np.dtype, shape: tuple[int, ...], encoding: str, start: tuple[int, int], alone: bool
    ):
        """Describe the block that `load_block` would read; ``start`` are its ``offset`` and ``skip``."""
        self._alone = alone
        self.path, self.dtype, self.shape, self.encoding, self.start = path, dtype, shape, encoding, start
        self.size = count(shape)
        self.nbytes = self.size * dtype.itemsize
        self._file: IO[bytes] | None = None
        self._stream: Any = None
        self._next = 0  # slice

    def __getitem__(self, key: slice) -> np.ndarray:
        """Read slices ``first:last``, (k, ny, nx); raise DataError if the file ends early, or is damaged."""
        first, last, _ = key.indices(self.shape[0])
        slice_bytes = count(self.shape[1:]) * self.dtype.itemsize
        need = (last - first) * slice_bytes
        try:
            if self._stream is None or first < self._next:
                self._open()
            _discard(self._stream, (first - self._next) * slice_bytes)
            out, filled = fill(self._stream, need)
            more = filled == need and last == self.shape[0] and self._stream.read(1)  # the trailer, with the checksum
        except (OSError, EOFError, zlib.error) as error:
            raise _damaged(self.path, self.encoding, error) from error
        if self._alone and more:
            raise _longer(self.path, self.encoding, self.nbytes + sum(self.start))
        if filled < need:
            raise DataError(
                f"{self.path.name}: its {self.encoding} data end in slice {first + filled // slice_bytes} of "
                f"{self.shape[0]}; check the header's sizes and type"
            )
        self._next = last
        return out.view(self.dtype).reshape(last - first, *self.shape[1:])

    def _open(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = open(self.path, "rb")  # noqa: SIM115 - as long as the volume lives
        self._file.seek(self.start[0])
        self._stream, self._next = _OPENERS[self.encoding](self._file), 0
        _discard(self._stream, self.start[1])


def _discard(stream: Any, n: int) -> None:
    """Read and drop ``n`` bytes of a stream (fewer if it ends)."""
    while n > 0:
        got = len(stream.read(min(n, _CHUNK)))
        if not got:
            return
        n -= got


def fill(stream: Any, need: int) -> tuple[np.ndarray, int]:
    """Read up to ``need`` bytes of a stream.

    Returns:
        (need,) uint8 and how many of them were read.
    """
    out = np.empty(need, np.uint8)
    view = out.data
    filled = 0
    while filled < need:
        chunk = stream.read(min(_CHUNK, need - filled))
        if not chunk:
            break
        view[filled : filled + len(chunk)] = chunk
        filled += len(chunk)
    return out, filled


def parse_numbers(text: bytes | mmap.mmap, start: int, n: int, dtype: np.dtype, name: str) -> np.ndarray:
    """Parse ``n`` numbers between white space from ``start`` on, (n,) native, window by window.

    Raise DataError if there are fewer, or others.
    """
    native = dtype.newbyteorder("=")
    check_memory(n * native.itemsize, name, AS_NUMBERS)
    values, filled, position = np.empty(n, native), 0, start
    while filled < n:
        window = text[position : position + _CHUNK]
        if not window:
            raise DataError(f"{name}: the text holds {filled} values, expected {n}; check that the file is whole")
        if position + len(window) < len(text):
            cut = max(window.rfind(c) for c in (b" ", b"\n", b"\t", b"\r"))
            window = window[: cut + 1] or window
        if isinstance(text, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
            text.madvise(mmap.MADV_DONTNEED)  # its pages are not read again
        position += len(window)
        words = window.split(None, n - filled)[: n - filled]
        try:
            values[filled : filled + len(words)] = np.array(words, dtype="S").astype(native)
        except (ValueError, OverflowError) as error:
            raise DataError(f"{name}: the text is not a list of {native.name} numbers ({error})") from error
        filled += len(words)
    return values


def any_case(path: Path) -> Path:
    """Return a file, or the one beside it whose name differs in upper and lower case alone; the path where none does.

    Among several, only one with the same stem is returned.
    """
    if path.is_file() or not path.parent.is_dir():
        return path
    alike = [p for p in path.parent.iterdir() if p.name.lower() == path.name.lower() and p.is_file()]
    alike = alike if len(alike) < 2 else [p for p in alike if p.name.partition(".")[0] == path.name.partition(".")[0]]
    return alike[0] if len(alike) == 1 else path


def data_file(header: Path, named: str, exact: bool = False) -> Path:
    """Find the data file that a detached header names; it must lie in the header's folder.

    A file whose name differs in upper and lower case alone is taken with a message, unless ``exact``.

    Raises:
        DataError: a path that leaves the folder, or a file that does not exist.
    """
    relative = Path(named)
    target = header.parent / relative
    homes = {header.parent.resolve(), header.resolve().parent}
    inside = not relative.is_absolute() and ".." not in relative.parts
    if not named or not inside or not any(target.resolve().is_relative_to(home) for home in homes):
        raise DataError(
            f"{header.name}: its data file is {named!r}; expected a file in the header's own folder (copy or move "
            "it there and name it without a path)"
        )
    file = any_case(target)
    if not file.is_file() or (exact and file != target):
        hint = "" if file == target else f" (rename {file.name})"
        raise DataError(f"{header.name}: its data file {named!r} does not exist beside it; expected {target}{hint}")
    if file != target:
        warnings.warn(f"{header.name}: its data file {named!r} does not exist, {file.name} is read", stacklevel=2)
    return file
