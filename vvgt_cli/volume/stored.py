"""`Stored`: a (nz, ny, nx) array that stays in its file (Zarr, HDF5), or lazy (Dask), and is read block by block.

It takes the place of a `Volume`'s array: indexed by three slices, it reads that part.
"""

from __future__ import annotations

import itertools
import math
import mmap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, VvgtError
from vvgt_cli.volume.blocks import IN_BLOCKS, check_memory
from vvgt_cli.volume.types import Volume

Slices = tuple[slice, ...]
POINTS_BOX = 64  # voxels along the edge of what is read for the values of some
MAPPED = 32 << 20  # bytes of a mapped file that are held at once
PAGE = 2 << 20  # bytes that one access to a mapped file may hold: Linux maps the large pages of its cache as a whole


class Stored:
    """A (nz, ny, nx) array whose values stay in a file, or are computed when they are read.

    Attributes:
        shape: (nz, ny, nx).
        dtype: of the values.
        chunks: (z, y, x) voxels of what the file packs together.
        in_file: they stay in a file; else parts that are in memory are laid out when they are read.
    """

    ndim = 3

    def __init__(
        self,
        read: Callable[[Slices], np.ndarray],
        dtype: np.dtype,
        shape: tuple[int, ...],
        chunks: Sequence[int],
        source: str,
        in_file: bool = True,
    ) -> None:
        """Take a function that reads three slices (z, y, x) with start, stop and step 1; ``source`` is for messages."""
        self.in_file = in_file
        self._read, self.dtype, self.shape, self.source = read, np.dtype(dtype), tuple(map(int, shape)), source
        self.chunks = tuple(max(min(int(c), n), 1) for c, n in zip(chunks, self.shape, strict=True))
        self.size = math.prod(self.shape)
        self.nbytes = self.size * self.dtype.itemsize

    def __len__(self) -> int:
        """Return the number of slices."""
        return self.shape[0]

    def __getitem__(self, key: Any) -> np.ndarray:
        """Read the block of one to three slices; raise DataError with the index of a chunk that cannot be read."""
        keys = key if isinstance(key, tuple) else (key,)
        whole = [*keys, *[slice(None)] * (3 - len(keys))]
        slices = tuple(slice(*k.indices(n)) for k, n in zip(whole, self.shape, strict=True))
        try:
            return self._read(slices)
        except (VvgtError, MemoryError):
            raise
        except Exception as error:  # whatever codecs raise
            raise self._damaged(slices, error) from error

    def part(self, index: Slices) -> Stored:
        """Return the part that three slices with step 1 leave, still in its file."""
        spans = [k.indices(n)[:2] for k, n in zip(index, self.shape, strict=True)]

        def read(slices: Slices) -> np.ndarray:
            return self[tuple(slice(a + k.start, a + k.stop) for (a, _), k in zip(spans, slices, strict=True))]

        return Stored(read, self.dtype, tuple(b - a for a, b in spans), self.chunks, self.source, self.in_file)

    def _damaged(self, slices: Slices, error: Exception) -> DataError:
        """Make the error of the first chunk in the block that cannot be read."""
        spans = [range(s.start // c, -(-s.stop // c)) for s, c in zip(slices, self.chunks, strict=True)]
        for index in itertools.product(*spans):
            part = tuple(
                slice(max(i * c, s.start), min((i + 1) * c, s.stop), 1)
                for i, c, s in zip(index, self.chunks, slices, strict=True)
            )
            try:
                self._read(part)
            except Exception as cause:
                text = " ".join(str(cause).split()) or type(cause).__name__
                return DataError(
                    f"{self.source}: chunk {index} (z, y, x) is damaged ({text}); fetch it again, or remove it for the "
                    "format's fill value"
                )
        return DataError(f"{self.source}: cannot be read ({error}); try again")


def stored_or_loaded(
    read: Callable[[Slices], np.ndarray], dtype: np.dtype, shape: Sequence[int], chunks: Sequence[int], source: str,
    stored: bool,
) -> Any:  # fmt: skip
    """Return a `Stored`, or its values if ``stored`` is False; raise DataError if they do not fit in memory."""
    values = Stored(read, dtype, tuple(shape), chunks, source)
    if stored:
        return values
    check_memory(values.nbytes, source, IN_BLOCKS)
    return values[:]


def put_overlap(out: np.ndarray, first: Sequence[int], block: np.ndarray, at: Sequence[int]) -> None:
    """Copy into ``out`` the values of ``block`` that lie in it; both say where their first values lie in the whole."""
    begin = [max(a, b) for a, b in zip(first, at, strict=True)]
    end = [min(a + n, b + m) for a, n, b, m in zip(first, out.shape, at, block.shape, strict=True)]
    if all(a < b for a, b in zip(begin, end, strict=True)):
        there, here = (
            tuple(slice(a - o, b - o) for a, b, o in zip(begin, end, origin, strict=True)) for origin in (first, at)
        )
        out[there] = block[here]


def loaded(volume: Volume) -> Volume:
    """Load the values of a volume into memory; raise DataError if they do not fit."""
    if not isinstance(volume.data, Stored):
        return volume
    check_memory(volume.data.nbytes, volume.name, IN_BLOCKS)
    nx, ny, nz = volume.dims
    return replace(volume, data=read_block(volume, np.zeros(3, np.int64), np.array([nx, ny, nz])))


def chunks_of(volume: Volume) -> tuple[int, ...]:
    """Return the voxels (z, y, x) that a volume's file packs together; a slice of plain values."""
    return volume.data.chunks if isinstance(volume.data, Stored) else (1, *volume.data.shape[1:])


def is_file_backed(volume: Volume) -> bool:
    """Tell whether a volume's values lie in a file, mapped or `Stored`."""
    return volume.data.in_file if isinstance(volume.data, Stored) else _mapping_of(volume.data) is not None


def read_block(volume: Volume, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Read the stored values of voxels ``lo`` to ``hi`` (3,) int, x first, ``hi`` excluded: (z, y, x), native.

    The array belongs to the caller; pages of a mapped file that it came from are given back to the system.

    Raises:
        DataError: the file ends early, or a chunk is damaged.
    """
    (x0, y0, z0), (x1, y1, z1) = lo, hi
    data: Any = volume.data
    if isinstance(data, Stored):  # nobody else holds what it returns
        part = data[z0:z1, y0:y1, x0:x1]
        return np.require(part, part.dtype.newbyteorder("="), ["C", "A", "W"])
    out = np.empty((z1 - z0, y1 - y0, x1 - x0), data.dtype.newbyteorder("="))
    put_block(data, lo, out)
    return out


def put_block(data: Any, lo: np.ndarray, out: np.ndarray) -> None:
    """Copy the box of an array (not `Stored`) that begins at ``lo`` (3,), x first, into ``out`` (z, y, x).

    Pages of a mapped file that it came from are given back to the system.
    """
    (x0, y0, z0), (z1, y1, x1) = lo, np.asarray(lo)[::-1] + out.shape
    mapped = _mapping_of(data)
    if mapped is None or not hasattr(mmap, "MADV_DONTNEED"):
        out[...] = data[z0:z1][:, y0:y1, x0:x1]  # bricks are laid out slab by slab
        return
    box = data[z0:z1, y0:y1, x0:x1]
    far = [(n - 1) * abs(stride) for n, stride in zip(box.shape, box.strides, strict=True)]
    axis = int(np.argmax(far))  # along which slices lie one behind the other in the file
    slab = max(MAPPED // max(min(abs(box.strides[axis]), sum(far) - far[axis] + 2 * PAGE), 1), 1)
    source, target = np.moveaxis(box, axis, 0), np.moveaxis(out, axis, 0)
    for k in range(0, len(target), slab):
        target[k : k + slab] = source[k : k + slab]
        mapped.madvise(mmap.MADV_DONTNEED)


def give_back(data: np.ndarray) -> None:
    """Give the pages of an array's mapped file back to the system."""
    mapped = _mapping_of(data)
    if mapped is not None and hasattr(mmap, "MADV_DONTNEED"):
        mapped.madvise(mmap.MADV_DONTNEED)


def values_at(volume: Volume, index: np.ndarray) -> np.ndarray:
    """Read the data values (n,) float64 of voxels ``index`` (n, 3) int, (x, y, z), which lie in the volume."""
    values = np.empty(len(index))
    if not len(index):
        return values
    if not isinstance(volume.data, Stored):
        x, y, z = index.T
        values[:] = volume.data[z, y, x]
        return volume.slope * values + volume.intercept
    edge = np.array([max(c, POINTS_BOX) for c in chunks_of(volume)[::-1]])
    boxes, which = np.unique(index // edge, axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    for box, rows in zip(boxes, np.split(order, np.cumsum(np.bincount(which.ravel()))[:-1]), strict=True):
        lo = box * edge
        part = read_block(volume, lo, np.minimum(lo + edge, volume.dims))
        x, y, z = (index[rows] - lo).T
        values[rows] = part[z, y, x]
    return volume.slope * values + volume.intercept


def planes(volume: Volume) -> Iterator[np.ndarray]:
    """Yield the stored values of each slice (ny, nx)."""
    nx, ny, nz = volume.dims
    depth = chunks_of(volume)[0]
    for z in range(0, nz, depth):
        yield from read_block(volume, np.array([0, 0, z]), np.array([nx, ny, min(z + depth, nz)]))


def _mapping_of(data: Any) -> mmap.mmap | None:
    """Return the read-only map that an array is a view of, None where there is none."""
    while data is not None and not isinstance(data, mmap.mmap):
        if isinstance(data, np.memmap) and data.mode != "r":
            return None
        data = getattr(data, "base", None) if isinstance(data, np.ndarray) else None
    return data
