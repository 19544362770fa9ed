"""The parts of an OpenVDB file around its trees: header, metadata, grid descriptors, transforms.

Layout as openvdb/io/Archive.cc, GridDescriptor.cc, MetaMap.cc and math/Maps.h have it, format versions 222 to 225.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.openvdb import MAGIC
from vvgt_cli.volume.openvdb.codec import ACTIVE_MASK, BLOSC, ZIP, Cursor
from vvgt_cli.volume.reading import FLAT, printable, unit_rows

VERSIONS = range(222, 226)
_UUID = 36
_HALF = "_HalfFloat"
_SEPARATOR = "\x1e"  # stands between the name and the number of grids of one name
_TREE = re.compile(r"Tree_(.+?)_(\d+(?:_\d+)*)(?:_.*)?")
_LEVELS = "5_4_3"
TYPES = {
    "float": ("<f4", 1), "double": ("<f8", 1), "int32": ("<i4", 1), "int64": ("<i8", 1), "bool": ("?", 1),
    "mask": ("?", 1), "vec3s": ("<f4", 3), "vec3d": ("<f8", 3), "vec3i": ("<i4", 3),
}  # fmt: skip


@dataclass(frozen=True)
class Grid:
    """A grid's descriptor.

    Attributes:
        name: without the number that distinguishes grids of one name.
        number: that number, or None.
        parent: unique name of the grid whose tree this one shares, or "".
        kind: value type, a key of `TYPES` if it can be read.
        half: floats are stored in 16 bits.
        levels: logarithms of the widths of the tree's nodes.
        start: offset of the grid's own data.
    """

    name: str
    number: str | None
    parent: str
    kind: str
    half: bool
    levels: str
    start: int

    @property
    def label(self) -> str:
        """The name that picks the grid: ``name`` or ``name[number]``."""
        return self.name if self.number is None else f"{self.name}[{self.number}]"

    @property
    def unique(self) -> str:
        """The name that instances call it by."""
        return self.name if self.number is None else f"{self.name}{_SEPARATOR}{self.number}"

    @property
    def readable(self) -> bool:
        """Whether values and tree are of kinds that are read."""
        return self.kind in TYPES and self.levels == _LEVELS

    @property
    def components(self) -> int:
        """Numbers in a value; 0 for an unknown kind."""
        return TYPES[self.kind][1] if self.kind in TYPES else 0

    def __str__(self) -> str:
        """Describe the grid in a listing."""
        tree = "" if self.levels == _LEVELS else f", tree {self.levels.replace('_', '-') or 'unknown'}"
        text = f"{self.label or '(unnamed)'} ({self.kind}{', stored as half' if self.half else ''}{tree})"
        return printable(text[:100])


def read_header(cursor: Cursor) -> list[Grid]:
    """Read the descriptors of a file's grids, the cursor at its beginning; raise DataError if it is unreadable."""
    if bytes(cursor.take(8)) != MAGIC:
        raise DataError(f"{cursor.name}: does not begin as an OpenVDB file does")
    (version,) = cursor.unpack("I")
    if version not in VERSIONS:
        raise DataError(
            f"{cursor.name}: OpenVDB format version {version}; expected {VERSIONS[0]} to {VERSIONS[-1]}; write the "
            "file again with OpenVDB 3 or newer"
        )
    _, _, offsets = cursor.unpack("IIB")
    if not offsets:
        raise DataError(
            f"{cursor.name}: written as an OpenVDB stream, without offsets of its grids; write it again with "
            "openvdb::io::File"
        )
    cursor.take(_UUID)
    skip_metadata(cursor)
    (count,) = cursor.unpack("i")
    grids = []
    for _ in range(max(count, 0)):
        grid, end = _descriptor(cursor)
        grids.append(grid)
        cursor.seek(end)
    if not grids:
        raise DataError(f"{cursor.name}: an OpenVDB file without a grid; expected at least one")
    return grids


def _descriptor(cursor: Cursor) -> tuple[Grid, int]:
    """Read a grid's descriptor, and where the next one begins."""
    unique, type_name, parent = cursor.text(), cursor.text(), cursor.text()
    start, _, end = cursor.unpack("qqq")
    half = type_name.endswith(_HALF)
    match = _TREE.fullmatch(type_name.removesuffix(_HALF))
    kind, levels = (match[1], match[2]) if match else (type_name, "")
    if end < cursor.at:
        raise cursor.bad(f"a grid that ends at {end}, before it begins")
    name, separator, number = unique.partition(_SEPARATOR)
    return Grid(name, number if separator else None, parent, kind, half, levels, start), end


def skip_metadata(cursor: Cursor) -> dict[str, bytes]:
    """Read metadata by name; values as they are stored."""
    (count,) = cursor.unpack("I")
    values = {}
    for _ in range(count):
        name, _type = cursor.text(), cursor.text()
        (size,) = cursor.unpack("I")
        values[name] = bytes(cursor.take(size)[:64])
    return values


def read_grid_head(cursor: Cursor) -> tuple[int, bool, np.ndarray]:
    """Read compression flags, whether floats have 16 bits, and the transform; the cursor stands at a grid's start.

    The transform is (4, 3): world vectors of a step along x, y and z, and the position of index (0, 0, 0).

    Raises:
        DataError: unknown flags, a transform that does not take boxes to boxes, or damage.
    """
    (compression,) = cursor.unpack("I")
    if compression & ~(ZIP | ACTIVE_MASK | BLOSC):
        raise cursor.bad(f"compression flags {compression:#x}; expected ZIP, Blosc and active masks")
    half = skip_metadata(cursor).get("is_saved_as_half_float", b"\0")[:1] == b"\1"
    return compression, half, _transform(cursor)


def _transform(cursor: Cursor) -> np.ndarray:
    kind = cursor.text()
    axes, translation = np.eye(3), np.zeros(3)
    if kind in ("UniformScaleMap", "ScaleMap"):
        axes = np.diag(cursor.unpack("15d")[:3])
    elif kind in ("UniformScaleTranslateMap", "ScaleTranslateMap"):
        numbers = cursor.unpack("18d")
        translation, axes = np.array(numbers[:3]), np.diag(numbers[3:6])
    elif kind == "TranslationMap":
        translation = np.array(cursor.unpack("3d"))
    elif kind in ("AffineMap", "UnitaryMap"):
        matrix = np.array(cursor.unpack("16d")).reshape(4, 4)  # acts on rows: (i, j, k, 1) @ matrix
        axes, translation = matrix[:3, :3], matrix[3, :3]
    else:
        hint = "a frustum" if "Frustum" in kind else f"{kind[:40]!r}"
        raise DataError(
            f"{cursor.name}: the grid's transform is {hint}; expected scale, translation and rotation: "
            "resample it first"
        )
    if not np.isfinite(axes).all() or not np.isfinite(translation).all():
        raise cursor.bad("a transform that is not finite")
    lengths, direction = unit_rows(axes)
    if min(lengths) <= 0 or abs(np.linalg.det(np.array(direction).reshape(3, 3))) < FLAT:
        raise DataError(
            f"{cursor.name}: the grid's transform flattens; expected scale, translation, rotation and shear: "
            "resample it first"
        )
    return np.vstack([axes, translation])
