"""Compressed values that are too many for the memory, read front to back slab by slab (`vvgt info`)."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.resources import free_memory
from vvgt_cli.volume.blocks import check_packed, count, damaged, fill, load_block, open_packed, read_discard

SHARE = 0.25  # of the free memory: what takes less is unpacked at once


class Packed:
    """What `vvgt_cli.volume.stats` uses of an array (nz, ny, nx): its type, its sizes, and slabs of slices.

    Slabs that follow each other are unpacked once; an earlier one begins anew at the file's start.
    """

    ndim = 3

    def __init__(self, path: Path, dtype: np.dtype, shape: tuple[int, ...], encoding: str, start: tuple[int, int]):
        self.path, self.dtype, self.shape, self.encoding, self.start = path, dtype, shape, encoding, start
        self.size = count(shape)
        self.nbytes = self.size * dtype.itemsize
        self._file: IO[bytes] | None = None
        self._stream: Any = None
        self._next = 0  # slice

    def __getitem__(self, key: slice) -> np.ndarray:
        """Slices ``first:last``, (k, ny, nx).

        Raises:
            DataError: the file ends early, or is damaged.
        """
        first, last, _ = key.indices(self.shape[0])
        slice_bytes = count(self.shape[1:]) * self.dtype.itemsize
        need = (last - first) * slice_bytes
        try:
            if self._stream is None or first < self._next:
                self._open()
            read_discard(self._stream, (first - self._next) * slice_bytes)
            out, filled = fill(self._stream, need)
            if filled == need and last == self.shape[0]:
                self._stream.read(1)  # reaches the trailer, and with it the checksum
        except (OSError, EOFError, zlib.error) as error:
            raise damaged(self.path, self.encoding, error) from error
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
        self._stream, self._next = open_packed(self.encoding, self._file), 0
        read_discard(self._stream, self.start[1])


def packed(
    path: Path, dtype: np.dtype, shape: tuple[int, ...], encoding: str, *, offset: int = 0, skip: int = 0
) -> np.ndarray:
    """`load_block` of three axes, for readers that go front to back: where it is large it stays packed.

    Raises:
        DataError: as `load_block`; of what stays packed the end is seen when it is read.
    """
    free, need = free_memory(), count(shape) * dtype.itemsize
    if free is None or need <= SHARE * free:
        return load_block(path, dtype, shape, offset=offset, encoding=encoding, skip=skip)
    check_packed(path, need, offset, encoding, skip)
    found: Any = Packed(path, dtype, shape, encoding, (offset, skip))
    result: np.ndarray = found
    return result
