"""Parallel VTK images (``.pvti``): an index of pieces, each a ``.vti``, of which a box reads those that it meets.

Layout: https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html, "Parallel XML File Formats".
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import count, data_file, is_large
from vvgt_cli.volume.components import ArrayInfo, choose_array, selected_dtype
from vvgt_cli.volume.reading import ReadOptions, Volume, float_dtype, volume_name
from vvgt_cli.volume.stored import Slices, is_file_backed, put_block, read_block, stored_or_loaded
from vvgt_cli.volume.vtk.xml import GHOSTS, HIDDEN, Scan, extent_of, image_grid, image_values, scan

MAX_KEPT = 256 << 20  # bytes of unpacked pieces that a process keeps
OPEN = 64  # mapped pieces that a process keeps open
DEPTH = 64  # slices that are read at once where the volume is walked through
FEW = 4096  # pieces of which every pair is compared
LISTED = 1000  # pieces whose headers are read for the ranges of arrays
CLOSE = 1e-3  # spacings that a piece may lie off


def read_pvti(path: Path, options: ReadOptions) -> Volume:
    """Read a ``.pvti``: point data, or cell data on the grid of cell centres.

    With ``options.stored`` values stay in the pieces, which are mapped, or unpacked and kept for a while.
    """
    header = scan(path)
    if header.kind != "PImageData" or not header.image:
        raise DataError(f"{path}: a VTK file of type {header.kind or 'unknown'}; expected PImageData (.pvti)")
    if not header.sources:
        raise DataError(f"{path}: an index without pieces; expected the files of an image")
    info = header.infos[choose_array(header.infos, options.array, str(path))]
    pieces = _Pieces(header, info, options, path)
    grid = image_grid(pieces.image, info.where, path)
    shape, dtype = grid.dims[::-1], pieces.dtype
    kept = options.stored or (options.packed and is_large(count(shape) * dtype.itemsize))
    field = stored_or_loaded(pieces.read, dtype, shape, pieces.chunks, str(path), kept)
    return grid.volume(field, info, options, volume_name(path))


class _Pieces:
    """The pieces of one array.

    Attributes:
        image: attributes of the whole, its direction too.
        dtype: of the values.
        chunks: (z, y, x) voxels of the largest piece, `DEPTH` slices at most.
    """

    def __init__(self, document: Scan, info: ArrayInfo, options: ReadOptions, path: Path) -> None:
        self.path, self.info, self.options = path, info, replace(options, stored=False)  # a piece is held as a whole
        self.names = [name for name, _ in document.sources]
        whole = extent_of(document.image.get("WholeExtent", ""), path)
        boxes = np.array([extent_of(text, path, f"Extent of piece {name!r}") for name, text in document.sources])
        bad = (boxes[..., 0] > boxes[..., 1]) | (boxes[..., 0] < whole[:, 0]) | (boxes[..., 1] > whole[:, 1])
        if bad.any():
            name, text = document.sources[int(np.flatnonzero(bad.any(axis=1))[0])]
            raise DataError(f"{path}: piece {name!r} has Extent {text!r}; expected one within {whole.ravel().tolist()}")
        self._first = whole[:, 0]
        self._lo = boxes[..., 0] - self._first
        self._hi = boxes[..., 1] - self._first
        # a point on the face between two pieces is taken from one of them
        self._hi += (boxes[..., 1] == whole[:, 1]) if info.where == "point" else (whole[:, 0] == whole[:, 1])
        self._overlap: bool = _overlapping(self._lo, self._hi)
        self._kept: OrderedDict[int, tuple[Volume, np.ndarray]] = OrderedDict()
        self._lock = Lock()
        self.image = document.image
        opened = self._scan(0)
        if "Direction" not in document.image and "Direction" in opened.image:
            self.image = {**document.image, "Direction": opened.image["Direction"]}  # VTK's writer leaves it out
        self.dtype = self._dtype(document)
        if self.hiding and info.where == "point":  # one is hidden where all pieces that have it say so
            self._hi, self._overlap = boxes[..., 1] - self._first + 1, True
        z, y, x = (self._hi - self._lo).max(axis=0)[::-1].tolist()
        self.chunks = (min(z, DEPTH), y, x)

    def _scan(self, k: int) -> Scan:
        """Scan the file of piece ``k``, which lies in the folder of the index."""
        file = data_file(self.path, self.names[k])
        header = scan(file)
        if header.kind != "ImageData" or not header.image:
            raise DataError(f"{file}: a VTK file of type {header.kind or 'unknown'}; expected ImageData, a piece")
        return header

    def _dtype(self, document: Scan) -> np.dtype:
        """Return the type of the values: that of the index, or what NaN and magnitudes need."""
        dtype = selected_dtype(self.info, self.options.component, str(self.path))
        self.hiding = any(document.find(GHOSTS, where) for where in HIDDEN) and not all(
            map(self._shown, range(len(self.names)))
        )
        return float_dtype(dtype) if self.hiding else dtype

    def _shown(self, k: int) -> bool:
        """Tell whether the ghost marks of piece ``k`` hide nothing, by its header: they may only mark shared values."""
        rows = [row for where in HIDDEN if (row := self._scan(k).find(GHOSTS, where))]
        return all(row.attributes.get("RangeMax", "") in ("0", "1") for row in rows)

    def read(self, slices: Slices) -> np.ndarray:
        """Read the values of a box, (z, y, x)."""
        lo = np.array([s.start for s in slices[::-1]])
        hi = np.array([s.stop for s in slices[::-1]])
        out = np.full((hi - lo)[::-1], np.nan, self.dtype) if self.hiding else np.empty((hi - lo)[::-1], self.dtype)
        begin, end = np.maximum(self._lo, lo), np.minimum(self._hi, hi)
        met = np.flatnonzero((begin < end).all(axis=1))
        self._check_whole(begin[met] - lo, end[met] - lo, out.shape)
        for k in met.tolist():
            volume, first = self._piece(k)
            target = out[tuple(slice(a, b) for a, b in zip((begin[k] - lo)[::-1], (end[k] - lo)[::-1], strict=True))]
            if self.hiding:
                part = read_block(volume, begin[k] - first, end[k] - first)
                np.copyto(target, part, where=~np.isnan(part))
            else:
                put_block(volume.data, begin[k] - first, target)
        return out

    def _check_whole(self, begin: np.ndarray, end: np.ndarray, shape: tuple[int, ...]) -> None:
        """Refuse a box that pieces do not cover."""
        if not self._overlap and sum(map(math.prod, (end - begin).tolist())) == math.prod(shape):
            return
        missing = np.ones(shape, bool)
        for a, b in zip(begin[:, ::-1], end[:, ::-1], strict=True):
            missing[tuple(map(slice, a, b))] = False
        if missing.any():
            raise DataError(
                f"{self.path}: {int(missing.sum())} voxels of a box lie in none of its pieces; is it whole?"
            )

    def _piece(self, k: int) -> tuple[Volume, np.ndarray]:
        """Return piece ``k`` and its first voxel in the whole; the ones used last are kept."""
        with self._lock:
            if k in self._kept:
                self._kept.move_to_end(k)
                return self._kept[k]
            made = self._opened(k)
            self._kept[k] = made
            while len(self._kept) > 1 and (len(self._kept) > OPEN or self._bytes() > MAX_KEPT):
                self._kept.popitem(last=False)
            return made

    def _bytes(self) -> int:
        return sum(volume.data.nbytes for volume, _ in self._kept.values() if not is_file_backed(volume))

    def _opened(self, k: int) -> tuple[Volume, np.ndarray]:
        header, file = self._scan(k), self.path.parent / self.names[k]
        row = header.find(self.info.name, self.info.where)
        if row is None or (row.info.dtype, row.info.components) != (self.info.dtype, self.info.components):
            text = "none of that name" if row is None else str(row.info)
            raise DataError(f"{file}: {text}; expected {self.info} as {self.path.name} says")
        grid = image_grid(header.image, self.info.where, file)
        extent = extent_of(header.image["WholeExtent"], file)
        first = extent[:, 0] - self._first
        inside = (first <= self._lo[k]).all() and (first + grid.dims >= self._hi[k]).all()
        step = {key: self.image.get(key) for key in ("Origin", "Spacing", "Direction")}
        own = {**header.image, **{key: value for key, value in step.items() if value is not None}}
        place = image_grid(own, self.info.where, file)
        off = np.abs(np.subtract(grid.origin, place.origin)).max() > CLOSE * min(place.spacing)
        if not inside or off:
            raise DataError(
                f"{file}: an image of extent {extent.ravel().tolist()} from {header.image.get('Origin')}; expected the "
                f"place that {self.path.name} gives it"
            )
        values = image_values(header, row.info, grid, self.options, file)
        return Volume(values, grid.spacing, name=file.name), first


def _overlapping(lo: np.ndarray, hi: np.ndarray) -> bool:
    """Tell whether boxes (n, 3) from ``lo`` to ``hi`` overlap; more than `FEW` are not compared and count as if."""
    if len(lo) > FEW:
        return True
    return any(((lo[k + 1 :] < hi[k]) & (lo[k] < hi[k + 1 :])).all(axis=1).any() for k in range(len(lo)))


def contents_of(path: Path, options: ReadOptions) -> dict[str, Any]:
    """List pieces and arrays of a ``.pvti``, with the range that the pieces' headers state, or raise DataError."""
    index = scan(path)
    pieces = [scan(data_file(path, name)) for name, _ in index.sources[:LISTED]]
    rows = []
    for info in index.infos:
        stated = [match.attributes for piece in pieces if (match := piece.find(info.name, info.where))]
        row: dict[str, Any] = {
            "array": info.name,
            "data": info.where,
            "dtype": info.dtype,
            "components": info.components,
        }
        if len(stated) == len(index.sources) and all({"RangeMin", "RangeMax"} <= set(a) for a in stated):
            ends = [float(a[key]) for a in stated for key in ("RangeMin", "RangeMax")]
            row["range"] = [min(ends), max(ends)]
        rows.append({**row, "option": f"--array {info.name}"})
    blocks = [{"pieces": len(index.sources), "first": index.sources[0][0]}] if index.sources else []
    return {"arrays": rows, "blocks": blocks}
