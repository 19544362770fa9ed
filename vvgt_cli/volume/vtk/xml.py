"""VTK XML images (``.vti``), read by VTK.

A plain (raw, appended) array is memory-mapped instead; a compressed one may be unpacked box by box (`packed`). The XML
is scanned first: sizes are checked against the file before VTK allocates. VTK's messages become one error.

Compressed arrays are unpacked as far as a box needs them: behind the words that `blocks` checks, the packed blocks
follow each other, in base64 as one string. Each is unpacked by itself (vtkXMLDataParser::ReadBlock).
"""

from __future__ import annotations

import base64
import lzma
import re
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory, count, load_block, size_text
from vvgt_cli.volume.components import ArrayInfo, choose_array, select_from_array, selected_dtype
from vvgt_cli.volume.readers import HEAD_BYTES, volume_name
from vvgt_cli.volume.reading import ReadOptions, Slices, Stored, printable, type_of, unit_rows
from vvgt_cli.volume.types import IDENTITY, Volume, float_dtype
from vvgt_cli.volume.vtk import xml_kind
from vvgt_cli.volume.vtk.blocks import block_table, check_blocks, walk_xml
from vvgt_cli.volume.vtk.messages import checked, quiet_vtk

# Most that a byte of the file can stand for: deflate 1032, LZ4 255, LZMA some 7000; "0 " for a double in text.
_RATIO = {"": 4, "vtkZLibDataCompressor": 1040, "vtkLZ4DataCompressor": 256, "vtkLZMADataCompressor": 10000}
DATA = {"PointData": "point", "CellData": "cell", "PPointData": "point", "PCellData": "cell"}
GHOSTS = "vtkGhostType"  # array of marks: bit 1 of a point and bit 5 of a cell hide it (vtkDataSetAttributes)
HIDDEN = {"point": 2, "cell": 32}
TAIL = 4096  # bytes in which a file with appended data ends


@dataclass
class Scan:
    """The contents of the XML; arrays are those of the first piece, points and cells of all.

    In an index of pieces, ``sources`` are the files that it names, with their extents.
    """

    kind: str = ""
    root: dict[str, str] = field(default_factory=dict)
    image: dict[str, str] = field(default_factory=dict)
    pieces: int = 0
    points: int = 0
    cells: int = 0
    where: str = ""
    active: dict[str, str] = field(default_factory=dict)
    arrays: list[tuple[ArrayInfo, dict[str, str]]] = field(default_factory=list)
    sources: list[tuple[str, str]] = field(default_factory=list)
    appended: str = ""
    data_start: int = -1

    @property
    def infos(self) -> list[ArrayInfo]:
        """The arrays that may be chosen: ghost marks are not values."""
        return [info for info, _ in self.arrays if info.name != GHOSTS]

    def find(self, name: str, where: str) -> tuple[ArrayInfo, dict[str, str]] | None:
        """Return an array and its attributes, None where there is none of the name."""
        return next((row for row in self.arrays if (row[0].name, row[0].where) == (name, where)), None)


def scan(path: Path) -> Scan:
    """Scan the elements of a VTK XML file, up to its appended data; raise DataError if it is damaged or no VTKFile."""
    header = Scan()

    def start(tag: str, attributes: dict[str, str], position: int) -> bool:
        if tag == "VTKFile":
            header.root, header.kind = attributes, attributes.get("type", "")
        elif tag.removeprefix("P") in ("ImageData", "RectilinearGrid", "StructuredGrid"):
            header.image = attributes
        elif tag == "Piece":
            header.pieces += 1
            header.points += int(attributes.get("NumberOfPoints", "0"))
            header.cells += int(attributes.get("NumberOfCells", "0"))
            if "Source" in attributes:
                header.sources.append((attributes["Source"], attributes.get("Extent", "")))
        elif tag in DATA:
            header.where = DATA[tag]
            header.active[header.where] = attributes.get("Scalars", "")
        elif tag in ("DataArray", "PDataArray") and header.where and header.pieces == (tag == "DataArray"):
            _note_array(header, attributes, path)
        elif tag == "AppendedData":
            header.appended, header.data_start = attributes.get("encoding", ""), position
        return header.data_start >= 0

    def end(tag: str) -> None:
        if tag in DATA:
            header.where = ""

    walk_xml(path, start, end)
    if header.data_start >= 0:
        with open(path, "rb") as file:
            file.seek(header.data_start)
            mark = re.match(rb"[^>]*>\s*_", file.read(4096))
            file.seek(max(path.stat().st_size - TAIL, 0))
            ends = b"</VTKFile" in file.read()
        if not ends:  # VTK's readers leave what is missing as it is in memory
            raise DataError(f"{path}: it does not end with </VTKFile>; the file was cut off, copy or write it again")
        if mark is None:  # VTK's reader would begin elsewhere
            raise DataError(f"{path}: its appended data do not begin with _; check that the file is whole")
        header.data_start += mark.end()
    return header


def _note_array(document: Scan, attributes: dict[str, str], path: Path) -> None:
    dtype = type_of(attributes.get("type", ""), {"bit": "u1"})
    if dtype is None:
        return
    components = int(attributes.get("NumberOfComponents", "1"))
    if components < 1:
        raise DataError(f"{path}: array {attributes.get('Name')!r} has {components} components")
    name = attributes.get("Name", "")
    active = bool(name) and name == document.active.get(document.where)
    document.arrays.append((ArrayInfo(name, document.where, components, dtype.name, active), attributes))


def _numbers(text: str, n: int, path: Path, what: str) -> list[float]:
    try:
        values = [float(t) for t in text.split()]
    except ValueError:
        values = []
    if len(values) != n:
        raise DataError(f"{path}: {what} is {text!r}; expected {n} numbers")
    return values


@dataclass(frozen=True)
class Grid:
    """Dims, origin and spacing (x, y, z) of the values, direction row-major."""

    dims: tuple[int, ...]
    origin: tuple[float, ...]
    spacing: tuple[float, ...]
    direction: tuple[float, ...]


def extent_of(text: str, path: Path, what: str = "WholeExtent") -> list[int]:
    """Parse the six numbers of an extent, or raise DataError."""
    return [int(e) for e in _numbers(text, 6, path, what)]


def extent_dims(image: dict[str, str], path: Path) -> list[int]:
    """Return the points along (x, y, z) of an image or structured grid; raise DataError if there are none."""
    extent = extent_of(image.get("WholeExtent", ""), path)
    dims = [extent[2 * k + 1] - extent[2 * k] + 1 for k in range(3)]
    if min(dims) < 1:
        raise DataError(f"{path}: WholeExtent {extent} is empty; expected at least one voxel along each axis")
    return dims


def stored_ratio(document: Scan, path: Path) -> int:
    """Return the most bytes of values that a byte can stand for; raise DataError for an unknown compressor."""
    compressor = document.root.get("compressor", "")
    if compressor not in _RATIO:
        raise DataError(f"{path}: compressor {compressor!r}; expected one of {', '.join(filter(None, _RATIO))}")
    return _RATIO[compressor]


def image_grid(image: dict[str, str], where: str, path: Path) -> Grid:
    """Return the grid of points, or of cell centres (half a voxel further, one fewer per axis), or raise DataError."""
    extent, dims = extent_of(image.get("WholeExtent", ""), path), extent_dims(image, path)
    spacing = _numbers(image.get("Spacing", "1 1 1"), 3, path, "Spacing")
    origin = _numbers(image.get("Origin", "0 0 0"), 3, path, "Origin")
    direction: tuple[float, ...] = IDENTITY
    if "Direction" in image:
        direction = tuple(_numbers(image["Direction"], 9, path, "Direction"))
    first = [float(extent[2 * k]) for k in range(3)]
    if where == "cell":
        first = [f + 0.5 if d > 1 else f for f, d in zip(first, dims, strict=True)]
        dims = [max(d - 1, 1) for d in dims]
    step = [f * s for f, s in zip(first, spacing, strict=True)]
    origin = [o + sum(direction[3 * row + k] * step[k] for k in range(3)) for row, o in enumerate(origin)]
    axes = [[direction[3 * row + k] * spacing[k] for row in range(3)] for k in range(3)]
    return Grid(tuple(dims), tuple(origin), *unit_rows(axes))


def read_vti(path: Path, options: ReadOptions) -> Volume:
    """Read a VTK XML image: point data, or cell data on the grid of cell centres."""
    header = scan(path)
    if header.kind != "ImageData" or not header.image:
        raise DataError(
            f"{path}: a VTK file of type {header.kind or 'unknown'}; expected ImageData (.vti); resample it first "
            "(ParaView: Resample To Image)"
        )
    infos = header.infos
    info = infos[choose_array(infos, options.array, str(path))]
    grid = image_grid(header.image, info.where, path)
    values = image_values(header, info, grid, options, path)
    place = options.spacing_or(grid.spacing), grid.origin, grid.direction
    return Volume(values, *place, volume_name(path), quantity=printable(info.name))


def time_value(path: Path) -> float | None:
    """Return the time that a VTK XML file of one dataset states (TimeValue), None of any other file."""
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
    from vtkmodules.vtkIOXML import vtkXMLGenericDataObjectReader

    with open(path, "rb") as file:
        if xml_kind(file.read(HEAD_BYTES)) is None:
            return None
    with quiet_vtk():
        reader = vtkXMLGenericDataObjectReader()
        reader.SetFileName(str(path))
        reader.UpdateInformation()
    times = list(reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS()) or [])
    return float(times[0]) if len(times) == 1 else None


def image_values(document: Scan, info: ArrayInfo, grid: Grid, options: ReadOptions, path: Path) -> np.ndarray:
    """Read an image's array (nz, ny, nx), mapped where it is stored plainly; NaN where it is hidden.

    With ``options.stored``, compressed ones stay in the file where they are appended and nothing is hidden. Errors are
    those of `Reader.read`.
    """
    packed: np.ndarray | None = _packed(document, info, grid, options, path) if options.stored else None
    if packed is not None:
        return packed
    component = select_from_array(_stored(document, info, grid, path), info, options.component, str(path))
    for where in ("point", "cell"):
        row = document.find(GHOSTS, where)
        if row is None or (where == "point" and info.where == "cell") or row[0].components != 1:
            continue
        marks = _stored(document, row[0], image_grid(document.image, where, path), path)[..., 0]
        hidden = marks.astype(np.uint8) & HIDDEN[where] != 0
        component = without(component, hidden if where == info.where else around(hidden, component.shape))
    return component


def _stored(document: Scan, info: ArrayInfo, grid: Grid, path: Path) -> np.ndarray:
    """Read the values (nz, ny, nx, c) of an array, mapped or by VTK."""
    row = document.find(info.name, info.where)
    shape = (*reversed(grid.dims), info.components)
    _check_declared(document, info, count(shape), path)
    check_memory(count(shape) * np.dtype(info.dtype).itemsize, str(path))
    values = None if row is None else _mapped(document, row[1], info, shape, path)
    return _by_vtk(path, info, shape) if values is None else values


def without(values: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Set ``values`` to NaN where ``hidden``; return them as they are where nothing is."""
    if not hidden.any():
        return values
    return np.where(hidden, np.nan, values).astype(float_dtype(values.dtype))


def around(cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Mask the points (nz, ny, nx) whose surrounding cells are all in ``cells``, a mask."""
    for axis, n in enumerate(shape):
        if n > cells.shape[axis]:
            ones = np.ones_like(np.take(cells, [0], axis))
            cells = np.concatenate([ones, cells], axis) & np.concatenate([cells, ones], axis)
    return cells


def _check_declared(document: Scan, info: ArrayInfo, n_values: int, path: Path) -> None:
    """Refuse sizes that the file cannot hold."""
    need = n_values * np.dtype(info.dtype).itemsize
    size = path.stat().st_size
    if need > size * stored_ratio(document, path):
        raise DataError(
            f"{path}: {size_text(size)} cannot hold the {size_text(need)} of array {info.name!r} that its header "
            "declares; check that the file is whole"
        )
    check_blocks(path, document.root, document.appended, document.data_start, stored_ratio(document, path))


def _mapped(
    document: Scan, attributes: dict[str, str], info: ArrayInfo, shape: tuple[int, ...], path: Path
) -> np.ndarray | None:
    """Map an array that is stored plainly, in one piece; None for others."""
    plain = document.appended == "raw" and not document.root.get("compressor") and document.data_start >= 0
    if not plain or document.pieces != 1 or attributes.get("format") != "appended" or attributes["type"] == "Bit":
        return None
    word, dtype = _order(document, info)
    start = document.data_start + int(attributes.get("offset", "0"))
    declared = int(load_block(path, word, (1,), offset=start)[0])
    if start < document.data_start or declared != count(shape) * dtype.itemsize:
        raise DataError(
            f"{path}: array {info.name!r} stores {declared} bytes, its header declares {count(shape) * dtype.itemsize}"
        )
    return load_block(path, dtype, shape, offset=start + word.itemsize)


def _order(document: Scan, info: ArrayInfo) -> tuple[np.dtype, np.dtype]:
    """Return the types of the words before an array's values and of the values, as stored."""
    order = ">" if document.root.get("byte_order") == "BigEndian" else "<"
    word = np.dtype(order + ("u8" if document.root.get("header_type") == "UInt64" else "u4"))
    return word, np.dtype(order + np.dtype(info.dtype).str[1:])


def _packed(document: Scan, info: ArrayInfo, grid: Grid, options: ReadOptions, path: Path) -> Any:
    """Wrap an array that is appended and compressed, in one piece, with no hidden value; None for others."""
    row = document.find(info.name, info.where)
    hidden = any(document.find(GHOSTS, where) for where in HIDDEN)
    plain = not document.root.get("compressor") or document.appended not in ("raw", "base64") or document.data_start < 0
    if row is None or plain or hidden or document.pieces != 1 or options.component == "magnitude":
        return None
    if row[1].get("format") != "appended" or row[1]["type"] == "Bit":
        return None
    shape = (*reversed(grid.dims), info.components)
    _check_declared(document, info, count(shape), path)
    start = document.data_start + int(row[1].get("offset", "0"))
    if start < document.data_start:
        raise DataError(f"{path}: array {info.name!r} begins before the appended data; check that the file is whole")
    component = None if options.component is None else int(options.component)
    word, dtype = _order(document, info)
    return packed_array(
        path, document.root["compressor"], word, document.appended == "base64", start, dtype, shape, component, info
    )  # fmt: skip


def _by_vtk(path: Path, info: ArrayInfo, shape: tuple[int, ...]) -> np.ndarray:
    """Read values (nz, ny, nx, c) by vtkXMLImageDataReader, without a copy."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    with quiet_vtk() as message:
        reader = vtkXMLImageDataReader()
        reader.SetFileName(str(path))
        reader.UpdateInformation()
        for where, selection in (
            ("point", reader.GetPointDataArraySelection()),
            ("cell", reader.GetCellDataArraySelection()),
        ):
            selection.DisableAllArrays()
            if where == info.where:
                selection.EnableArray(info.name)
        reader.Update()
        image = reader.GetOutput()
        data = image.GetPointData() if info.where == "point" else image.GetCellData()
        array = data.GetArray(info.name) if info.name else data.GetArray(0)
        checked(array, reader, message, path, f"array {info.name!r}")
    values = vtk_to_numpy(array)
    if values.size != count(shape):
        raise DataError(f"{path}: array {info.name!r} has {values.size} values; expected {count(shape)}")
    result: np.ndarray = values.reshape(shape)
    return result


LZMA_MEMORY = 1 << 28  # bytes of its dictionary


def packed_array(
    path: Path, compressor: str, word: np.dtype, coded: bool, start: int, dtype: np.dtype, shape: tuple[int, ...],
    component: int | None, info: ArrayInfo,
) -> Stored:  # fmt: skip
    """Wrap a component of an array that stays in its file.

    ``compressor`` is as VTKFile names it, ``word`` the type of the words before the blocks, ``coded`` whether they are
    in base64, ``start`` the byte of the first word, ``dtype`` that of the values as stored; ``shape`` is (nz, ny, nx,
    components).

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
    size = len(words) * word.itemsize
    place = start + (4 * -(-size // 3) if coded else size)
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
