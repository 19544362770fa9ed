"""Choice of an array and of a component; without a choice, an error that lists what there is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vvgt_cli.errors import DataError, SeveralArrays, SeveralComponents, UsageError
from vvgt_cli.volume.headers import printable


@dataclass(frozen=True)
class ArrayInfo:
    """One array of a file.

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
        plural = "" if self.components == 1 else "s"
        name = printable(self.name) or "(unnamed)"
        return f"{name} ({self.where} data, {self.dtype}, {self.components} component{plural})"


def choose_array(infos: Sequence[ArrayInfo], wanted: str | None, source: str) -> int:
    """Index of the array to read: by name, else the active scalars, else the only one; point data before cell data.

    Raises:
        DataError: there are no arrays.
        UsageError: no array of that name, or several and none marked.
    """
    if not infos:
        raise DataError(f"{source}: the image has no numeric point or cell array; expected at least one")
    order = sorted(range(len(infos)), key=lambda index: infos[index].where == "cell")
    listing = "; ".join(str(infos[index]) for index in order)
    if wanted is not None:
        for index in order:
            if infos[index].name == wanted:
                return index
        raise UsageError(f"{source}: no array {wanted!r}; it has {listing}; choose one with --array NAME")
    for index in order:
        if infos[index].active:
            return index
    if len(infos) == 1:
        return 0
    text = f"{source}: several arrays and none marked as scalars: {listing}; choose one with --array NAME"
    raise SeveralArrays(text, "--array", list(dict.fromkeys(infos[index].name for index in order)))


def select_component(
    values: np.ndarray,
    component: int | str | None,
    source: str,
    *,
    label: str = "",
    scaling: tuple[float, float] = (1.0, 0.0),
    color: bool = False,
) -> tuple[np.ndarray, tuple[float, float]]:
    """One scalar field out of a field with components.

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
    n = values.shape[3]
    what = f"{source}: {label or 'its array'} has {n} component{'' if n == 1 else 's'} of type {values.dtype.name}"
    if n == 1:
        if component not in (None, 0):
            raise UsageError(f"{what}; leave out --component {component}")
        return contiguous(values[..., 0]), scaling
    if component is None or (component != "magnitude" and component not in range(n)):
        found = "" if component is None else f", not component {component}"
        text = f"{what}{found}; expected a scalar: try --component 0 to {n - 1}, or --component magnitude"
        raise SeveralComponents(text, n, color and n in (3, 4)) if component is None else UsageError(text)
    if component == "magnitude":
        return magnitude(values, *scaling), (1.0, 0.0)
    return contiguous(values[..., int(component)]), scaling


def contiguous(field: np.ndarray) -> np.ndarray:
    """The field itself (mapped, perhaps), or a C-contiguous copy where it is not one."""
    return field if field.flags.c_contiguous else np.ascontiguousarray(field)


def magnitude(values: np.ndarray, slope: float = 1.0, intercept: float = 0.0) -> np.ndarray:
    """Euclidean norm of ``slope * values + intercept`` over the last axis, slice by slice.

    Args:
        values: (nz, ny, nx, c).

    Returns:
        (nz, ny, nx) float32.
    """
    out = np.empty(values.shape[:3], np.float32)
    for z, plane in enumerate(values):
        total = np.zeros(plane.shape[:2])
        for c in range(plane.shape[2]):
            total += (plane[..., c].astype(np.float64) * slope + intercept) ** 2
        out[z] = np.sqrt(total)
    return out
