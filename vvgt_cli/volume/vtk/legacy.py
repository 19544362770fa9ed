"""Legacy VTK images (``.vtk``, STRUCTURED_POINTS), text and binary; binary arrays are memory-mapped (big-endian).

Parsed here because VTK's reader allocates whatever an array's header declares. Format: "VTK File Formats"
(https://docs.vtk.org/en/latest/design_documents/VTKFileFormats.html), section "Simple Legacy Formats".
"""

from __future__ import annotations

import mmap
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import load_block, parse_numbers, tokens
from vvgt_cli.volume.components import ArrayInfo, choose_array, select_from_array
from vvgt_cli.volume.reading import ReadOptions, Volume, placed, printable, volume_name

# vtkIdType is stored as int; long is that of a 64-bit machine; colour is our name for COLOR_SCALARS in text, 0 to 1.
_TYPES = {
    "bit": "", "char": "i1", "signed_char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2",
    "int": "i4", "unsigned_int": "u4", "long": "i8", "unsigned_long": "u8", "vtktypeint64": "i8", "vtktypeuint64": "u8",
    "vtkidtype": "i4", "colour": "u1", "float": "f4", "double": "f8",
}  # fmt: skip
_FIXED = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6, "GLOBAL_IDS": 1, "PEDIGREE_IDS": 1, "EDGE_FLAGS": 1}


@dataclass(frozen=True)
class _Array:
    """An array and where its values are: ``start`` in the file, in the coding of ``type``."""

    info: ArrayInfo
    type: str
    tuples: int
    start: int


class Parser:
    """Walks the sections of a legacy file and notes the arrays; values are skipped, not read."""

    KINDS: tuple[str, ...] = ("STRUCTURED_POINTS", "IMAGE_DATA")

    def __init__(self, text: mmap.mmap, path: Path) -> None:
        """Begin at the start of ``text``."""
        self.text, self.path, self.position = text, path, 0
        self.arrays: list[_Array] = []
        self.geometry: dict[str, list[float]] = {}
        self.where, self.tuples = "", 0

    def line(self) -> str | None:
        """Read the next line; None at the end."""
        if self.position >= len(self.text):
            return None
        end = self.text.find(b"\n", self.position, self.position + 4096)
        if end < 0:
            end = min(len(self.text), self.position + 4096)
        raw = self.text[self.position : end]
        self.position = end + 1
        return raw.decode("utf-8", "replace").strip()

    def words(self) -> list[str] | None:
        """Read the words of the next line that is not blank."""
        while (line := self.line()) is not None:
            if line:
                return line.split()
        return None

    def bad(self, what: str) -> DataError:
        """Make the error for what was found here."""
        return DataError(f"{self.path}: {what} (near byte {self.position}); check that the file is whole")

    def parse(self) -> None:
        """Read the header and all sections."""
        if not (self.line() or "").lower().startswith("# vtk datafile version"):
            raise self.bad("does not begin with '# vtk DataFile Version'")
        self.line()
        coding = " ".join(self.words() or []).upper()
        if coding not in ("ASCII", "BINARY"):
            raise self.bad(f"coding is {coding[:40]!r}; expected ASCII or BINARY")
        self.binary = coding == "BINARY"
        first, *kind = self.words() or ["nothing"]
        if first.upper() != "DATASET" or "".join(kind[:1]).upper() not in self.KINDS:
            shown = "".join(kind[:1]).lower().replace("_", " ")[:40] if first.upper() == "DATASET" else ""
            raise DataError(
                f"{self.path}: a legacy VTK file of a {printable(shown) or 'field without a grid'}; expected "
                f"{' or '.join(self.KINDS)}; resample it first (ParaView: Resample To Image) and save it as .vti"
            )
        while (words := self.words()) is not None:
            self.section(words[0].upper(), words)

    def section(self, key: str, words: list[str]) -> None:
        """Read one line that is a keyword, with the values that belong to it."""
        if key in ("DIMENSIONS", "ORIGIN", "SPACING", "ASPECT_RATIO", "EXTENT", "DIRECTION"):
            self.geometry["SPACING" if key == "ASPECT_RATIO" else key] = [float(w) for w in words[1:]]
        elif key in ("POINT_DATA", "CELL_DATA"):
            self.where, self.tuples = key[:-5].lower(), int(words[1])
        elif key == "METADATA":
            while self.line():
                pass
        elif key == "FIELD":
            self.field(int(words[2]))
        elif key == "LOOKUP_TABLE" and len(words) >= 3:
            self.skip("unsigned_char" if self.binary else "float", int(words[2]) * 4)
        elif key == "SCALARS":
            self.scalars(words)
        elif key == "COLOR_SCALARS":
            self.array(words[1], "unsigned_char" if self.binary else "colour", int(words[2]), self.tuples, active=True)
        elif key == "TEXTURE_COORDINATES":
            self.array(words[1], words[3], int(words[2]), self.tuples, active=False)
        elif key in _FIXED:
            self.array(words[1], words[2], _FIXED[key], self.tuples, active=False)
        else:
            raise self.bad(f"unknown section {key[:40]!r}")

    def scalars(self, words: list[str]) -> None:
        """Note the array of a SCALARS section, whose lookup table may follow."""
        back = self.position
        table = self.words()
        if table is None or table[0].upper() != "LOOKUP_TABLE":
            self.position = back
        self.array(words[1], words[2], int(words[3]) if len(words) > 3 else 1, self.tuples, active=True)

    def field(self, n: int) -> None:
        """Note the ``n`` arrays of a FIELD section, each with a line of its own."""
        for _ in range(n):
            words = self.words()
            if words and words[0].upper() == "METADATA":
                while self.line():
                    pass
                words = self.words()
            if words is None or len(words) < 4:
                raise self.bad("a FIELD has fewer arrays than it declares")
            self.array(words[0], words[3], int(words[1]), int(words[2]), active=False)

    def array(self, name: str, kind: str, components: int, tuples: int, *, active: bool) -> None:
        """Note an array whose values begin here, and skip them."""
        kind = kind.lower()
        if components < 1 or tuples < 0:
            raise self.bad(f"array {name[:40]!r} of {tuples} x {components} values")
        start = self.position
        self.skip(kind, components * tuples)
        if self.where and kind in _TYPES:
            dtype = np.dtype(_TYPES[kind] or "u1").name
            info = ArrayInfo(unquote(name), self.where, components, dtype, active)
            self.arrays.append(_Array(info, kind, tuples, start))

    def skip(self, kind: str, n: int) -> None:
        """Move behind ``n`` values."""
        if kind in ("string", "utf8_string"):
            self.skip_strings(n)
            return
        if kind not in _TYPES:
            raise self.bad(f"values of unknown type {kind[:40]!r}")
        if n > 8 * len(self.text):
            raise self.bad(f"{n} values are declared, the file has {len(self.text)} bytes")
        if self.binary:
            need = (n + 7) // 8 if kind == "bit" else n * np.dtype(_TYPES[kind]).itemsize
            if self.position + need > len(self.text):
                raise self.bad(f"{need} bytes of values are declared, {len(self.text) - self.position} are left")
            self.position += need
        else:
            for _, position in tokens(self.text, self.position, n, str(self.path)):
                self.position = position

    def skip_strings(self, n: int) -> None:
        """Skip strings: lines in text; in binary each has a length in 1, 2, 4 or 8 bytes, as its first two bits say."""
        for _ in range(n):
            if not self.binary:
                self.line()
                continue
            if self.position >= len(self.text):
                raise self.bad("a string is missing")
            width = (8, 4, 2, 1)[self.text[self.position] >> 6]
            length = int.from_bytes(self.text[self.position : self.position + width], "big")
            self.position += width + (length & ((1 << (8 * width - 2)) - 1))


def _values(parser: Parser, array: _Array, shape: tuple[int, int, int]) -> np.ndarray:
    """Read the stored values (nz, ny, nx, c) of an array."""
    full = (*shape, array.info.components)
    n = array.tuples * array.info.components
    if not parser.binary:
        dtype = np.dtype(_TYPES[array.type] or "u1")
        if array.type == "colour":
            shares = parse_numbers(parser.text, array.start, n, np.dtype("f4"), parser.path.name)
            result: np.ndarray = np.round(np.clip(shares, 0, 1) * 255).astype(np.uint8).reshape(full)
            return result
        return parse_numbers(parser.text, array.start, n, dtype, parser.path.name).reshape(full)
    if array.type == "bit":
        packed = np.frombuffer(parser.text[array.start : array.start + (n + 7) // 8], np.uint8)
        return np.unpackbits(packed, count=n).reshape(full)
    return load_block(parser.path, np.dtype(_TYPES[array.type]).newbyteorder(">"), full, offset=array.start)


def _grid(parser: Parser, where: str) -> tuple[tuple[int, ...], list[float], list[float]]:
    """Return dims, spacing and origin (x, y, z) of point or cell centres."""
    geometry = parser.geometry
    dims = [int(d) for d in geometry.get("DIMENSIONS", [])]
    spacing, origin = geometry.get("SPACING", [1.0] * 3), list(geometry.get("ORIGIN", [0.0] * 3))
    extent = [int(e) for e in geometry.get("EXTENT", [])]
    if len(extent) == 6:
        dims = [extent[2 * k + 1] - extent[2 * k] + 1 for k in range(3)]
        origin = [o + extent[2 * k] * s for k, (o, s) in enumerate(zip(origin, spacing, strict=True))]
    if len(dims) != 3 or min(dims) < 1 or len(spacing) != 3 or len(origin) != 3:
        raise DataError(
            f"{parser.path}: DIMENSIONS {dims}, SPACING {spacing}, ORIGIN {origin}; expected three numbers each"
        )
    if where == "cell":
        origin = [o + s / 2 if d > 1 else o for o, s, d in zip(origin, spacing, dims, strict=True)]
        dims = [max(d - 1, 1) for d in dims]
    return tuple(dims), spacing, origin


def read_legacy(path: Path, options: ReadOptions) -> Volume:
    """Read a legacy VTK image: point data, or cell data on the grid of cell centres."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
        parser = Parser(text, path)
        parser.parse()
        array = parser.arrays[choose_array([a.info for a in parser.arrays], options.array, str(path))]
        dims, spacing, origin = _grid(parser, array.info.where)
        if dims[0] * dims[1] * dims[2] != array.tuples:
            raise DataError(
                f"{path}: array {array.info.name!r} has {array.tuples} {array.info.where} values; "
                f"{' x '.join(map(str, dims))} were expected"
            )
        values = _values(parser, array, (dims[2], dims[1], dims[0]))
    field = select_from_array(values, array.info, options.component, str(path))
    return placed(
        field, np.diag(spacing), origin, options, volume_name(path), quantity=printable(array.info.name)
    )  # fmt: skip
