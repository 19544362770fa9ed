"""Densities as text: Gaussian's ``.cube``, OpenDX's ``.dx`` (APBS, VMD) and VASP's, on grids that may be skewed.

Formats: https://gaussian.com/cubegen, "Object File Format" of IBM's OpenDX user guide, appendix B.1, and CHGCAR in
https://www.vasp.at/wiki. The first two store z fastest, so that a volume's first index runs along the grid's third
axis. Parsed here: a header is some lines, and sizes are compared with the file before anything is allocated.
"""

from __future__ import annotations

import math
import mmap
import re
import warnings
from pathlib import Path
from typing import IO

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.components import listed, select_component
from vvgt_cli.volume.reading import DENSITY, HeaderFields, ReadOptions, Volume, load_block, placed, type_of, volume_name

BOHR = 0.529177210903  # angstroms (CODATA 2018)
LINE, LINES = 4096, 100_000  # bytes of a line of a header, and lines
MAX_ATOMS, MAX_ORBITALS = 1_000_000, 10_000
_DX_TYPES = ("float", "double", "int", "short", "byte")


def _words(file: IO[bytes], path: Path, what: str) -> list[str]:
    line = file.readline(LINE)
    if not line.endswith(b"\n"):
        raise DataError(f"{path}: its header ends, or has no end of line, where {what} was expected")
    return line.decode("ascii", "replace").split()


def _floats(words: list[str], n: int, path: Path, what: str) -> list[float]:
    """Parse the first ``n`` finite numbers of a line; raise DataError for others."""
    return HeaderFields(str(path)).floats(what, " ".join(words[:n]), n)


def _whole(words: list[str], path: Path, what: str) -> int:
    try:
        return int(words[0])
    except (ValueError, IndexError):
        raise DataError(f"{path}: {what} is {' '.join(words)[:80]!r}; expected a whole number") from None


def read_cube(path: Path, options: ReadOptions) -> Volume:
    """Read a Gaussian cube file; lengths become angstroms. Several orbitals, or values, are components."""
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
        if abs(atoms) > MAX_ATOMS or 0 in sizes or not 1 <= values <= MAX_ORBITALS:
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
    listing = listed(orbitals, ", ")
    label = f"orbitals {listing}:" if orbitals else "its values"
    if len(orbitals) > 1:
        label = f"the cube of orbitals {listing}"
    field, _ = select_component(block, options.component, str(path), label=label)
    unit = 1.0 if min(sizes) < 0 else BOHR
    place, facts = (unit * np.array(steps[::-1]), unit * np.array(origin)), {"preset": DENSITY, "unit": "angstrom"}
    return placed(field, *place, options, volume_name(path), **facts)


def _orbitals(file: IO[bytes], path: Path) -> list[str]:
    """Read the numbers of the orbitals: how many there are, then each, over as many lines as it takes."""
    words = _words(file, path, "the orbitals")
    n = _whole(words, path, "the number of orbitals")
    numbers = words[1:]
    while len(numbers) < n <= MAX_ORBITALS:
        more = _words(file, path, "the orbitals")
        if not more:
            break
        numbers += more
    if not 1 <= n == len(numbers):
        raise DataError(f"{path}: {n} orbitals, of which {len(numbers)} have a number; expected 1 to {MAX_ORBITALS}")
    return numbers


def read_dx(path: Path, options: ReadOptions) -> Volume:
    """Read an OpenDX file of one regular grid of numbers, text or binary."""
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
    return placed(field, steps[::-1], origin, options, volume_name(path), preset=DENSITY, unit="angstrom")


def _dx_values(keys: list[str], counts: list[int], path: Path, start: int) -> np.ndarray:
    """Load the values (n1, n2, n3, c) of the array that a line of words declares and that begins at ``start``."""

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
    shape, kinds = (*counts, components), np.dtype(type_of(kind, {"byte": "i1"}))
    if {"lsb", "msb", "binary", "ieee"} & set(keys):
        kinds = kinds.newbyteorder("<") if "lsb" in keys else kinds.newbyteorder(">") if "msb" in keys else kinds
        return load_block(path, kinds, shape, offset=start)
    # text has some ten digits at most: half the memory will do
    kinds = np.dtype(np.float32) if kind == "double" else kinds
    return load_block(path, kinds, shape, offset=start, encoding="text")


def read_vasp(path: Path, options: ReadOptions) -> Volume:
    """Read a grid of VASP (CHGCAR, CHG, AECCAR, PARCHG, LOCPOT, ELFCAR) on its periodic cell, lengths in angstroms.

    Densities, which the file has multiplied by the cell's volume, are divided by it. Blocks of spin are components.
    """
    with open(path, "rb") as file:
        cell = _vasp_cell(file, path)
        while not (words := _words(file, path, "the size of a grid")):
            pass
        sizes = [_whole([word], path, "the size of the grid") for word in words]
        volume = abs(float(np.linalg.det(cell)))
        if len(sizes) != 3 or min(sizes) < 1 or not 0 < volume < math.inf:
            raise DataError(
                f"{path}: a grid of {words[:9]} on the cell {cell.tolist()}; expected three sizes, a volume"
            )
        starts = [file.tell()]
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
            again = rb"\n[ \t]*%d[ \t]+%d[ \t]+%d[ \t]*\r?\n" % tuple(sizes)
            starts += [match.end() for match in re.finditer(again, text) if match.end() > starts[0]]
    blocks = [load_block(path, np.dtype("f4"), tuple(sizes[::-1]), offset=at, encoding="text") for at in starts]
    label = "its grid (total, then magnetization, or spin up and down)" if len(starts) > 1 else "its grid"
    field, _ = select_component(np.stack(blocks, axis=-1), options.component, str(path), label=label)
    name, slope = path.name.upper(), 1 / volume
    if "LOCPOT" in name or "ELFCAR" in name:
        slope = 1.0
    elif not any(word in name for word in ("CHG", "AECCAR")):
        warnings.warn(f"{path}: taken as a density times the cell's volume, as CHGCAR, not as LOCPOT", stacklevel=2)
    steps, facts = cell / np.reshape(sizes, (3, 1)), {"preset": DENSITY, "unit": "angstrom", "slope": slope}
    return placed(field, steps, np.zeros(3), options, volume_name(path), **facts)


def _vasp_cell(file: IO[bytes], path: Path) -> np.ndarray:
    """Return the lattice vectors (3, 3), in rows, and leave the file behind the atoms."""
    _words(file, path, "its comment")
    words = _words(file, path, "the scale")
    scale = np.array(_floats(words, 3 if len(words) == 3 else 1, path, "the scale"))
    cell = np.array([_floats(_words(file, path, "the lattice"), 3, path, "a lattice vector") for _ in range(3)])
    volume = abs(np.linalg.det(cell))
    if scale[0] < 0 < volume:  # it is the volume
        scale = np.cbrt(-scale[:1] / volume)
    words = _words(file, path, "the elements")
    words = words if words and words[0].isdecimal() else _words(file, path, "the numbers of atoms")
    atoms = sum(_whole([word], path, "a number of atoms") for word in words)
    selective = "".join(_words(file, path, "the kind of coordinates")).lower().startswith("s")
    for _ in range(min(atoms, MAX_ATOMS) + selective):
        _words(file, path, "an atom")
    return np.asarray(cell * scale)
