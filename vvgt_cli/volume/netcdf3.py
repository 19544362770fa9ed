"""The header of a classic NetCDF file walked and compared with the file, before the library sees it.

The C library follows counts and offsets of a damaged header out of its memory. Format: "NetCDF Classic Format
Specification" (https://docs.unidata.ucar.edu/netcdf-c/current/file_format_specifications.html), CDF-1, -2 and -5.
"""

from __future__ import annotations

import math
import mmap
from pathlib import Path

from vvgt_cli.errors import DataError

_DIMENSION, _VARIABLE, _ATTRIBUTE = 10, 11, 12
_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 4, 6: 8, 7: 1, 8: 2, 9: 4, 10: 8, 11: 8}  # by type


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
        """A number of things that each take a byte of the file or more."""
        value = self.number(self.wide)
        if not 0 <= value <= len(self.data) - self.at:
            raise self.bad(f"declares {value} things")
        return value

    def skip(self, n: int) -> None:
        """Move behind ``n`` bytes and their padding to four."""
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
        """How many things a list of ``tag`` has."""
        found, n = self.number(4), self.count()
        if found != tag and (found, n) != (0, 0):
            raise self.bad(f"has the tag {found} where {tag} was expected")
        return n

    def kind(self) -> int:
        """Bytes of a value of the type that follows."""
        found = self.number(4)
        if found not in _BYTES:
            raise self.bad(f"has values of type {found}")
        return _BYTES[found]

    def attributes(self) -> None:
        names = set()
        for _ in range(self.items(_ATTRIBUTE)):
            names.add(self.name())
            self.skip(self.kind() * self.count())


def check_header(path: Path) -> None:
    """See that a classic file's header and the values it declares lie in the file.

    Raises:
        DataError: they do not.
    """
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        header = _Header(data, path)
        records = header.number(header.wide)
        sizes = []
        for _ in range(header.items(_DIMENSION)):
            header.name()
            sizes.append(header.number(header.wide))
        if any(n < 0 for n in sizes) or sizes.count(0) > 1:
            raise header.bad(f"has dimensions of sizes {sizes[:9]}")
        header.attributes()
        for _ in range(header.items(_VARIABLE)):
            _variable(header, sizes, records)


def _variable(header: _Header, sizes: list[int], records: int) -> None:
    header.name()
    along = [header.number(header.wide) for _ in range(header.count())]
    if any(not 0 <= k < len(sizes) for k in along) or 0 in [sizes[k] for k in along[1:]]:
        raise header.bad(f"has a variable along dimensions {along[:9]} of {len(sizes)}")
    header.attributes()
    width = header.kind()
    header.number(header.wide)  # vsize, which may be wrong and is redundant
    begin = header.number(header.offset)
    need = width * math.prod(sizes[k] for k in along if sizes[k])
    unlimited = bool(along) and sizes[along[0]] == 0
    if not 0 <= begin <= len(header.data) or (begin + need > len(header.data) and not (unlimited and records == 0)):
        raise header.bad(f"places {need} bytes of values at {begin} of {len(header.data)}")
    if unlimited and records > 0 and need * records > len(header.data):
        raise header.bad(f"declares {records} records of {need} bytes")
