"""Legacy VTK images (``.vtk``, STRUCTURED_POINTS): binary arrays are memory-mapped (big-endian), others read by VTK.

Format: "VTK File Formats" (https://docs.vtk.org/en/latest/design_documents/VTKFileFormats.html), section "Simple Legacy
Formats".
"""

from __future__ import annotations

import mmap
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import count, load_block
from vvgt_cli.volume.components import ArrayInfo, choose_array, select_from_array
from vvgt_cli.volume.reading import ReadOptions, Volume, printable, volume_name
from vvgt_cli.volume.vtk.xml import IMAGE_BY_VTK, image_grid

# vtkIdType is stored as int; long is that of a 64-bit machine.
_TYPES = {
    "bit": "", "char": "i1", "signed_char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2",
    "int": "i4", "unsigned_int": "u4", "long": "i8", "unsigned_long": "u8", "vtktypeint64": "i8", "vtktypeuint64": "u8",
    "vtkidtype": "i4", "float": "f4", "double": "f8",
}  # fmt: skip
_KINDS = ("STRUCTURED_POINTS", "IMAGE_DATA")
_FIXED = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6, "GLOBAL_IDS": 1, "PEDIGREE_IDS": 1, "EDGE_FLAGS": 1}
_PLACE = {  # of VTK's XML; "" is not read
    "EXTENT": "WholeExtent", "ORIGIN": "Origin", "SPACING": "Spacing", "ASPECT_RATIO": "Spacing", "DIRECTION": "",
}  # fmt: skip


@dataclass(frozen=True)
class _Array:
    """An array and where its values are: ``start`` in the file, in the coding of ``type``."""

    info: ArrayInfo
    type: str
    tuples: int
    start: int


class Parser:
    """Walks the sections of a binary legacy file and notes the arrays; values are skipped, not read."""

    def __init__(self, text: mmap.mmap, path: Path) -> None:
        """Begin at the start of ``text``."""
        self.text, self.path, self.position = text, path, 0
        self.arrays: list[_Array] = []
        self.image: dict[str, str] = {}  # as VTK's XML has it
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

    def parse(self) -> bool:
        """Read the header, and all sections if it is binary, which is returned."""
        if not (self.line() or "").lower().startswith("# vtk datafile version"):
            raise self.bad("does not begin with '# vtk DataFile Version'")
        self.line()
        coding = " ".join(self.words() or []).upper()
        if coding not in ("ASCII", "BINARY"):
            raise self.bad(f"coding is {coding[:40]!r}; expected ASCII or BINARY")
        first, *kind = self.words() or ["nothing"]
        if first.upper() != "DATASET" or "".join(kind[:1]).upper() not in _KINDS:
            shown = "".join(kind[:1]).lower().replace("_", " ")[:40] if first.upper() == "DATASET" else ""
            raise DataError(
                f"{self.path}: a legacy VTK file of a {printable(shown) or 'field without a grid'}; expected "
                f"{' or '.join(_KINDS)}; resample it first (ParaView: Resample To Image) and save it as .vti"
            )
        while coding == "BINARY" and (words := self.words()) is not None:
            self.section(words[0].upper(), words)
        return coding == "BINARY"

    def section(self, key: str, words: list[str]) -> None:
        """Read one line that is a keyword, with the values that belong to it."""
        if key == "DIMENSIONS":
            self.image.setdefault("WholeExtent", " ".join(f"0 {int(n) - 1}" for n in words[1:]))
        elif key in _PLACE:
            self.image[_PLACE[key]] = " ".join(words[1:])
        elif key in ("POINT_DATA", "CELL_DATA"):
            self.where, self.tuples = key[:-5].lower(), int(words[1])
        elif key == "METADATA":
            while self.line():
                pass
        elif key == "FIELD":
            self.field(int(words[2]))
        elif key == "LOOKUP_TABLE" and len(words) >= 3:
            self.skip("unsigned_char", int(words[2]) * 4)
        elif key == "SCALARS":
            self.scalars(words)
        elif key == "COLOR_SCALARS":
            self.array(words[1], "unsigned_char", int(words[2]), self.tuples, active=True)
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
        need = (n + 7) // 8 if kind == "bit" else n * np.dtype(_TYPES[kind]).itemsize
        if self.position + need > len(self.text):
            raise self.bad(f"{need} bytes of values are declared, {len(self.text) - self.position} are left")
        self.position += need

    def skip_strings(self, n: int) -> None:
        """Skip strings: each has a length in 1, 2, 4 or 8 bytes, as its first two bits say."""
        for _ in range(n):
            if self.position >= len(self.text):
                raise self.bad("a string is missing")
            width = (8, 4, 2, 1)[self.text[self.position] >> 6]
            length = int.from_bytes(self.text[self.position : self.position + width], "big")
            self.position += width + (length & ((1 << (8 * width - 2)) - 1))


def read_legacy(path: Path, options: ReadOptions) -> Volume:
    """Read a legacy VTK image: point data, or cell data on the grid of cell centres."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
        parser = Parser(text, path)
        binary = parser.parse()
        if binary:
            array = parser.arrays[choose_array([a.info for a in parser.arrays], options.array, str(path))]
        if not binary or array.type == "bit":
            return IMAGE_BY_VTK(path, replace(options, array=array.info.name) if binary else options)
        grid = image_grid(parser.image, array.info.where, path)
    shape = (*reversed(grid.dims), array.info.components)
    if count(shape[:3]) != array.tuples:
        raise DataError(
            f"{path}: array {array.info.name!r} has {array.tuples} {array.info.where} values; "
            f"{' x '.join(map(str, grid.dims))} were expected"
        )
    values = load_block(path, np.dtype(_TYPES[array.type]).newbyteorder(">"), shape, offset=array.start)
    field = select_from_array(values, array.info, options.component, str(path))
    return grid.volume(field, array.info, options, volume_name(path))
