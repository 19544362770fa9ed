"""`Stored`: a (nz, ny, nx) array that stays in its file (Zarr, HDF5), or lazy (Dask), and is read block by block.

It stands where a `Volume` has its array, and gives parts of it to whoever asks for them by three slices.
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
from vvgt_cli.volume.packed import Packed
from vvgt_cli.volume.types import Volume

Slices = tuple[slice, ...]
POINTS_BOX = 64  # voxels along the edge of what is read for the values of some
MAPPED = 32 << 20  # bytes of a mapped file that are held at once


class Stored:
    """See the module.

    Attributes:
        shape: (nz, ny, nx).
        dtype: of the values.
        chunks: (z, y, x) voxels of what the file packs together.
    """

    ndim = 3

    def __init__(
        self,
        read: Callable[[Slices], np.ndarray],
        dtype: np.dtype,
        shape: tuple[int, ...],
        chunks: Sequence[int],
        source: str,
    ) -> None:
        """Take what reads the block of three slices with start, stop and step 1, (z, y, x); ``source`` is its name."""
        self._read, self.dtype, self.shape, self.source = read, np.dtype(dtype), tuple(map(int, shape)), source
        self.chunks = tuple(max(min(int(c), n), 1) for c, n in zip(chunks, self.shape, strict=True))
        self.size = math.prod(self.shape)
        self.nbytes = self.size * self.dtype.itemsize

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> np.ndarray:
        """The block of one to three slices.

        Raises:
            DataError: a chunk that cannot be read, with its index.
        """
        keys = key if isinstance(key, tuple) else (key,)
        whole = [*keys, *[slice(None)] * (3 - len(keys))]
        slices = tuple(slice(*k.indices(n)) for k, n in zip(whole, self.shape, strict=True))
        try:
            return self._read(slices)
        except VvgtError:
            raise
        except Exception as error:  # whatever codecs raise
            raise self._damaged(slices, error) from error

    def part(self, index: Slices) -> Stored:
        """What three slices with step 1 leave of it, still in its file."""
        spans = [k.indices(n)[:2] for k, n in zip(index, self.shape, strict=True)]

        def read(slices: Slices) -> np.ndarray:
            return self[tuple(slice(a + k.start, a + k.stop) for (a, _), k in zip(spans, slices, strict=True))]

        return Stored(read, self.dtype, tuple(b - a for a, b in spans), self.chunks, self.source)

    def _damaged(self, slices: Slices, error: Exception) -> DataError:
        """The error of the first chunk in the block that cannot be read."""
        spans = [range(s.start // c, -(-s.stop // c)) for s, c in zip(slices, self.chunks, strict=True)]
        for index in itertools.product(*spans):
            part = tuple(
                slice(max(i * c, s.start), min((i + 1) * c, s.stop), 1)
                for i, c, s in zip(index, self.chunks, slices, strict=True)
            )
            try:
                self._read(part)
            except Exception as found:
                text = " ".join(str(found).split()) or type(found).__name__
                return DataError(
                    f"{self.source}: chunk {index} (z, y, x) is damaged ({text}); fetch it again, or remove it for the "
                    "format's fill value"
                )
        return DataError(f"{self.source}: cannot be read ({error}); try again")


def readable_in_blocks(volume: Volume) -> bool:
    """Whether parts of a volume's array can be had without the rest: mapped, `Stored`, bricks, or in memory."""
    return not isinstance(volume.data, Packed)


def held(volume: Volume) -> Volume:
    """The volume with its values in memory.

    Raises:
        DataError: they do not fit.
    """
    if not isinstance(volume.data, Stored):
        return volume
    check_memory(volume.data.nbytes, volume.name, IN_BLOCKS)
    nx, ny, nz = volume.dims
    return replace(volume, data=read_block(volume, np.zeros(3, np.int64), np.array([nx, ny, nz])))


def chunks_of(volume: Volume) -> tuple[int, ...]:
    """Voxels (z, y, x) of what a volume's file packs together; of plain values a slice."""
    return volume.data.chunks if isinstance(volume.data, Stored) else (1, *volume.data.shape[1:])


def is_file_backed(volume: Volume) -> bool:
    """Whether a volume's values lie in a file, mapped or `Stored`."""
    return isinstance(volume.data, Stored) or _map_under(volume.data) is not None


def read_block(volume: Volume, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """The stored values of voxels ``lo`` to ``hi`` (3,) int, x first, the latter not in it: (z, y, x), native.

    The caller's own; pages of a mapped file that it came from are given back to the system.

    Raises:
        DataError: the file ends early, or a chunk is damaged.
    """
    (x0, y0, z0), (x1, y1, z1) = lo, hi
    data: Any = volume.data
    if isinstance(data, Stored):  # what it gives is nobody else's
        part = data[z0:z1, y0:y1, x0:x1]
        return np.require(part, part.dtype.newbyteorder("="), ["C", "A", "W"])
    out = np.empty((z1 - z0, y1 - y0, x1 - x0), data.dtype.newbyteorder("="))
    put_block(data, lo, out)
    return out


def put_block(data: Any, lo: np.ndarray, out: np.ndarray) -> None:
    """Write what a box of an array (not `Stored`) from ``lo`` (3,), x first, on holds into ``out`` (z, y, x).

    Pages of a mapped file that it came from are given back to the system.
    """
    (x0, y0, z0), (z1, y1, x1) = lo, np.asarray(lo)[::-1] + out.shape
    under = _map_under(data)
    if under is None or not hasattr(mmap, "MADV_DONTNEED"):
        out[...] = data[z0:z1][:, y0:y1, x0:x1]  # bricks are laid out slab by slab
        return
    slab = max(MAPPED // max(out[0].nbytes, 1), 1)
    for z in range(0, len(out), slab):
        out[z : z + slab] = data[z0 + z : min(z0 + z + slab, z1), y0:y1, x0:x1]
        under.madvise(mmap.MADV_DONTNEED)


def give_back(data: np.ndarray) -> None:
    """Give the pages of a mapped file that an array is of back to the system."""
    under = _map_under(data)
    if under is not None and hasattr(mmap, "MADV_DONTNEED"):
        under.madvise(mmap.MADV_DONTNEED)


def values_at(volume: Volume, index: np.ndarray) -> np.ndarray:
    """Data values (n,) float64 of voxels ``index`` (n, 3) int, (x, y, z), which lie in the volume."""
    found = np.empty(len(index))
    edge = np.array([max(c, POINTS_BOX) for c in chunks_of(volume)[::-1]]) if isinstance(volume.data, Stored) else None
    if edge is None:
        x, y, z = index.T
        stored: np.ndarray = volume.data[z, y, x]
        found[:] = stored
        return volume.slope * found + volume.intercept
    boxes, which = np.unique(index // edge, axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    for box, rows in zip(boxes, np.split(order, np.cumsum(np.bincount(which.ravel()))[:-1]), strict=True):
        lo = box * edge
        part = read_block(volume, lo, np.minimum(lo + edge, volume.dims))
        x, y, z = (index[rows] - lo).T
        found[rows] = part[z, y, x]
    return volume.slope * found + volume.intercept


def planes(volume: Volume) -> Iterator[np.ndarray]:
    """The stored values of each slice (ny, nx), one after the other."""
    nx, ny, nz = volume.dims
    depth = chunks_of(volume)[0]
    for z in range(0, nz, depth):
        yield from read_block(volume, np.array([0, 0, z]), np.array([nx, ny, min(z + depth, nz)]))


def _map_under(data: Any) -> mmap.mmap | None:
    """The map that an array is a view of, None where it is of none that is only read."""
    while data is not None and not isinstance(data, mmap.mmap):
        if isinstance(data, np.memmap) and data.mode != "r":
            return None
        data = getattr(data, "base", None) if isinstance(data, np.ndarray) else None
    return data
