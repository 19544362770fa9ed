"""NetCDF 3 and 4 (``.nc``), one variable on its CF axes. Read by netCDF4.

The header of a classic file is walked and compared with the file before the library sees it: the C library follows
counts and offsets of a damaged header out of its memory. Format: "NetCDF Classic Format Specification"
(https://docs.unidata.ucar.edu/netcdf-c/current/file_format_specifications.html), CDF-1, -2 and -5.
"""

from __future__ import annotations

import math
import mmap
import os
import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.arrays.beside import Neighbour, choose_grid, warn_of_curvilinear, with_neighbours
from vvgt_cli.volume.labelled import DESCRIBES, axis, described_by, flags_of, labelled_volume
from vvgt_cli.volume.reading import ReadOptions, Volume, load_block, need, volume_name

_TURN = RLock()  # the library is not for several threads; the garbage collector may close files during a turn
if hasattr(os, "register_at_fork"):  # not on Windows; a child must not find a turn taken for ever
    os.register_at_fork(before=_TURN.acquire, after_in_parent=_TURN.release, after_in_child=_TURN.release)


def read_netcdf(path: Path, options: ReadOptions) -> Volume:
    """Read one variable of a NetCDF file, on the axes that its coordinate variables describe.

    With ``options.stored`` its values stay in the file, and are read box by box.
    """
    library = need("netCDF4", "netcdf", str(path), "NetCDF")
    with open(path, "rb") as stream:
        if stream.read(3) == b"CDF":
            check_header(path)
    with _TURN, library.Dataset(str(path), "r") as file:
        file.set_auto_maskandscale(False)
        variable = _choose(file, options.array, path)
        attributes = {key: variable.getncattr(key) for key in variable.ncattrs()}
        kind = np.dtype(variable.dtype).str[1:]
        if "_FillValue" not in attributes and kind[1:] != "1" and kind in library.default_fillvals:
            attributes["_FillValue"] = library.default_fillvals[kind]  # what the library fills unwritten values with
        source = f"{path}:{variable.name}"
        axes = [axis(name, size) for name, size in zip(variable.dimensions, variable.shape, strict=True)]
        names, inside = str(attributes.get("coordinates", "")).split(), variable.group().variables
        along = set(variable.dimensions)
        attributes |= flags_of(getattr(variable.datatype, "enum_dict", None))
        beside = _beside(variable)
        _refuse_mesh(beside, source)
        axes = with_neighbours(axes, beside, source, options.spacing is not None)
        odd = [n for n in names if n in inside and len({*inside[n].dimensions} & along) > 1]
        warn_of_curvilinear(odd, axes, source)
        name = f"{volume_name(path)}:{variable.name}"
        where = f"{variable.group().path.rstrip('/')}/{variable.name}"
        by_box = options.stored and options.dims is None and options.component != "magnitude"
        read = _later(path, where) if by_box else lambda index: variable[index]
        chunks = variable.chunking() if by_box else None
        if by_box and not isinstance(chunks, list):  # of plain values: a slice
            chunks = [1] * (variable.ndim - 2) + list(variable.shape[-2:])
        return labelled_volume(read, np.dtype(variable.dtype), axes, attributes, options, source, name, chunks)


def _beside(variable: Any) -> dict[str, Neighbour]:
    """List the variables along one of a variable's dimensions, in its group and those above."""
    groups = [variable.group()]
    while groups[0].parent is not None:
        groups.insert(0, groups[0].parent)
    return {
        name: Neighbour.of(one.shape, lambda one=one: (one[:], one.__dict__), *one.dimensions)
        for group in groups
        for name, one in group.variables.items()
        if len(one.dimensions) == 1 and one.dimensions[0] in variable.dimensions
    }


def _refuse_mesh(beside: dict[str, Neighbour], source: str) -> None:
    """Raise DataError where x and y change along one axis together: cells of a mesh, stations or a path (CF, 9)."""
    along = {axis(name, 1, None, one.read()[1]).role: one.along for name, one in beside.items()}
    if "x" in along and along["x"] == along.get("y"):
        raise DataError(
            f"{source}: values of a mesh or at stations (x and y both lie along {along['x']}); expected a grid: "
            "remap them first (cdo remapbil)"
        )


def _later(path: Path, where: str) -> Callable[[tuple[Any, ...]], np.ndarray]:
    """Return what reads parts of a variable: it opens the file once in each process, until it is let go of."""
    import netCDF4

    @cache
    def opened(process: int) -> Any:
        file = netCDF4.Dataset(str(path), "r")
        file.set_auto_maskandscale(False)
        weakref.finalize(read, close, file)
        return file

    def close(file: Any) -> None:
        with _TURN:
            file.close()

    def read(index: tuple[Any, ...]) -> np.ndarray:
        with _TURN:
            return np.asarray(opened(os.getpid())[where][index])

    return read


def _choose(file: Any, wanted: str | None, path: Path) -> Any:
    """Return the variable asked for, else the only one of three axes or more (of two, if there is none)."""
    variables: dict[str, Any] = {}
    groups = [("", file)]
    while groups:
        prefix, group = groups.pop(0)
        variables |= {prefix + name: variable for name, variable in group.variables.items()}
        groups += [(f"{prefix}{name}/", inner) for name, inner in group.groups.items()]
    described = {
        name
        for variable in variables.values()
        for name in described_by({key: variable.getncattr(key) for key in DESCRIBES if key in variable.ncattrs()})
    }  # of other attributes, the library cannot read all
    fits = {
        name: variable
        for name, variable in variables.items()
        if isinstance(variable.dtype, np.dtype) and variable.dtype.kind in "iuf"
        and name.rpartition("/")[2] not in described
    }  # fmt: skip
    wanted = wanted and wanted.strip("/")
    if wanted in variables:
        fits = {wanted: variables[wanted]}
    rows = {name: f"{name} ({', '.join(v.dimensions)}: {' x '.join(map(str, v.shape))})" for name, v in fits.items()}
    grids = {name: (v.shape, np.dtype(v.dtype).name) for name, v in fits.items()}
    return fits[choose_grid(grids, wanted, str(path), "variable", rows=rows)]


_DIMENSION, _VARIABLE, _ATTRIBUTE = 10, 11, 12
_TYPES = {1: "i1", 2: "S1", 3: ">i2", 4: ">i4", 5: ">f4", 6: ">f8", 7: "u1", 8: ">u2", 9: ">u4", 10: ">i8", 11: ">u8"}


@dataclass(frozen=True)
class Variable:
    """A variable of a classic file.

    Attributes:
        dims: names of its dimensions, slowest first.
        shape: values along them; along one without an end, the number of records.
        dtype: of the values, as stored.
        begin: byte of the first.
        endless: whether the first dimension has no end: its records lie `step` bytes apart.
        attributes: numbers as arrays, text.
        step: bytes of a record of all variables.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype
    begin: int
    endless: bool
    attributes: dict[str, Any]
    step: int = 0

    def mapped(self, path: Path) -> np.ndarray:
        """Map the values."""
        if not self.endless:
            return load_block(path, self.dtype, self.shape, offset=self.begin)
        inner = np.empty(self.shape[1:], np.uint8).strides  # of bytes: a record is in one piece
        strides = (self.step, *(n * self.dtype.itemsize for n in inner))
        whole = load_block(path, np.dtype(np.uint8), (path.stat().st_size,))
        return np.ndarray(self.shape, self.dtype, whole, self.begin, strides)


class _Header:
    """A position in the header; everything read is checked to lie in the file."""

    def __init__(self, data: mmap.mmap, path: Path) -> None:
        self.data, self.path, self.at = data, path, 4
        self.wide = 8 if data[3] == 5 else 4  # bytes of a count
        self.offset = 4 if data[3] == 1 else 8  # bytes of a position

    def bad(self, what: str) -> DataError:
        return DataError(f"{self.path}: its NetCDF header {what} (near byte {self.at}); check that the file is whole")

    def number(self, width: int) -> int:
        if self.at + width > len(self.data):
            raise self.bad("is cut short")
        value = int.from_bytes(self.data[self.at : self.at + width], "big", signed=True)
        self.at += width
        return value

    def count(self) -> int:
        """Read the number of things that each take a byte of the file or more."""
        value = self.number(self.wide)
        if not 0 <= value <= len(self.data) - self.at:
            raise self.bad(f"declares {value} things")
        return value

    def skip(self, n: int) -> None:
        """Skip ``n`` bytes and their padding to four."""
        self.at += (n + 3) // 4 * 4
        if self.at > len(self.data):
            raise self.bad("is cut short")

    def name(self) -> bytes:
        n = self.count()
        text = self.data[self.at : self.at + n]
        self.skip(n)
        if not n or b"\0" in text:
            raise self.bad("has a thing without a name")
        return text

    def items(self, tag: int) -> int:
        """Read how many things a list of ``tag`` has."""
        there, n = self.number(4), self.count()
        if there != tag and (there, n) != (0, 0):
            raise self.bad(f"has the tag {there} where {tag} was expected")
        return n

    def kind(self) -> np.dtype:
        """Read the type of values."""
        code = self.number(4)
        if code not in _TYPES:
            raise self.bad(f"has values of type {code}")
        return np.dtype(_TYPES[code])

    def attributes(self) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for _ in range(self.items(_ATTRIBUTE)):
            name, kind, n, begin = self.name(), self.kind(), self.count(), self.at
            self.skip(kind.itemsize * n)
            data = self.data[begin : begin + kind.itemsize * n]
            text = kind.kind == "S"
            values[_plain(name)] = _plain(data) if text else np.frombuffer(data, kind)
        return values


def _plain(data: bytes) -> str:
    return data.decode("utf-8", "replace").rstrip("\0")


def check_header(path: Path) -> dict[str, Variable]:
    """Return a classic file's variables by name; raise DataError unless header and declared values lie in the file."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        header = _Header(data, path)
        records = header.number(header.wide)
        sizes: list[tuple[str, int]] = []
        for _ in range(header.items(_DIMENSION)):
            name = _plain(header.name())
            sizes.append((name, header.number(header.wide)))
        lengths = [n for _, n in sizes]
        if any(n < 0 for n in lengths) or lengths.count(0) > 1:
            raise header.bad(f"has dimensions of sizes {lengths[:9]}")
        header.attributes()
        variables = {}
        for _ in range(header.items(_VARIABLE)):
            name = _plain(header.name())
            variables[name] = _variable(header, sizes, records)
    rows = [v.dtype.itemsize * math.prod(v.shape[1:]) for v in variables.values() if v.endless]
    padded = sum(-(-n // 4) * 4 for n in rows)  # each to four bytes, where there are several
    step = padded if len(rows) > 1 else sum(rows)
    return {name: replace(v, step=step) if v.endless else v for name, v in variables.items()}


def _variable(header: _Header, sizes: list[tuple[str, int]], records: int) -> Variable:
    along = [header.number(header.wide) for _ in range(header.count())]
    if any(not 0 <= k < len(sizes) for k in along) or 0 in [sizes[k][1] for k in along[1:]]:
        raise header.bad(f"has a variable along dimensions {along[:9]} of {len(sizes)}")
    attributes = header.attributes()
    kind = header.kind()
    header.number(header.wide)  # vsize, which may be wrong and is redundant
    begin = header.number(header.offset)
    need = kind.itemsize * math.prod(sizes[k][1] for k in along if sizes[k][1])
    endless = bool(along) and sizes[along[0]][1] == 0
    if not 0 <= begin <= len(header.data) or (begin + need > len(header.data) and not (endless and records == 0)):
        raise header.bad(f"places {need} bytes of values at {begin} of {len(header.data)}")
    if endless and records > 0 and need * records > len(header.data):
        raise header.bad(f"declares {records} records of {need} bytes")
    shape = tuple(sizes[k][1] or max(records, 0) for k in along)
    return Variable(tuple(sizes[k][0] for k in along), shape, kind, begin, endless, attributes)
