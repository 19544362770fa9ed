"""Arrays with named axes and attributes (HDF5, NetCDF, Zarr, NumPy) to volumes: order, spacing, units, scaling.

Attributes and axes are read as the CF conventions (https://cfconventions.org) have them, chapters 2.5, 3.1, 4 and 8.1.
"""

from __future__ import annotations

import math
import operator
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, SeveralSteps, UsageError
from vvgt_cli.volume.blocks import IN_BLOCKS, check_memory
from vvgt_cli.volume.components import choose_component, contiguous, magnitude
from vvgt_cli.volume.reading import ReadOptions, Segment, Volume, printable, segments_in, text_of
from vvgt_cli.volume.space import metres, unit_name
from vvgt_cli.volume.stored import Stored
from vvgt_cli.volume.types import float_dtype, triple, without

EVEN = 0.01  # of a step that a coordinate may be off and still count as evenly spaced (float32 longitudes are)
AXIS_ATTRIBUTES = ("axis", "standard_name", "units", "positive", "_CoordinateZisPositive")
LIMITS = ("valid_min", "valid_max", "valid_range")
MARKS = ("_FillValue", "missing_value", *LIMITS)
NAMING = ("long_name", "standard_name", "units", "flag_values", "flag_meanings", "flag_masks")  # of the values
CF_ATTRIBUTES = ("scale_factor", "add_offset", *MARKS, "_Unsigned")
DESCRIBES = ("bounds", "climatology", "cell_measures", "formula_terms", "ancillary_variables", "grid_mapping")
GEOMETRY = (  # attributes that look like a place in space, in forms that no convention defines
    *("spacing", "voxel_size", "voxelSize", "pixel_size", "pixelSize", "resolution", "origin", "offset", "affine"),
    *("direction", "transform"),
)
ATTRIBUTES = (*CF_ATTRIBUTES, *GEOMETRY, *NAMING)
_ROLES = {
    "x": {"x", "lon", "longitude", "rlon", "easting", "projection_x_coordinate", "grid_longitude"},
    "y": {"y", "lat", "latitude", "rlat", "northing", "projection_y_coordinate", "grid_latitude"},
    "z": {"z", "lev", "level", "plev", "depth", "height", "altitude", "elevation", "pressure", "air_pressure"},
    "t": {"t", "time"},
}
_NO_LENGTHS = ("", "1", "degrees", "rad", "level", "pixel", "px", "voxel")  # units by which no length is meant
_PRESSURES = {
    *("pa", "hpa", "kpa", "dbar", "bar", "mbar", "pascal", "pascals", "millibar", "millibars", "decibar", "decibars"),
    *("atm", "atmosphere"),
}


@dataclass(frozen=True)
class Axis:
    """One axis of an array.

    Attributes:
        name: as the file has it, or "".
        size: values along it.
        centres: (size,) coordinates of the values, or None.
        units: of the coordinates, or "".
        role: ``x``, ``y``, ``z``, ``t``, ``c`` (channels), or "" where nothing says.
        labels: names of channels, where there are any.
        colors: RGB of channels, where there are any.
        step: distance between values where the file states it even of a single one; 0 where it does not.
    """

    name: str
    size: int
    centres: np.ndarray | None = None
    units: str = ""
    role: str = ""
    labels: tuple[str, ...] = ()
    colors: tuple[tuple[float, float, float] | None, ...] = ()
    step: float = 0.0

    def __str__(self) -> str:
        """Describe the axis in a message."""
        return f"{printable(self.name) or 'unnamed'} ({self.size})"


def axis(name: str, size: int, centres: np.ndarray | None = None, attributes: Mapping[str, Any] | None = None) -> Axis:
    """Make an axis, with its role from the attributes ``axis``, ``standard_name`` and ``units``, else from its name.

    Coordinates are decoded as `decode` does it. Those of a vertical axis that point down become their negatives, so
    that z always points up.
    """
    attributes = attributes or {}
    stated = {key: text_of(value).strip() for key, value in attributes.items() if key in AXIS_ATTRIBUTES}
    if centres is not None:
        values, slope, intercept = decode(np.array(centres), attributes, f"axis {name}")
        centres = values.astype(np.float64) * slope + intercept
    units = stated.get("units", "")
    role = stated.get("axis", "").lower()
    words = [stated.get("standard_name", "").lower(), name.lower()]
    if role not in ("x", "y", "z", "t"):
        role = next((key for word in words for key, names in _ROLES.items() if word in names), "")
        bearing = re.fullmatch(r"degrees?_?(east|north|e|n)", units.lower())  # CF, 4.1 and 4.2
        if bearing is not None:
            role = "x" if bearing[1].startswith("e") else "y"
        if " since " in units:
            role = "t"
        vertical = "positive" in stated or units.lower() in _PRESSURES or any(w.startswith("depth") for w in words)
        role = role or ("z" if vertical else "")  # CF, 4.3
    if role == "z" and centres is not None and _points_down(stated, words, centres):
        centres = -np.asarray(centres, np.float64) + 0.0
    return Axis(name, size, centres, units, role)


def even_axis(name: str, size: int, first: float, step: float, attributes: Mapping[str, Any] | None = None) -> Axis:
    """Make an axis of evenly spaced values, whose step is known even if there is only one value; else as `axis`."""
    line = axis(name, max(size, 2), first + step * np.arange(max(size, 2)), attributes)
    if line.centres is None:
        return line
    one_step = float(abs(line.centres[1] - line.centres[0]))
    return replace(line, size=size, centres=line.centres[:size], step=one_step)


def _points_down(stated: Mapping[str, str], words: Sequence[str], centres: np.ndarray) -> bool:
    """Tell whether the coordinates of a vertical axis grow downwards (CF, 4.3; ``_CoordinateZisPositive``: Unidata).

    Without an attribute that says so, pressure and a depth that is not negative grow downwards.
    """
    positive = (stated.get("positive") or stated.get("_CoordinateZisPositive", "")).lower()
    if positive in ("up", "down"):
        return positive == "down"
    if positive:
        warnings.warn(f"axis {words[1]}: positive is {positive!r}, neither up nor down; taken as up", stacklevel=4)
        return False
    if stated.get("units", "").lower() in _PRESSURES:
        return True
    depth = any(word.startswith("depth") for word in words) and bool((centres >= 0).all())
    if depth:
        warnings.warn(f"axis {words[1]}: taken as pointing down, as depths do (no attribute positive)", stacklevel=4)
    return depth


def described_by(attributes: Mapping[str, Any]) -> list[str]:
    """Return the names of variables that describe one of these attributes, and are no data of their own (CF, 7)."""
    words = (word for key in DESCRIBES for word in text_of(attributes.get(key, "")).split())
    return [word for word in words if not word.endswith(":")]


def labelled_volume(
    stored: np.ndarray | Callable[[tuple[Any, ...]], np.ndarray], dtype: np.dtype, axes: Sequence[Axis],
    attributes: Mapping[str, Any], options: ReadOptions, source: str, name: str, chunks: Sequence[int] | None = None,
) -> Volume:  # fmt: skip
    """Make a volume of an array with named axes.

    ``stored`` holds the values (mapped, perhaps), or is a function that reads a part by a slice or a number for each
    axis; ``axes`` come slowest first. ``options.time`` is the index along the axis of time, ``component`` that along
    another that is not of space; of a single such axis, either. With ``options.stored`` an array with ``chunks`` stays
    in its file and is read in blocks.

    Returns:
        Axes in the order z, y, x and ascending; values that the attributes call missing are NaN.

    Raises:
        DataError: an array without two or three axes of space, coordinates that do not ascend or descend.
        UsageError: an axis too many and no choice along it (`SeveralSteps` where it is time's), axes that are
            irregular or of different units.
    """
    if dtype.kind not in "iufb":
        raise DataError(f"{source}: values of type {dtype}; expected integers or floats")
    _warn_of_unread(axes, attributes, options, source)
    space, extra, step = _split_axes(list(axes), options, source)
    zyx, chosen = _zyx(space, axes), None
    index: list[Any] = [slice(None) if k in space else 0 for k in range(len(axes))]
    if extra is not None:
        it, what = axes[extra], f"{source}: axes {', '.join(map(str, axes))}, along"
        what = f"{what} {printable(it.name) or 'the shortest of them'}"
        chosen = choose_component(it.size, dtype, options.component, what, it.labels, it.colors, False, it.role == "c")
        index[extra] = slice(None) if chosen is None else chosen
    if step is not None:
        index[step] = options.step(axes[step].size, source)
    if callable(stored) and options.stored and chunks is not None and len(space) == 3:
        return _left(stored, dtype, axes, index, zyx, attributes, options, source, name, chunks)
    if callable(stored):
        size = math.prod(n.size for n, i in zip(axes, index, strict=True) if i == slice(None))
        check_memory(size * dtype.itemsize, source, IN_BLOCKS)
        values = np.asarray(stored(tuple(index)))
    else:
        values = stored[tuple(index)]
    values, slope, intercept = decode(values, attributes, source)
    kept = [k for k in range(len(axes)) if index[k] == slice(None)]
    order, spatial = [kept.index(k) for k in zyx], [axes[k] for k in zyx]
    if extra is not None and chosen is None:  # the magnitude over an axis of components
        field = magnitude(np.transpose(values, [kept.index(extra), *order]), slope, intercept)
        slope, intercept = 1.0, 0.0
    else:
        field = np.transpose(values, order)
    if field.ndim == 2:
        field, spatial = field[None], [Axis("", 1), *spatial]
    volume = _placed(field, spatial, (slope, intercept), options, source, name)
    return _named(volume, attributes, dtype, _time(axes, index), source)


def _warn_of_unread(axes: Sequence[Axis], attributes: Mapping[str, Any], options: ReadOptions, source: str) -> None:
    """Warn of attributes that look like a geometry, where axes have none."""
    unread = [key for key in GEOMETRY if key in attributes]
    if unread and options.spacing is None and all(a.centres is None for a in axes):
        warnings.warn(f"{source}: attributes {', '.join(unread)} are not read; --spacing X Y Z sets it", stacklevel=4)


def _split_axes(axes: list[Axis], options: ReadOptions, source: str) -> tuple[list[int], int | None, int | None]:
    """Return the indices of the spatial axes, of the axis of components and of the axis of time."""
    left, roles = list(range(len(axes))), [a.role for a in axes]
    alone = [a.role in ("x", "y", "z") and roles.count(a.role) == 1 for a in axes]
    for k in [k for k in left if axes[k].size == 1 and not alone[k]]:  # of time steps and the like there may be one
        if len(left) > 3 or (len(left) == 3 and axes[k].role in ("t", "c")):
            left.remove(k)
    for k in [k for k in left if axes[k].size == 1]:
        if len(left) > 3 + sum(roles[j] in ("t", "c") for j in left):
            left.remove(k)
    listing = ", ".join(map(str, axes)) or "none"
    odd = [k for k in left if axes[k].role in ("t", "c")]
    if not odd and len(left) == 4:
        unnamed = [k for k in left if axes[k].role not in ("x", "y", "z")]
        ends = left[0] if axes[left[0]].size <= axes[left[-1]].size else left[-1]
        odd = unnamed if len(unnamed) == 1 else [ends]
    space = [k for k in left if k not in odd]
    times = [k for k in odd if axes[k].role == "t"]
    steps = times or [k for k in odd if axes[k].role != "c"]
    step = None
    if options.time is not None and steps:
        step = steps[0]
        odd = [k for k in odd if k != step]
    elif options.time:
        raise UsageError(f"{source}: axes {listing}, none of time; leave out --time {options.time}")
    elif times and (len(odd) > 1 or options.component is None):
        along = axes[times[0]]
        raise SeveralSteps(
            source, along.size, times=None if along.centres is None else along.centres.tolist(), unit=along.units
        )
    if len(odd) > 1 or len(space) not in (2, 3):
        raise DataError(
            f"{source}: axes {listing}; expected two or three axes of space, and at most one of time and one more"
        )
    if not odd and options.component not in (None, 0):
        raise UsageError(f"{source}: axes {listing}, none of components; leave out --component {options.component}")
    return space, odd[0] if odd else None, step


def _zyx(space: Sequence[int], axes: Sequence[Axis]) -> list[int]:
    """Order the spatial axes as z, y, x: by role; those without one stay in file order."""
    slots: dict[str, int] = {}
    for k in space:
        if axes[k].role in "xyz" and axes[k].role not in ("", *slots):
            slots[axes[k].role] = k
    rest = [k for k in space if k not in slots.values()]
    wanted = "zyx"[3 - len(space) :]
    if not set(slots) <= set(wanted):  # a slice across another plane: as the file has it
        return list(space)
    return [slots[role] if role in slots else rest.pop(0) for role in wanted]


def decode(values: np.ndarray, attributes: Mapping[str, Any], source: str) -> tuple[np.ndarray, float, float]:
    """Apply CF attributes: missing values become NaN, which makes floats of integers.

    Returns:
        values, slope, intercept: the data value is ``slope * values + intercept``.
    """
    slope, intercept = _scaling(attributes, source)
    values = values.view(stored_type(values.dtype, attributes))
    missing = _missing(values, attributes, slope, intercept)
    if missing.any():
        check_memory(values.size * float_dtype(values.dtype).itemsize, source)
    return without(values, missing), slope, intercept


def stored_type(dtype: np.dtype, attributes: Mapping[str, Any]) -> np.dtype:
    """Return the type of stored values, for integers with the sign that ``_Unsigned`` states (NUG, appendix B)."""
    signs = {"true": "iu", "false": "ui"}.get(text_of(attributes.get("_Unsigned", "")).lower(), "  ")
    return np.dtype(dtype.str.replace(*signs)) if dtype.kind in "iu" else dtype


def _scaling(attributes: Mapping[str, Any], source: str) -> tuple[float, float]:
    return number_in(attributes, "scale_factor", 1.0, source), number_in(attributes, "add_offset", 0.0, source)


def number_in(attributes: Mapping[str, Any], key: str, default: float, source: str) -> float:
    """Return the first number of an attribute; raise DataError if it is not finite, or a ``scale_factor`` of 0."""
    if key not in attributes:
        return default
    try:
        value = float(np.asarray(attributes[key]).reshape(-1)[0])
    except (ValueError, TypeError, IndexError):
        value = math.nan
    if not math.isfinite(value) or (key == "scale_factor" and value == 0):
        raise DataError(f"{source}: attribute {key} is {attributes[key]}; expected a finite number, and no scale of 0")
    return value


def _missing(values: np.ndarray, attributes: Mapping[str, Any], slope: float, intercept: float) -> np.ndarray:
    """Return a mask of the stored values (of `stored_type`) that the attributes call missing, False if none can be."""
    marks = [m for key in ("_FillValue", "missing_value") for m in _marks(attributes, key, values.dtype)]
    with np.errstate(over="ignore"):  # of numbers beyond the type's
        tests: list[np.ndarray] = [values == mark for mark in marks if mark == mark]
    limits = _marks(attributes, "valid_range", values.dtype)
    lo = _marks(attributes, "valid_min", values.dtype) or limits[:1]
    hi = _marks(attributes, "valid_max", values.dtype) or limits[1:2]
    if any(_unpacked(attributes, key, values.dtype) for key in LIMITS):
        lo, hi = ([_packed(m, slope, intercept) for m in some] for some in ((lo, hi) if slope > 0 else (hi, lo)))
    tests += [values < lo[0]] if lo else []
    tests += [values > hi[0]] if hi else []
    return reduce(operator.or_, tests, np.array(False))


def _marks(attributes: Mapping[str, Any], key: str, dtype: np.dtype) -> list[Any]:
    """Return the numbers of an attribute, with the sign of ``_Unsigned`` as values have it; none where it is text."""
    numbers = np.asarray(attributes.get(key, ())).reshape(-1)
    if numbers.dtype.kind not in "iuf":
        return []
    if "_Unsigned" in attributes and numbers.dtype.kind in "iu" and dtype.kind in "iu":
        numbers = numbers.astype(dtype)  # wraps
    return numbers.tolist()


def _unpacked(attributes: Mapping[str, Any], key: str, dtype: np.dtype) -> bool:
    """Tell whether limits of packed integers count in data values: they have the type of the scaling (NUG, appendix A).

    Fractions count so, too, whatever their type.
    """
    limits = np.asarray(attributes.get(key, ()))
    scaling = [np.asarray(attributes[name]).dtype for name in ("scale_factor", "add_offset") if name in attributes]
    if dtype.kind not in "iu" or limits.dtype.kind != "f" or not limits.size or not scaling:
        return False
    return limits.dtype == np.result_type(*scaling) or bool((limits % 1 != 0).any())


def _packed(limit: float, slope: float, intercept: float) -> float:
    """Return the stored value of a data value, a whole number where rounding alone keeps it from being one."""
    stored = (limit - intercept) / slope
    return round(stored) if math.isfinite(stored) and abs(stored - round(stored)) < 1e-3 else stored


def _time(axes: Sequence[Axis], index: Sequence[Any]) -> tuple[float, str] | None:
    """Return the chosen coordinate along the axis of time, and its unit, None where there is none."""
    stated = ((a, k) for a, k in zip(axes, index, strict=True) if a.role == "t" and not isinstance(k, slice))
    return next(((float(a.centres[k]), a.units) for a, k in stated if a.centres is not None), None)


def _named(
    volume: Volume, attributes: Mapping[str, Any], dtype: np.dtype, time: tuple[float, str] | None, source: str
) -> Volume:
    """Return the volume with its time, and name, unit and labels that attributes give its values, as CF has them.

    Flags are labels if values are stored as integers (``dtype``) and no unit, no scale and no bits are stated.
    """
    long, standard, unit = (printable(text_of(attributes.get(key, ""))).strip()[:40] for key in NAMING[:3])
    unit = "" if unit in ("1", "none", "unitless", "dimensionless", "unknown", "~") else unit
    segments = None
    flags = {"flag_values", "flag_meanings"} <= attributes.keys() and "flag_masks" not in attributes
    if flags and dtype.kind in "iu" and not unit and _scaling(attributes, source) == (1, 0):
        segments = segments_in(lambda: _flags(attributes, stored_type(dtype, attributes)), source) or None
    return replace(volume, quantity=long or standard, value_unit=unit, time=time, segments=segments)


def _flags(attributes: Mapping[str, Any], dtype: np.dtype) -> list[Segment]:
    """Return the labels of CF's flags (3.5), words with _ for blanks, or of an enumeration, which are a list.

    There are none if limits of the values lie beyond the flags, which then mark special values of a quantity.
    """
    words, numbers = attributes["flag_meanings"], _marks(attributes, "flag_values", dtype)
    names = words if isinstance(words, list) else [word.replace("_", " ") for word in text_of(words).split()]
    segments = [Segment(int(number), name) for number, name in zip(numbers, names, strict=True)]
    limits = [limit for key in LIMITS for limit in _marks(attributes, key, dtype)]
    return segments if all(min(numbers) <= limit <= max(numbers) for limit in limits) else []


def flags_of(names: Mapping[str, int] | None) -> dict[str, Any]:
    """Return an enumeration's names and values as attributes; none where there is no enumeration."""
    return {"flag_values": list(names.values()), "flag_meanings": list(names)} if names else {}


def _placed(
    field: np.ndarray, axes: list[Axis], scaling: tuple[float, float], options: ReadOptions, source: str, name: str
) -> Volume:
    """Make the volume, with spacing and origin from the coordinates of its axes (z, y, x), made ascending."""
    flips = [_descends(a, source) for a in axes]
    if not isinstance(field, Stored):  # it turns its blocks itself
        field = contiguous(field[tuple(slice(None, None, -1 if flip else 1) for flip in flips)])
    axes = [
        replace(a, centres=a.centres[::-1]) if flip and a.centres is not None else a
        for a, flip in zip(axes, flips, strict=True)
    ]
    try:
        last = next((_unit(a) for a in reversed(axes) if a.size > 1), "")
        axes, unit = _one_unit(axes, source), unit_name(metres(last))
    except UsageError:
        if options.spacing is None:
            raise
        axes, unit = [replace(a, centres=None, step=0.0) for a in axes], ""
    centres = [a.centres for a in axes]
    if options.spacing is None and last not in _NO_LENGTHS and metres(last) is None:
        warnings.warn(f"{source}: unit {last!r} is not a known unit of length; numbers are kept", stacklevel=4)
    bare = [a.name or "unnamed" for a, c in zip(axes, centres, strict=True) if c is None and a.size > 1]
    if options.spacing is None and bare and any(c is not None and c.size > 1 for c in centres):
        warnings.warn(f"{source}: no coordinates along {', '.join(bare)}; its step is taken as 1", stacklevel=4)
    origin = tuple(0.0 if c is None else float(c[0]) for c in reversed(centres))
    if options.spacing or all(c is None or even(c) for c in centres):
        if options.dims is not None:
            why = "--spacing says where the values are" if options.spacing else "its axes are evenly spaced"
            raise UsageError(f"{source}: {why}; leave out --dims")
        steps = [a.step or 1.0 if c is None or c.size < 2 else float((c[-1] - c[0]) / (c.size - 1))
                 for a, c in zip(axes, centres, strict=True)]  # fmt: skip
        wide = next((s for s, a in zip(steps[::-1], axes[::-1], strict=True) if a.size > 1), 1.0)
        # a single slice is as thick as its pixels are wide
        steps = [wide if a.size == 1 and not a.step else s for s, a in zip(steps, axes, strict=True)]
        step = options.spacing or triple(steps[::-1])
        return Volume(field, step, origin, name=name, slope=scaling[0], intercept=scaling[1], unit=unit)
    if options.dims is None:
        uneven = [a for a, c in zip(axes, centres, strict=True) if c is not None and not even(c)]
        steps_text = ", ".join(_steps(a) for a in uneven)
        raise UsageError(
            f"{source}: {steps_text}; expected evenly spaced values: try --dims X Y Z to resample to a regular grid, "
            "or --spacing X Y Z to take the values as evenly spaced"
        )
    from vvgt_cli.volume.vtk.resample import resample

    points = [np.arange(a.size, dtype=float) if c is None else c for a, c in zip(axes, centres, strict=True)]
    data = (field * np.float64(scaling[0]) + scaling[1]).ravel()
    return replace(resample(points[::-1], data, options.dims, source, name), unit=unit)


def _left(
    stored: Callable[[tuple[Any, ...]], np.ndarray], dtype: np.dtype, axes: Sequence[Axis], index: list[Any],
    zyx: list[int], attributes: Mapping[str, Any], options: ReadOptions, source: str, name: str, chunks: Sequence[int],
) -> Volume:  # fmt: skip
    """Make the volume of an array that stays in its file; values that may be missing make every block floats.

    ``index`` chooses along the axes that are not of space; ``zyx`` are those that are.
    """
    if any(index[k] == slice(None) for k in range(len(axes)) if k not in zyx) or options.dims is not None:
        raise UsageError(f"{source}: block by block a magnitude or another grid cannot be read; choose one component")
    flips = [_descends(axes[k], source) for k in zyx]
    kind = stored_type(dtype, attributes)
    kind = float_dtype(kind) if any(key in attributes for key in MARKS) else kind
    inner = [sorted(zyx).index(k) for k in zyx]

    def read(slices: tuple[slice, ...]) -> np.ndarray:
        wanted = list(index)
        for k, part, flip in zip(zyx, slices, flips, strict=True):
            n = axes[k].size
            wanted[k] = slice(n - part.stop, n - part.start) if flip else slice(part.start, part.stop)
        values = decode(np.asarray(stored(tuple(wanted))), attributes, source)[0].astype(kind, copy=False)
        turned: np.ndarray = np.transpose(values, inner)
        return turned[tuple(slice(None, None, -1 if flip else 1) for flip in flips)]

    field: Any = Stored(read, kind, tuple(axes[k].size for k in zyx), [chunks[k] for k in zyx], source)
    volume = _placed(field, [axes[k] for k in zyx], _scaling(attributes, source), options, source, name)
    return _named(volume, attributes, dtype, _time(axes, index), source)


def _descends(a: Axis, source: str) -> bool:
    """Tell whether an axis runs downwards; raise DataError if it runs neither up nor down."""
    if a.centres is None or a.size < 2:
        return False
    steps = np.diff(a.centres)
    if not np.isfinite(a.centres).all() or not ((steps > 0).all() or (steps < 0).all()):
        raise DataError(f"{source}: coordinates of axis {a.name} neither ascend nor descend throughout; expected one")
    return bool(steps[0] < 0)


def even(centres: np.ndarray) -> bool:
    """Tell whether coordinates lie within `EVEN` steps of equal distances."""
    if centres.size < 3:
        return True
    line = np.linspace(centres[0], centres[-1], centres.size)
    return bool(np.abs(centres - line).max() <= EVEN * abs(centres[-1] - centres[0]) / (centres.size - 1))


def _steps(a: Axis) -> str:
    steps = np.abs(np.diff(a.centres if a.centres is not None else np.arange(2)))
    return f"axis {a.name or 'unnamed'} has steps from {steps.min():g} to {steps.max():g}"


def _one_unit(axes: Sequence[Axis], source: str) -> list[Axis]:
    """Return the axes with lengths in the unit of the last; raise UsageError if units do not compare."""
    units = [_unit(a) for a in axes if a.size > 1]
    base = metres(units[-1]) if units else None
    if len(set(units)) > 1 and not all(metres(u) for u in units):
        stated = ", ".join(f"{a.name or 'unnamed'} in {_unit(a) or 'no unit'}" for a in reversed(axes) if a.size > 1)
        raise UsageError(f"{source}: axes {stated}; expected one unit of length: try --spacing X Y Z")
    if base is None:
        return list(axes)
    factors = [(metres(_unit(a)) or base) / base for a in axes]
    return [
        replace(a, centres=None if a.centres is None else a.centres * factor, step=a.step * factor)
        for a, factor in zip(axes, factors, strict=True)
    ]


def _unit(a: Axis) -> str:
    """Return the unit of an axis by the name that all its spellings share."""
    unit = a.units.strip()
    return "degrees" if unit.lower().startswith("degree") else unit_name(metres(unit)) or unit.lower()
