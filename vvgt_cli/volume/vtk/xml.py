"""VTK XML: what a file declares, and images (``.vti``) that lie in their file in one piece.

A plain (raw, appended) array is memory-mapped, a compressed one unpacked as far as a box needs it: behind the words
before the blocks (their number, bytes of one and of the last, 0 as the others, packed bytes of each), the packed blocks
follow each other, in base64 as one string (vtkXMLDataParser::ReadBlock). Others are read by VTK (`child`).
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast
from xml.parsers import expat

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import count, load_block, unpack
from vvgt_cli.volume.components import ArrayInfo, choose_array, magnitude, select_from_array, selected_dtype
from vvgt_cli.volume.readers import HEAD_BYTES, lazy, volume_name
from vvgt_cli.volume.reading import ReadOptions, Slices, type_of
from vvgt_cli.volume.stored import stored_or_loaded
from vvgt_cli.volume.types import IDENTITY, Volume
from vvgt_cli.volume.vtk import IMAGE, xml_kind
from vvgt_cli.volume.vtk.messages import quiet_vtk
from vvgt_cli.volume.vtk.resample import Grid

DATA = {"PointData": "point", "CellData": "cell", "PPointData": "point", "PCellData": "cell"}
GHOSTS = "vtkGhostType"  # array of marks: bit 1 of a point and bit 5 of a cell hide it (vtkDataSetAttributes)
HIDDEN = {"point": 2, "cell": 32}
TAIL = 4096  # bytes in which a file with appended data ends
IMAGE_BY_VTK: Callable[[Path, ReadOptions], Volume] = lazy("vtk.child.volume_by_child", IMAGE)
_CHUNK = 1 << 16


def walk_xml(
    path: Path, start: Callable[[str, dict[str, str], int], bool | None], end: Callable[[str], None],
    text: Callable[[str], None] | None = None,
) -> None:  # fmt: skip
    """Call ``start``, ``end`` and ``text`` for the elements of an XML file.

    ``start`` is told the byte at which an element begins; where it returns True, nothing is read from there on.

    Raises:
        DataError: damaged, or it declares entities.
    """
    parser, ended = expat.ParserCreate(), False

    def begin(tag: str, attributes: dict[str, str]) -> None:
        nonlocal ended
        ended = ended or bool(start(tag, attributes, parser.CurrentByteIndex))

    def entity(*_: object) -> None:
        raise DataError(f"{path}: its XML declares entities; expected none")

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = begin, end, text
    parser.EntityDeclHandler = entity
    with open(path, "rb") as file:
        try:
            while not ended and (chunk := file.read(_CHUNK)):
                parser.Parse(chunk)
            if not ended:
                parser.Parse(b"", True)
        except expat.ExpatError as error:
            if not ended:
                raise DataError(f"{path}: its XML is damaged ({error}); check that the file is whole") from error


@dataclass(frozen=True)
class DataArray:
    """An array of a file: what it is, the attributes of its element, and the byte at which that begins."""

    info: ArrayInfo
    attributes: dict[str, str]
    position: int


@dataclass
class Scan:
    """The contents of the XML; arrays are those of the first piece.

    In an index of pieces, ``sources`` are the files that it names, with their extents.
    """

    kind: str = ""
    root: dict[str, str] = field(default_factory=dict)
    image: dict[str, str] = field(default_factory=dict)
    pieces: int = 0
    where: str = ""
    active: dict[str, str] = field(default_factory=dict)
    arrays: list[DataArray] = field(default_factory=list)
    sources: list[tuple[str, str]] = field(default_factory=list)
    appended: str = ""
    data_start: int = -1

    @property
    def infos(self) -> list[ArrayInfo]:
        """The arrays that may be chosen: ghost marks are not values."""
        return [one.info for one in self.arrays if one.info.name != GHOSTS]

    def find(self, name: str, where: str) -> DataArray | None:
        """Return an array, None where there is none of the name."""
        return next((one for one in self.arrays if (one.info.name, one.info.where) == (name, where)), None)


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
            if "Source" in attributes:
                header.sources.append((attributes["Source"], attributes.get("Extent", "")))
        elif tag in DATA:
            header.where = DATA[tag]
            header.active[header.where] = attributes.get("Scalars", "")
        elif tag in ("DataArray", "PDataArray") and header.where and header.pieces == (tag == "DataArray"):
            _note_array(header, attributes, position, path)
        elif tag == "AppendedData":
            header.appended, header.data_start = attributes.get("encoding", ""), position
        return header.data_start >= 0

    def end(tag: str) -> None:
        if tag in DATA:
            header.where = ""

    walk_xml(path, start, end)
    if header.data_start >= 0:
        with open(path, "rb") as file:
            start_of_data = _text_of(path, header.data_start)
            file.seek(start_of_data)
            mark = file.read(1) == b"_"
            file.seek(max(path.stat().st_size - TAIL, 0))
            ends = b"</VTKFile" in file.read()
        if not ends:  # VTK's readers leave what is missing as it is in memory
            raise DataError(f"{path}: it does not end with </VTKFile>; the file was cut off, copy or write it again")
        if not mark:  # VTK's reader would begin elsewhere
            raise DataError(f"{path}: its appended data do not begin with _; check that the file is whole")
        header.data_start = start_of_data + 1
    return header


def _text_of(path: Path, position: int) -> int:
    """Return the byte of the first character, no blank, behind the tag at a position."""
    with open(path, "rb") as file:
        file.seek(position)
        tag = re.match(rb"[^>]*>\s*", file.read(4096))
    return position + (tag.end() if tag else 0)


def _note_array(header: Scan, attributes: dict[str, str], position: int, path: Path) -> None:
    dtype = type_of(attributes.get("type", ""), {"bit": "u1"})
    if dtype is None:
        return
    components = int(attributes.get("NumberOfComponents", "1"))
    if components < 1:
        raise DataError(f"{path}: array {attributes.get('Name')!r} has {components} components")
    name = attributes.get("Name", "")
    active = bool(name) and name == header.active.get(header.where)
    info = ArrayInfo(name, header.where, components, dtype.name, active)
    header.arrays.append(DataArray(info, attributes, position))


def _numbers(text: str, n: int, path: Path, what: str) -> list[float]:
    try:
        values = [float(t) for t in text.split()]
    except ValueError:
        values = []
    if len(values) != n:
        raise DataError(f"{path}: {what} is {text!r}; expected {n} numbers")
    return values


def extent_of(text: str, path: Path, what: str = "WholeExtent") -> np.ndarray:
    """Parse an extent, (3, 2) int64: first and last point along x, y and z; raise DataError for anything else."""
    ends = np.array(_numbers(text, 6, path, what))
    if not (np.abs(ends) < 1 << 31).all():
        raise DataError(f"{path}: {what} is {text!r}; expected 6 integers of 32 bits")
    return ends.astype(np.int64).reshape(3, 2)


def image_grid(image: dict[str, str], where: str, path: Path) -> Grid:
    """Return the grid of an image's points or cells, or raise DataError."""
    extent = extent_of(image.get("WholeExtent", ""), path)
    if (extent[:, 0] > extent[:, 1]).any():
        raise DataError(
            f"{path}: WholeExtent {extent.ravel().tolist()} is empty; expected at least one voxel along each axis"
        )
    spacing = _numbers(image.get("Spacing", "1 1 1"), 3, path, "Spacing")
    origin = _numbers(image.get("Origin", "0 0 0"), 3, path, "Origin")
    direction = _numbers(image["Direction"], 9, path, "Direction") if "Direction" in image else IDENTITY
    return Grid.of_image(extent, spacing, origin, direction, where)


def read_vti(path: Path, options: ReadOptions) -> Volume:
    """Read a VTK XML image: point data, or cell data on the grid of cell centres."""
    header = scan(path)
    if header.kind != "ImageData" or not header.image:
        raise DataError(
            f"{path}: a VTK file of type {header.kind or 'unknown'}; expected ImageData (.vti); resample it first "
            "(ParaView: Resample To Image)"
        )
    info = header.infos[choose_array(header.infos, options.array, str(path))]
    grid = image_grid(header.image, info.where, path)
    values = image_values(header, info, grid, options, path)
    return grid.volume(values, info, options, volume_name(path))


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


def image_values(header: Scan, info: ArrayInfo, grid: Grid, options: ReadOptions, path: Path) -> np.ndarray:
    """Read an image's array (nz, ny, nx), mapped where it is stored plainly; NaN where it is hidden.

    With ``options.stored``, compressed ones stay in the file. VTK reads what is text, in several pieces or partly
    hidden. Errors are those of `Reader.read`.
    """
    row = header.find(info.name, info.where)
    form, compressor = row.attributes.get("format") if row else "", header.root.get("compressor", "")
    ghosts = [ghost for where in HIDDEN if (ghost := header.find(GHOSTS, where)) is not None]
    hidden = any(ghost.attributes.get("RangeMax") not in ("0", "1") for ghost in ghosts)  # 1: only duplicates
    whole = header.pieces == 1 and not hidden
    if row is not None and whole and row.attributes["type"] != "Bit":
        appended = form == "appended" and header.data_start >= 0
        start = header.data_start + int(row.attributes.get("offset", "0"))
        if appended and start < header.data_start:
            raise DataError(f"{path}: array {info.name!r} begins before the appended data; is the file whole?")
        if appended and header.appended == "raw" and not compressor:
            stored = _mapped(header, info, grid, start, path)
            return select_from_array(stored, info, options.component, str(path))
        if compressor in _CODINGS and (form == "binary" or (appended and header.appended in ("raw", "base64"))):
            start = start if appended else _text_of(path, row.position)
            coded = not appended or header.appended == "base64"
            return packed_array(header, info, grid, start, coded, options, path)
    values = IMAGE_BY_VTK(path, replace(options, array=info.name or None, spacing=None)).data
    if values.shape != grid.dims[::-1]:
        raise DataError(f"{path}: points and cells have an array {info.name!r} each; rename one of them")
    return values


def _mapped(header: Scan, info: ArrayInfo, grid: Grid, start: int, path: Path) -> np.ndarray:
    """Map an array (nz, ny, nx, c) that is stored plainly from byte ``start`` on."""
    shape = (*reversed(grid.dims), info.components)
    word, dtype = _order(header, info)
    declared = int(load_block(path, word, (1,), offset=start)[0])
    if declared != count(shape) * dtype.itemsize:
        raise DataError(
            f"{path}: array {info.name!r} stores {declared} bytes, its header declares {count(shape) * dtype.itemsize}"
        )
    return load_block(path, dtype, shape, offset=start + word.itemsize)


def _order(header: Scan, info: ArrayInfo) -> tuple[np.dtype, np.dtype]:
    """Return the types of the words before an array's values and of the values, as stored."""
    order = ">" if header.root.get("byte_order") == "BigEndian" else "<"
    word = np.dtype(order + ("u8" if header.root.get("header_type") == "UInt64" else "u4"))
    return word, np.dtype(order + np.dtype(info.dtype).str[1:])


def block_table(path: Path, start: int, word: np.dtype, coded: bool) -> np.ndarray:
    """Read the words before the blocks of an array from byte ``start`` on, those that are there."""
    size = path.stat().st_size
    with open(path, "rb") as file:

        def words(n: int) -> np.ndarray:
            file.seek(start)
            data = file.read(4 * -(-n * word.itemsize // 3) if coded else n * word.itemsize)
            try:
                data = base64.b64decode(data, validate=True) if coded else data
            except (binascii.Error, ValueError):  # damaged
                data = b""
            return np.frombuffer(data[: min(len(data) // word.itemsize, n) * word.itemsize], word)

        head = words(3)
        return words(3 + int(head[0])) if len(head) == 3 and int(head[0]) <= size else head


def packed_array(
    header: Scan, info: ArrayInfo, grid: Grid, start: int, coded: bool, options: ReadOptions, path: Path
) -> np.ndarray:
    """Read a component (nz, ny, nx) of a compressed array, or leave it in its file.

    The first word before its blocks is at byte ``start``; ``coded``: all is in base64.

    Raises:
        DataError: no whole table of blocks, or one of other sizes; a damaged block.
        UsageError: several components and none chosen.
    """
    kind = selected_dtype(info, options.component, str(path))  # raises where a component must be chosen
    word, dtype = _order(header, info)
    shape = (*reversed(grid.dims), info.components)
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
    packed = _Blocks(path, _CODINGS[header.root["compressor"]], coded, place, begins, each, need)
    _, ny, nx, components = shape
    row = nx * components * dtype.itemsize

    def read(slices: Slices) -> np.ndarray:
        z, y, x = slices
        out = np.empty([k.stop - k.start for k in slices], kind)
        kept: dict[int, bytes] = {}
        for k in range(z.start, z.stop):
            first = (k * ny + y.start) * row
            data = packed.read(first, first + (y.stop - y.start) * row, kept)
            values = np.frombuffer(data, dtype).reshape(y.stop - y.start, nx, components)
            if options.component == "magnitude":
                out[k - z.start] = magnitude(np.moveaxis(values[None, :, x], -1, 0))[0]
            else:
                out[k - z.start] = values[:, x, int(options.component or 0)]
        return out

    rows = max(each // row, 1)
    chunks = (max(rows // ny, 1), min(rows, ny), nx)
    return cast(np.ndarray, stored_or_loaded(read, kind, shape[:3], chunks, str(path), options.stored))


_CODINGS = {"vtkZLibDataCompressor": "zlib", "vtkLZ4DataCompressor": "lz4", "vtkLZMADataCompressor": "xz"}


@dataclass(frozen=True)
class _Blocks:
    """The positions of an array's blocks.

    Attributes:
        path: the file.
        coding: of `blocks.unpack`.
        coded: in base64.
        place: byte of the file where they begin.
        begins: (n + 1) packed bytes before each, and in all.
        each: bytes of one, unpacked.
        size: of all.
    """

    path: Path
    coding: str
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
                need = min(self.each, self.size - k * self.each)
                kept[k] = unpack(self.coding, part, need + 1)
                if len(kept[k]) != need:
                    raise ValueError(f"a block of {len(kept[k])} bytes where {need} are expected")
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
