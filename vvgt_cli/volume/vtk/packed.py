"""Compressed arrays of VTK XML images, unpacked as far as a box needs them.

Behind the words that `vtk_blocks` checks, the packed blocks follow each other, in base64 as one string. Each is
unpacked by itself (vtkXMLDataParser::ReadBlock).
"""

from __future__ import annotations

import base64
import lzma
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import count
from vvgt_cli.volume.components import ArrayInfo, selected_dtype
from vvgt_cli.volume.stored import Slices, Stored
from vvgt_cli.volume.vtk.blocks import block_table, table_bytes

LZMA_MEMORY = 1 << 28  # bytes of its dictionary


def packed_array(
    path: Path, compressor: str, word: np.dtype, coded: bool, start: int, dtype: np.dtype, shape: tuple[int, ...],
    component: int | None, info: ArrayInfo,
) -> Stored:  # fmt: skip
    """Wrap a component of an array that stays in its file.

    Args:
        path: the file.
        compressor: as VTKFile names it.
        word: type of the words before the blocks.
        coded: in base64.
        start: byte of the first word.
        dtype: of the values, as stored.
        shape: (nz, ny, nx, components).
        component: of them.
        info: the array.

    Raises:
        DataError: no whole table of blocks, or one of other sizes.
        UsageError: several components and none chosen.
    """
    selected_dtype(info, component, str(path))  # raises where a component must be chosen
    words = block_table(path, start, word, coded)
    sizes = np.array(words[3:], np.int64)
    need, blocks = count(shape) * dtype.itemsize, len(sizes)
    each, last = (int(words[1]), int(words[2])) if len(words) > 3 else (0, 0)
    if len(words) < 4 or int(words[0]) != blocks or each < 1 or (blocks - 1) * each + (last or each) != need:
        raise DataError(
            f"{path}: array {info.name!r} has no table of {need} bytes in blocks; check that the file is whole"
        )
    begins = np.concatenate([[0], np.cumsum(sizes)])
    place = start + table_bytes(len(words), word, coded)
    packed = _Blocks(path, compressor, coded, place, begins, each, need)
    _, ny, nx, components = shape
    row = nx * components * dtype.itemsize
    kind = dtype.newbyteorder("=")

    def read(slices: Slices) -> np.ndarray:
        z, y, x = slices
        out = np.empty([k.stop - k.start for k in slices], kind)
        kept: dict[int, bytes] = {}
        for k in range(z.start, z.stop):
            first = (k * ny + y.start) * row
            data = packed.read(first, first + (y.stop - y.start) * row, kept)
            values = np.frombuffer(data, dtype).reshape(y.stop - y.start, nx, components)
            out[k - z.start] = values[:, x, component or 0]
        return out

    rows = max(each // row, 1)
    return Stored(read, kind, shape[:3], (max(rows // ny, 1), min(rows, ny), nx), str(path))


@dataclass(frozen=True)
class _Blocks:
    """The positions of an array's blocks.

    Attributes:
        path: the file.
        compressor: as VTKFile names it.
        coded: in base64.
        place: byte of the file where they begin.
        begins: (n + 1) packed bytes before each, and in all.
        each: bytes of one, unpacked.
        size: of all.
    """

    path: Path
    compressor: str
    coded: bool
    place: int
    begins: np.ndarray
    each: int
    size: int

    def read(self, lo: int, hi: int, kept: dict[int, bytes]) -> bytes:
        """Read bytes ``lo`` to ``hi`` of the values; ``kept`` holds the block that was unpacked last."""
        first, last = lo // self.each, (hi - 1) // self.each
        begin = int(self.begins[first])
        packed = self._bytes(begin, int(self.begins[last + 1]))
        parts = []
        for k in range(first, last + 1):
            if k not in kept:
                part = packed[int(self.begins[k]) - begin : int(self.begins[k + 1]) - begin]
                kept.clear()
                kept[k] = self._unpacked(part, min(self.each, self.size - k * self.each))
            parts.append(kept[k])
        return b"".join(parts)[lo - first * self.each : hi - first * self.each]

    def _bytes(self, lo: int, hi: int) -> bytes:
        """Read packed bytes ``lo`` to ``hi``."""
        with open(self.path, "rb") as file:
            if not self.coded:
                file.seek(self.place + lo)
                return file.read(hi - lo)
            file.seek(self.place + lo // 3 * 4)
            data = base64.b64decode(file.read((-(-hi // 3) - lo // 3) * 4), validate=True)
            return data[lo % 3 : lo % 3 + hi - lo]

    def _unpacked(self, data: bytes, need: int) -> bytes:
        if self.compressor == "vtkLZ4DataCompressor":
            import lz4.block

            out: bytes = lz4.block.decompress(data, uncompressed_size=need)
        elif self.compressor == "vtkLZMADataCompressor":
            out = lzma.LZMADecompressor(memlimit=LZMA_MEMORY).decompress(data, need + 1)
        else:
            out = zlib.decompressobj().decompress(data, need + 1)
        if len(out) != need:
            raise ValueError(f"a block of {len(out)} bytes where {need} are expected")
        return out
