"""`BrickArray`: a (nz, ny, nx) array kept as those 8^3 bricks that vary, beside one value for every other brick.

It stands where a `Volume` has its array. Slabs of z are put together when they are asked for; whoever needs the whole
array gets it laid out once, in memory that takes no page where all is zero.
"""

from __future__ import annotations

import math
import mmap
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory

EDGE = 8  # voxels along a brick
MAX_VOXELS = 1 << 36  # 4096^3: the box alone, not what is in it, decides how long a walk through it takes


class BrickArray:
    """An array of bricks; attributes that are not listed below are those of the whole array, laid out for them.

    Attributes:
        shape: (nz, ny, nx).
        dtype: of the values.
    """

    ndim = 3

    def __init__(
        self, fill: np.ndarray, which: np.ndarray, bricks: np.ndarray, first: tuple[int, int, int], shape: Any
    ) -> None:
        """Take the parts as they are.

        Args:
            fill: (bz, by, bx) value of the bricks that do not vary.
            which: (bz, by, bx) int32 row of ``bricks``, -1 where there is none.
            bricks: (n, 8, 8, 8) values by x, y, z.
            first: voxels (z, y, x) of the first bricks that lie before the array.
            shape: of the array.
        """
        self.shape: tuple[int, int, int] = tuple(shape)
        self.dtype = fill.dtype
        self.size = math.prod(self.shape)
        self.nbytes = self.size * self.dtype.itemsize
        self._fill, self._which, self._bricks, self._first = fill, which, bricks, first
        self._layer: tuple[int, np.ndarray] | None = None
        self._whole: np.ndarray | None = None

    def __len__(self) -> int:
        """Return the number of slices."""
        return self.shape[0]

    def __getitem__(self, key: Any) -> np.ndarray:
        """Return a slice, a range of slices, or any other part of the array laid out."""
        if isinstance(key, int | np.integer):
            z = int(key) + (len(self) if key < 0 else 0)
            if not 0 <= z < len(self):
                raise IndexError(f"slice {key} of {len(self)}")
            result: np.ndarray = self._slices(z, z + 1)[0]
            return result
        if isinstance(key, slice) and key.step in (None, 1):
            start, stop, _ = key.indices(len(self))
            return self._slices(start, max(start, stop))
        picked: np.ndarray = self.whole()[key]
        return picked

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Return the array laid out."""
        return np.array(self.whole(), dtype, copy=copy) if copy else np.asarray(self.whole(), dtype)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the array laid out."""
        if name.startswith("_"):  # protocols that numpy and copy ask for
            raise AttributeError(name)
        return getattr(self.whole(), name)

    def whole(self) -> np.ndarray:
        """Return the array in memory, C-contiguous; pages are taken only where something differs from zero.

        Raises:
            DataError: more than the free memory.
        """
        if self._whole is None:
            check_memory(self.nbytes, f"{' x '.join(map(str, reversed(self.shape)))} voxels laid out")
            out = _blank(self.shape, self.dtype)
            for z in range(0, len(self), EDGE):
                slab = self._slices(z, min(z + EDGE, len(self)))
                target = out[z : z + EDGE]
                # bytes, not values: minus zero is something
                rows = slab.view(np.uint8).any(axis=2)
                target[rows] = slab[rows]
            out.flags.writeable = False
            self._whole, self._layer, self._bricks = out, None, self._bricks[:0]  # the parts are not needed any more
        return self._whole

    def _slices(self, start: int, stop: int) -> np.ndarray:
        """Return slices start to stop, (stop - start, ny, nx), C-contiguous."""
        if self._whole is not None:
            return self._whole[start:stop]
        out = np.empty((stop - start, *self.shape[1:]), self.dtype)
        z0, y0, x0 = self._first
        z = start
        while z < stop:
            at, inside = divmod(z + z0, EDGE)
            n = min(EDGE - inside, stop - z)
            layer = self._brick_layer(at)[inside : inside + n]
            out[z - start : z - start + n] = layer[:, y0 : y0 + self.shape[1], x0 : x0 + self.shape[2]]
            z += n
        return out

    def _brick_layer(self, at: int) -> np.ndarray:
        """Return the values (8, 8 by, 8 bx) of one layer of bricks, and keep it, as slabs are thinner than bricks."""
        if self._layer is None or self._layer[0] != at:
            by, bx = self._which.shape[1:]
            out = np.empty((EDGE, by, EDGE, bx, EDGE), self.dtype)
            out[:] = self._fill[at][None, :, None, :, None]
            j, i = np.nonzero(self._which[at] >= 0)
            # bricks are (n, x, y, z); indices apart put n first: (n, z, y, x)
            out[:, j, :, i, :] = self._bricks[self._which[at, j, i]].transpose(0, 3, 2, 1)
            self._layer = (at, out.reshape(EDGE, by * EDGE, bx * EDGE))
        return self._layer[1]


def brick_grid(lo: np.ndarray, hi: np.ndarray, itemsize: int, source: str) -> tuple[np.ndarray, np.ndarray]:
    """Return first brick and number of bricks, (3,) each, that hold the voxels ``lo`` to ``hi`` (3,), both included.

    Raises:
        DataError: a box that is too large to be walked through, or tables beyond the free memory.
    """
    size = [int(b) - int(a) + 1 for a, b in zip(lo, hi, strict=True)]
    if math.prod(size) > MAX_VOXELS:
        raise DataError(
            f"{source}: active voxels span {' x '.join(map(str, size))}; expected no more than 4096^3 in all; crop or "
            "resample the grid first"
        )
    first = np.asarray(lo, np.int64) // EDGE
    count = np.asarray(hi, np.int64) // EDGE - first + 1
    n = [int(c) for c in count]
    # the tables, and two layers of bricks laid out as slabs are put together
    check_memory(math.prod(n) * (itemsize + 4) + 2 * n[0] * n[1] * EDGE**3 * itemsize, source)
    return first, count


def _blank(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Make zeros in private anonymous memory of small pages: one row that is written must not take 2 MiB."""
    if not (hasattr(mmap, "MAP_PRIVATE") and hasattr(mmap, "MADV_NOHUGEPAGE")):
        return np.zeros(shape, dtype)
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | getattr(mmap, "MAP_NORESERVE", 0)
    memory = mmap.mmap(-1, max(math.prod(shape) * dtype.itemsize, 1), flags=flags)
    memory.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(memory, dtype, math.prod(shape)).reshape(shape)
