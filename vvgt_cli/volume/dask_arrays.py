"""Dask arrays: a chunk is computed when a block needs it, and the last ones are kept for the blocks beside it."""

from __future__ import annotations

import importlib
import itertools
import math
from collections import OrderedDict
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, VvgtError
from vvgt_cli.resources import free_memory
from vvgt_cli.volume.stored import Stored, put_overlap

AT_ONCE = 64 << 20  # bytes of chunks that are computed at once, and are kept at the least; one chunk in any case
KEPT = 0.125  # of the free memory: computed chunks that are kept, as blocks need the voxels around them too

Number = tuple[int, ...]


def is_dask(data: Any) -> bool:
    """Tell whether an object is a Dask array; Dask is imported by then."""
    return hasattr(data, "__dask_graph__") and hasattr(data, "chunks") and hasattr(data, "blocks")


def lazy(data: Any, name: str) -> Stored:
    """Wrap a Dask array (nz, ny, nx), computed when read; raise DataError for other axes, or unknown chunk sizes."""
    read = Chunks(data, name)
    if data.ndim != 3:
        raise DataError(f"{name}: array of shape {data.shape}; expected three axes (z, y, x), none empty")
    return Stored(read, data.dtype, data.shape, read.largest, name)


class Chunks:
    """Reads boxes of a Dask array, chunk by chunk: with the scheduler that Dask is set to.

    Attributes:
        largest: values along each axis of its largest chunk.
    """

    def __init__(self, array: Any, name: str) -> None:
        """Take a Dask array; ``name`` is for messages. Raise DataError for chunks of unknown size."""
        if any(math.isnan(n) for n in array.shape):
            raise DataError(
                f"{name}: a Dask array of unknown shape {array.shape}; call its compute_chunk_sizes() first"
            )
        self._array, self._name = array, name
        self._ends = [np.cumsum([0, *sizes]).tolist() for sizes in array.chunks]
        self.largest = tuple(max(sizes, default=1) for sizes in array.chunks)
        self._kept: OrderedDict[Number, np.ndarray] = OrderedDict()
        self._room = max(int(KEPT * (free_memory() or 0)), AT_ONCE)

    def __call__(self, index: tuple[Any, ...]) -> np.ndarray:
        """Read the values at a slice (step 1) or a number for each axis; the array belongs to the caller.

        Raises:
            DataError: a chunk that cannot be computed, or that is not what the array says of it.
        """
        given = zip(index, self._array.shape, strict=True)
        spans = [i.indices(n)[:2] if isinstance(i, slice) else (int(i), int(i) + 1) for i, n in given]
        out = np.empty([b - a for a, b in spans], self._array.dtype)
        touched = [
            [k for k in range(len(ends) - 1) if ends[k] < b and ends[k + 1] > a]
            for ends, (a, b) in zip(self._ends, spans, strict=True)
        ]
        missing = []

        def put(number: Number, chunk: np.ndarray) -> None:
            at = [ends[k] for ends, k in zip(self._ends, number, strict=True)]
            put_overlap(out, [a for a, _ in spans], chunk, at)

        for number in itertools.product(*touched):
            if number in self._kept:
                self._kept.move_to_end(number)
                put(number, self._kept[number])
            else:
                missing.append(number)
        one = math.prod(self.largest) * self._array.dtype.itemsize
        at_once = max(AT_ONCE // max(one, 1), 1)
        for k in range(0, len(missing), at_once):
            for number, chunk in self._computed(missing[k : k + at_once]):
                put(number, chunk)
                self._kept[number] = chunk  # and those used longest ago are let go of
                while len(self._kept) > 1 and sum(kept.nbytes for kept in self._kept.values()) > self._room:
                    self._kept.popitem(last=False)
        return out[tuple(slice(None) if isinstance(i, slice) else 0 for i in index)]

    def _computed(self, numbers: list[Number]) -> list[tuple[Number, np.ndarray]]:
        """Compute chunks; return each with its number."""
        dask: Any = importlib.import_module("dask")
        try:  # delayed: a chunk as it is, where an array's compute() copies it
            computed = dask.compute(*[self._array.blocks[number].to_delayed().item() for number in numbers])
        except VvgtError:
            raise
        except Exception as error:  # whatever the functions in the graph raise
            text = " ".join(f"{type(error).__name__}: {error}".split())
            raise DataError(f"{self._name}: chunk {numbers[0]} or one after it cannot be computed ({text})") from error
        chunks = []
        for number, values in zip(numbers, computed, strict=True):
            chunk = np.asarray(values)
            shape = tuple(ends[k + 1] - ends[k] for ends, k in zip(self._ends, number, strict=True))
            if chunk.shape != shape or chunk.dtype != self._array.dtype:
                raise DataError(
                    f"{self._name}: chunk {number} is of shape {chunk.shape}, {chunk.dtype}; the Dask array says "
                    f"{shape}, {self._array.dtype}: give map_blocks the dtype and chunks of what it returns"
                )
            chunks.append((number, chunk))
        return chunks
