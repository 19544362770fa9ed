"""What lies beside an array whose axes nothing states: coordinates under common names; and arrays of particles."""

from __future__ import annotations

import itertools
import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.labelled import GEOMETRY, Axis, axis, even, even_axis
from vvgt_cli.volume.reading import choose, listed, metres, text_of

GROUPS = re.compile(r"coord(inate)?s?|grid|axes|mesh|dim(ension)?s?", re.I)  # that hold coordinates
_LETTER = re.compile(r"(?:(?:coord(?:inate)?s?|grid|axis)_?)?([xyzt])[ _([]*(\w*)[)\]]*", re.I)
_SUFFIXES = re.compile(r"|s|c|v|ax(?:is|es)|grid|(?:coord(?:inate)?|cent(?:er|re)|value|val|pos(?:ition)?)s?", re.I)
_NUMBERED = re.compile(r"(?:dim|axis|coord)_?(\d)", re.I)
_GEOMETRY = {re.sub("_", "", word.lower()) for word in GEOMETRY}
_PLACE = re.compile(r"(?:\w*_)?(?:[a-z]|geo)?(?:lon|lat)(?:g|itude)?s?(?:_\w+|\d*)|[xy]c?|g(?:lam|phi)[tuvf]", re.I)
_PLACES = re.compile(r"(?:particles?_?)?(?:coord(?:inate)?s?|pos(?:ition)?s?|xyz)", re.I)
_VECTORS = re.compile(r"(?:particles?_?)?(?:vel(?:ocity|ocities)?|accelerations?|forces?|moment(?:um|a))", re.I)


@dataclass(frozen=True)
class Neighbour:
    """An array along one axis that lies beside another array.

    Attributes:
        size: of its axis; 0 if it has several.
        read: returns its stored values (size,) and its attributes.
        along: name of its axis, where axes have names; "".
    """

    size: int
    read: Callable[[], tuple[np.ndarray, Mapping[str, Any]]]
    along: str = ""

    @classmethod
    def of(cls, shape: Sequence[int], read: Any, along: str = "") -> Neighbour:
        """Make a neighbour of an array of any shape."""
        size = math.prod(shape or ())
        return cls(size if size == max(shape or (1,)) else 0, read, along)


def with_neighbours(
    axes: Sequence[Axis], beside: Mapping[str, Neighbour], source: str, spacing_given: bool
) -> list[Axis]:
    """Return an array's axes with the coordinates beside it.

    An axis with a name has those of that name. If none has any, and no spacing is given, names and sizes may assign
    some in one way; otherwise one message names the neighbours whose sizes fit. Names are letters (``x``, ``x_coords``,
    ``z_um``), words of CF (``lon``) or numbers for all axes (``dim1``, ``dim2``, ``dim3`` of EMD, where two values
    stand for an even axis).
    """
    same = {a.name: beside[a.name] for a in axes if a.name in beside and a.centres is None}
    axes = [_read(a.name, same[a.name]) if a.name in same and same[a.name].size == a.size else a for a in axes]
    if spacing_given or any(a.centres is not None for a in axes):
        return axes
    if (numbered := _numbered(axes, beside)) is not None:
        return numbered
    unread = [name for name in beside if re.sub("_|s$", "", name.rpartition("/")[2].lower()) in _GEOMETRY]
    fits = {name: one for name, one in beside.items() if name not in unread and any(_lies_along(one, a) for a in axes)}
    some = {name: _read(name, one) for name, one in itertools.islice(fits.items(), 50)}
    read = {name: a for name, a in some.items() if a.centres is not None}
    named = {role: [name for name, a in read.items() if a.role == role and _ascends(a)] for role in "tzyx"}
    chosen = [names[0] for names in named.values() if len(names) == 1]
    if len(axes) < 4 and all(read[name].role == "t" for name in chosen):
        chosen = []
    ways = [
        dict(zip(order, chosen, strict=True))
        for order in itertools.permutations(range(len(axes)), len(chosen))
        if chosen and all(_lies_along(fits[name], axes[k], read[name]) for k, name in zip(order, chosen, strict=True))
    ]
    along: list[list[Any]] = [[read[way[k]].centres if k in way else None for k in range(len(axes))] for way in ways]
    if ways and all(np.array_equal(a, b) for way in along for a, b in zip(way, along[0], strict=True)):
        return [read[ways[0][k]] if k in ways[0] else a for k, a in enumerate(axes)]
    if read or unread:
        steps = [f"as long as its axes, {listed([f'{name} ({_step(a)})' for name, a in read.items()], ', ', 4)}"]
        forms = [f"in forms that are not read, {listed(unread, ', ', 4)}"]
        lie = "; ".join([*(steps if read else []), *(forms if unread else [])])
        warnings.warn(
            f"{source}: states no spacing, which is taken as 1; beside it lie, {lie}; --spacing X Y Z sets it",
            stacklevel=3,
        )
    return axes


def warn_of_curvilinear(odd: Sequence[str], axes: Sequence[Axis], source: str) -> None:
    """Warn where places are coordinates of two or more axes (CF, 5.2), which are not read, and axes have no others.

    ``odd`` names all such coordinates.
    """
    places = [name for name in odd if _PLACE.fullmatch(name)]
    if places and sum(a.centres is not None and a.role in ("x", "y") for a in axes) < 2:
        warnings.warn(
            f"{source}: its places are curvilinear ({', '.join(places)}), which is not read: voxels lie on an even "
            "grid of its axes (cdo remapbil or Resample in ParaView makes a regular one)", stacklevel=3,
        )  # fmt: skip


def _numbered(axes: Sequence[Axis], beside: Mapping[str, Neighbour]) -> list[Axis] | None:
    """Return axes with coordinates whose names count the axes from 0 or 1; None unless all are there and ascend."""
    matches = {int(m[1]): one for name, one in beside.items() if (m := _NUMBERED.fullmatch(name))}
    first = min(matches, default=0)
    placed = []
    for k, old in enumerate(axes):
        one = matches.get(k + first)
        if one is None or first > 1 or one.size not in (2, old.size):
            return None
        values, attributes = one.read()
        unit = text_of(attributes.get("units", "")).strip("[]").replace("_", "")  # EMD: [n_m]
        facts = text_of(attributes.get("name", "")), old.size
        if one.size == old.size:
            placed.append(axis(*facts, values, {"units": unit}))
        else:
            placed.append(even_axis(*facts, values[0], values[1] - values[0], {"units": unit}))
    return placed if all(a.size == 1 or _ascends(a) for a in placed) else None


def _read(name: str, one: Neighbour) -> Axis:
    """Read a neighbour as an axis, with the role and the unit that its attributes or its name state."""
    values, attributes = one.read()
    leaf, centres = name.rpartition("/")[2], np.ravel(values) if values.dtype.kind in "iuf" else None
    line = axis(leaf, one.size, centres, attributes)
    letter = None if line.role else _LETTER.fullmatch(leaf)
    if letter and (_SUFFIXES.fullmatch(letter[2]) or metres(letter[2])):
        stated = {"axis": letter[1], "units": letter[2] if metres(letter[2]) else ""}
        return axis(leaf, one.size, centres, stated | dict(attributes))
    return line


def _lies_along(one: Neighbour, a: Axis, read: Axis | None = None) -> bool:
    """Tell whether a neighbour can lie along an axis, by size and by the names that either has."""
    if one.size != a.size or a.size < 2 or (one.along and one.along != a.name):
        return False
    return read is None or bool(one.along) or a.role in ("", read.role)


def _ascends(a: Axis) -> bool:
    steps = np.diff(a.centres if a.centres is not None else [])
    return bool(np.isfinite(steps).all() and ((steps > 0).all() or (steps < 0).all()))


def _step(a: Axis) -> str:
    if a.centres is None or not _ascends(a) or not even(a.centres):
        return "uneven"
    return f"step {abs(a.centres[-1] - a.centres[0]) / (a.size - 1):.4g}"


def choose_grid(
    arrays: Mapping[str, tuple[Sequence[int], str]], wanted: str | None, source: str, what: str = "array",
    how: str = "choose one with --array NAME", rows: Mapping[str, str] | None = None,
) -> str:  # fmt: skip
    """Return the name of the array asked for, else of the only one with three axes (with two, if none has three).

    ``arrays`` has the shape and the type of each by name; ``rows`` describe them otherwise. ``what`` and ``how`` are
    those of `choose`.

    Raises:
        DataError: there are none, or places and vectors of particles in place of any.
        UsageError: several and none chosen (`SeveralArrays`), or none of that name.
    """
    if wanted is not None and wanted in arrays:
        arrays = {wanted: arrays[wanted]}
    places = any(_of_particles(name, shape, dtype) for name, (shape, dtype) in arrays.items())
    particles = [name for name, (shape, dtype) in arrays.items() if _of_particles(name, shape, dtype, places)]
    rest = [name for name, (shape, _) in arrays.items() if name not in particles and (len(shape) >= 2 or wanted)]
    deep = [name for name in rest if sum(n > 1 for n in arrays[name][0]) >= 3]
    columns = [name for name, (shape, dtype) in arrays.items() if len(shape) == 1 and "f" in dtype]
    if not rest and {"x", "y"} <= {re.split("[/_]", name.lower())[-1] for name in columns}:
        particles = particles or [name for name in columns if name.lower().endswith("x")]
    if particles and not deep:
        shape = " x ".join(map(str, arrays[particles[0]][0]))
        raise DataError(
            f"{source}: particles ({listed([particles[0]])}: {shape}), which lie on no grid; expected values on one: "
            "deposit them first (yt's arbitrary_grid, pynbody, swiftsimio) and save that as .npy or HDF5"
        )
    names = deep or rest
    texts = {name: f"{name} ({' x '.join(map(str, shape))} {dtype})" for name, (shape, dtype) in arrays.items()}
    return names[choose(names, [(rows or texts)[name] for name in names], wanted, source, what, how)]


def _of_particles(name: str, shape: Sequence[int], dtype: str, beside: bool = False) -> bool:
    """Tell whether an array holds places or vectors of particles (N, 2 or 3), ``beside`` places also of several steps.

    The name is that of the group in H5MD, where arrays are called ``value``.
    """
    if "f" not in dtype or len(shape) not in (2, 3):
        return False
    leaf = re.sub("/values?$", "", name).rpartition("/")[2]
    rows = shape[-1] in (2, 3) or (len(shape) == 2 and shape[0] in (2, 3))
    return rows and bool(_PLACES.fullmatch(leaf) or ((len(shape) == 2 or beside) and _VECTORS.fullmatch(leaf)))
