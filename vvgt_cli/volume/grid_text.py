"""Densities as text: Gaussian's ``.cube`` and OpenDX's ``.dx`` (APBS, VMD), on grids that may be skewed.

Formats: https://gaussian.com/cubegen and "Object File Format" of IBM's OpenDX user guide, appendix B.1. Both store z
fastest, so that a volume's first index runs along the grid's third axis. Parsed here: a header is some lines, and sizes
are compared with the file before anything is allocated.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import IO

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.blocks import load_block
from vvgt_cli.volume.components import select_component
from vvgt_cli.volume.headers import unit_rows
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import Reader, register, volume_name
from vvgt_cli.volume.types import Volume

BOHR = 0.529177210903  # angstroms (CODATA 2018)
LINE, LINES = 4096, 100_000  # bytes of a line of a header, and lines
MOST_ATOMS, MOST_ORBITALS = 1_000_000, 10_000
_DX = re.compile(rb"(?:\s*#[^\n]*\n)*\s*object\s+\S+\s+class\s+gridpositions\s+counts\s", re.I)
_DX_TYPES = {"float": "f4", "double": "f8", "int": "i4", "short": "i2", "byte": "i1"}


def _words(file: IO[bytes], path: Path, what: str) -> list[str]:
    line = file.readline(LINE)
    if not line.endswith(b"\n"):
        raise DataError(f"{path}: its header ends, or has no end of line, where {what} was expected")
    return line.decode("ascii", "replace").split()


def _floats(words: list[str], n: int, path: Path, what: str) -> list[float]:
    """``n`` finite numbers of a line; more are not looked at.

    Raises:
        DataError: others.
    """
    try:
        found = [float(w) for w in words[:n]]
    except ValueError:
        found = []
    if len(found) < n or not all(map(math.isfinite, found)):
        raise DataError(f"{path}: {what} is {' '.join(words)[:80]!r}; expected {n} finite numbers")
    return found


def _whole(words: list[str], path: Path, what: str) -> int:
    try:
        return int(words[0])
    except (ValueError, IndexError):
        raise DataError(f"{path}: {what} is {' '.join(words)[:80]!r}; expected a whole number") from None


def _placed(
    field: np.ndarray, steps: list[list[float]], origin: list[float], path: Path, options: ReadOptions
) -> Volume:
    """The volume of a field (n1, n2, n3) whose axes run along the three ``steps``."""
    spacing, direction = unit_rows(steps[::-1])
    return Volume(field, options.spacing_or(spacing), tuple(origin), direction, volume_name(path), density=True)


def read_cube(path: Path, options: ReadOptions) -> Volume:
    """Read a Gaussian cube file; lengths become angstroms. Several orbitals, or values, are components.

    Raises:
        DataError: a header that is damaged or does not fit the file, or something that is no number.
        UsageError: several orbitals and none chosen.
    """
    with open(path, "rb") as file:
        for title in ("its title", "its second title"):
            _words(file, path, title)
        words = _words(file, path, "the number of atoms")
        atoms, origin = _whole(words, path, "the number of atoms"), _floats(words[1:], 3, path, "the origin")
        values = _whole(words[4:], path, "the number of values") if words[4:] else 1
        sizes, steps = [], []
        for k in range(3):
            words = _words(file, path, f"axis {k + 1}")
            sizes.append(_whole(words, path, f"the size of axis {k + 1}"))
            steps.append(_floats(words[1:], 3, path, f"the step of axis {k + 1}"))
        # a file of orbitals has minus the number of atoms; sizes below 0 mean that lengths are in angstroms already
        if abs(atoms) > MOST_ATOMS or 0 in sizes or not 1 <= values <= MOST_ORBITALS:
            raise DataError(
                f"{path}: {atoms} atoms, axes of {sizes} values, {values} a voxel; expected a cube file of at least "
                "1 voxel along each axis"
            )
        for k in range(abs(atoms)):
            _words(file, path, f"atom {k + 1}")
        orbitals = _orbitals(file, path) if atoms < 0 else []
        start = file.tell()
    values *= max(len(orbitals), 1)
    shape = (*map(abs, sizes), values)
    block = load_block(path, np.dtype(np.float32), shape, offset=start, encoding="text")
    listing = ", ".join(orbitals[:12]) + (", ..." if len(orbitals) > 12 else "")
    label = f"orbitals {listing}:" if orbitals else "its values"
    if len(orbitals) > 1:
        label = f"the cube of orbitals {listing}"
    field, _ = select_component(block, options.component, str(path), label=label)
    unit = 1.0 if min(sizes) < 0 else BOHR
    return _placed(field, [[unit * s for s in step] for step in steps], [unit * o for o in origin], path, options)


def _orbitals(file: IO[bytes], path: Path) -> list[str]:
    """Numbers of the orbitals: how many there are, then each, over as many lines as it takes."""
    words = _words(file, path, "the orbitals")
    n = _whole(words, path, "the number of orbitals")
    found = words[1:]
    while len(found) < n <= MOST_ORBITALS:
        more = _words(file, path, "the orbitals")
        if not more:
            break
        found += more
    if not 1 <= n == len(found):
        raise DataError(f"{path}: {n} orbitals, of which {len(found)} have a number; expected 1 to {MOST_ORBITALS}")
    return found


def read_dx(path: Path, options: ReadOptions) -> Volume:
    """Read an OpenDX file of one regular grid of numbers, text or binary.

    Raises:
        DataError: another kind of object, a header that is damaged or does not fit the file, or no numbers.
        UsageError: several components and none chosen.
    """
    counts: list[int] = []
    origin: list[float] = []
    steps: list[list[float]] = []
    with open(path, "rb") as file:
        for _ in range(LINES):
            words = _words(file, path, "'data follows'")
            keys = [w.strip('"').lower() for w in words]
            if "counts" in keys and "gridpositions" in keys:
                counts = [_whole([w], path, "counts") for w in words[keys.index("counts") + 1 :]]
            elif keys[:1] == ["origin"]:
                origin = _floats(words[1:], 3, path, "the origin")
            elif keys[:1] == ["delta"]:
                steps.append(_floats(words[1:], 3, path, "a delta"))
            elif "array" in keys and "class" in keys:
                break
        else:
            raise DataError(f"{path}: no array in its first {LINES} lines; expected an OpenDX file of a regular grid")
        start = file.tell()
    if len(counts) != 3 or min(counts) < 1 or len(steps) != 3 or len(origin) != 3:
        raise DataError(
            f"{path}: counts {counts[:9]}, {len(steps)} deltas, origin {origin}; expected a regular grid of three axes"
        )
    block = _dx_values(keys, counts, path, start)
    field, _ = select_component(block, options.component, str(path))
    return _placed(field, steps, origin, path, options)


def _dx_values(keys: list[str], counts: list[int], path: Path, start: int) -> np.ndarray:
    """(n1, n2, n3, c) values of the array that a line of words declares and that begins at ``start``."""

    def after(key: str, default: str) -> str:
        return keys[keys.index(key) + 1] if key in keys[:-1] else default

    items, rank = _whole([after("items", "")], path, "items"), _whole([after("rank", "0")], path, "rank")
    components = _whole([after("shape", "")], path, "shape") if rank else 1
    kind = after("type", "float")
    if rank not in (0, 1) or components < 1 or items != math.prod(counts) or "follows" not in keys:
        raise DataError(
            f"{path}: an array of {items} items, rank {rank}; expected one of {' x '.join(map(str, counts))} numbers, "
            "or vectors, that follow it in the same file"
        )
    if kind not in _DX_TYPES:
        raise DataError(f"{path}: values of type {kind[:40]!r}; expected one of {', '.join(_DX_TYPES)}")
    if "unsigned" in keys or (kind == "byte" and "signed" not in keys):
        raise UsageError(f"{path}: unsigned integers in an OpenDX file; expected floats: convert it to type float")
    shape, kinds = (*counts, components), np.dtype(_DX_TYPES[kind])
    if {"lsb", "msb", "binary", "ieee"} & set(keys):
        kinds = kinds.newbyteorder("<") if "lsb" in keys else kinds.newbyteorder(">") if "msb" in keys else kinds
        return load_block(path, kinds, shape, offset=start)
    # text has some ten digits at most: half the memory will do
    kinds = np.dtype(np.float32) if kind == "double" else kinds
    return load_block(path, kinds, shape, offset=start, encoding="text")


register(Reader("Gaussian cube", (".cube", ".cub"), lambda head: False, read_cube, by_name=True))
register(Reader("OpenDX", (".dx",), lambda head: _DX.match(head) is not None, read_dx, by_name=True))
