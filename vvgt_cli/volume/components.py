"""Choice of an array and of a component; without a choice, an error that lists what there is."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np

from vvgt_cli.errors import DataError, SeveralArrays, SeveralComponents, UsageError
from vvgt_cli.volume.headers import printable

LISTED = 12  # arrays, images or channels that an error lists


def listed(items: Sequence[object], between: str = "; ", most: int = LISTED) -> str:
    """Join the first ``most`` items for a message, and say where there are more; "none" for none."""
    texts = [printable(str(item)) for item in items[:most]]
    return between.join(texts) + (f"{between}..." if len(items) > most else "") or "none"


def expected(asked: str, known: Collection[str], most: int = LISTED) -> str:
    """Return the end of a message about an unknown name: those of ``known`` that are like it, or else what there is."""
    near = [] if asked.isdecimal() else get_close_matches(asked, known)
    return f"did you mean {' or '.join(near)}?" if near else f"expected one of {listed([*known], ', ', most)}"


def choose(
    names: Sequence[str], rows: Sequence[str], wanted: str | None, source: str, what: str = "array",
    how: str = "choose one with --array NAME", option: str = "--array", note: str = "",
) -> int:  # fmt: skip
    """Return the index of the array (dataset, grid, ...) that is asked for, or of the only one.

    ``names`` are values of the ``option`` that chooses, ``rows`` describe them. ``what`` is the word for one, ``how``
    says how to choose, and ``note`` why none of several is taken without the option.

    Raises:
        DataError: there are none.
        SeveralArrays: several and none chosen.
        UsageError: none, or several, of the name.
    """
    fits = [k for k, name in enumerate(names) if wanted in (None, name)]
    if len(fits) == 1:
        return fits[0]
    many = what.removesuffix("s") + "s"
    if wanted is not None:
        number = f"{len(fits)} {many}" if fits else f"no {what}"
        raise UsageError(f"{source}: {number} {wanted!r}; it has {listed(rows)}; {how}")
    if not names:
        raise DataError(f"{source}: no {what} of numbers; expected a volume")
    choices = list(dict.fromkeys(names))  # a name may be that of point data and of cell data
    raise SeveralArrays(f"{source}: several {many}{note}: {listed(rows)}; {how}", option, choices)


@dataclass(frozen=True)
class ArrayInfo:
    """Description of an array in a file.

    Attributes:
        name: as the file has it (may be empty).
        where: ``point`` or ``cell``.
        components: numbers in each voxel.
        dtype: name of the type.
        active: the file marks it as its scalars.
    """

    name: str
    where: str
    components: int
    dtype: str
    active: bool = False

    def __str__(self) -> str:
        """Describe the array in a listing."""
        plural = "" if self.components == 1 else "s"
        name = printable(self.name) or "(unnamed)"
        return f"{name} ({self.where} data, {self.dtype}, {self.components} component{plural})"


def choose_array(infos: Sequence[ArrayInfo], wanted: str | None, source: str) -> int:
    """Return the index of the array to read: by name, else the active scalars, else the only one.

    Point data come before cell data.

    Raises:
        DataError: there are no arrays.
        UsageError: no array of that name, or several and none marked.
    """
    order = sorted(range(len(infos)), key=lambda index: infos[index].where == "cell")
    fits = (k for k in order if (infos[k].active if wanted is None else infos[k].name == wanted))
    if (first := next(fits, None)) is not None:
        if wanted is None and len(infos) > 1:
            others = ", ".join(printable(infos[k].name) for k in order if k != first)
            warnings.warn(
                f"{source}: array {printable(infos[first].name)}, its scalars; --array takes another: {others}",
                stacklevel=3,
            )
        return first
    names = [infos[k].name for k in order]
    note = " and none marked as scalars"
    return order[choose(names, [str(infos[k]) for k in order], wanted, source, note=note)]


def choose_component(
    n: int, dtype: np.dtype, wanted: int | str | None, what: str, names: Sequence[str] = (),
    colors: Sequence[tuple[float, float, float] | None] = (), color: bool = False, channels: bool = False,
) -> int | None:  # fmt: skip
    """Return the number of the component or channel asked for, or of the only one; None for the magnitude of all.

    ``what`` has ``n`` of a type, for messages. They may have names and ``colors``, RGB in [0, 1]. ``color``: three or
    four are red, green, blue and opacity; ``channels``: they are a microscope's, not samples or parts of vectors.

    Raises:
        SeveralComponents: several and none chosen.
        UsageError: none such.
    """
    names = [*names] if len(names) == n and any(names) else []
    if wanted == "magnitude" and n > 1:
        return None
    if isinstance(wanted, str) and names.count(wanted) == 1:
        return names.index(wanted)
    if wanted is None and n == 1:
        return 0
    if isinstance(wanted, int) and wanted < n:
        return wanted
    word = "channel" if channels else "component"
    shown = listed([f"{k} {name[:40]!r}" for k, name in enumerate(names)], ", ")
    text = f"{what} {n} {word}{'s' * (n > 1)}{f' ({shown})' if names else ''} of type {dtype.name}"
    if n == 1:
        raise UsageError(f"{text}; leave out --{word} {wanted}")
    others = ", a name" * bool(names) + ", all" * channels
    expected = f"expected one: try --{word} 0 to {n - 1}{others}, or --component magnitude"
    if wanted is not None:
        raise UsageError(f"{text}, not {word} {wanted!r}; {expected}")
    raise SeveralComponents(
        f"{text}; {expected}", n, color and n in (3, 4), colors if len(colors) == n else (), channels, names
    )


def select_component(
    values: np.ndarray,
    component: int | str | None,
    source: str,
    *,
    label: str = "",
    scaling: tuple[float, float] = (1.0, 0.0),
    color: bool = False,
) -> tuple[np.ndarray, tuple[float, float]]:
    """Select one scalar field of a field with components.

    Args:
        values: (nz, ny, nx, c) stored values.
        component: index, ``magnitude`` (Euclidean norm of the data values, float32) or None.
        source: for messages.
        label: what the values are called, for messages.
        scaling: (slope, intercept) of the stored values.
        color: the file says that three or four components are colours.

    Returns:
        (nz, ny, nx), C-contiguous (a view where that is possible), and the scaling that remains to be applied.

    Raises:
        UsageError: several components and no choice (`SeveralComponents`), or a choice that does not exist.
    """
    what = f"{source}: {label or 'its array'} has"
    number = choose_component(values.shape[3], values.dtype, component, what, color=color)
    if number is None:
        return magnitude(np.moveaxis(values, -1, 0), *scaling), (1.0, 0.0)
    return contiguous(values[..., number]), scaling


def select_from_array(values: np.ndarray, info: ArrayInfo, component: int | str | None, source: str) -> np.ndarray:
    """Select a scalar field (nz, ny, nx) of an array (nz, ny, nx, c) as `select_component`; bytes may be colours."""
    label, color = f"array {info.name!r}", values.dtype == np.uint8
    return select_component(values, component, source, label=label, color=color)[0]


def selected_dtype(info: ArrayInfo, component: int | str | None, source: str) -> np.dtype:
    """Return the type that `select_from_array` will return, before the array is read, with its errors."""
    return select_from_array(np.zeros((1, 1, 1, info.components), info.dtype), info, component, source).dtype


def channel_numbers(wanted: Sequence[str], count: int, names: Sequence[str], source: str) -> list[int]:
    """Return the numbers of the channels that are asked for, each once.

    ``wanted`` is what stands between the commas of ``A,B``: numbers, names, and pieces of names that have commas.

    Raises:
        UsageError: no channel of that name or number, or several of that name.
    """
    left, numbers = list(wanted), list[int]()
    while left:
        words = [",".join(left[:size]).strip() for size in range(len(left), 0, -1)]
        word = next((word for word in words if names.count(word) == 1), words[-1])
        if word.isdecimal() and int(word) < count:
            numbers.append(int(word))
        elif names.count(word) == 1:
            numbers.append(names.index(word))
        else:
            rows = [f"{k} {name[:40]!r}" for k, name in enumerate(names)] or [f"0 to {count - 1}"]
            raise UsageError(f"{source}: no channel {word!r}; it has {listed(rows, ', ')}")
        del left[: len(words) - words.index(word)]
    return list(dict.fromkeys(numbers))


def contiguous(field: np.ndarray) -> np.ndarray:
    """Return the field itself (mapped, perhaps), or a C-contiguous copy where it is not one."""
    return field if field.flags.c_contiguous else np.ascontiguousarray(field)


def magnitude(bands: Sequence[np.ndarray] | np.ndarray, slope: float = 1.0, intercept: float = 0.0) -> np.ndarray:
    """Return norms (nz, ny, nx) float32 of bands (nz, ny, nx) of values ``slope * stored + intercept``, by slices."""
    out = np.empty(bands[0].shape, np.float32)
    for z, row in enumerate(out):
        total = np.zeros(row.shape)
        for band in bands:
            total += (band[z].astype(np.float64) * slope + intercept) ** 2
        row[...] = np.sqrt(total)
    return out
