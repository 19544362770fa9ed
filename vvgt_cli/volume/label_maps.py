"""Label maps: what labels a volume holds, and whether it is one by its type, its name and how few it has."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.stats import count_integers, slabs
from vvgt_cli.volume.stored import planes
from vvgt_cli.volume.types import Volume

FEW = 512  # labels up to which a volume that is named so is taken for a label map
NAMED = re.compile(r"label|seg(?![a-z])|segment|atlas|parc|aseg", re.I)
MOST = 1 << 21  # labels that are counted


def labels_in(volume: Volume) -> list[int]:
    """List the labels of a volume, ascending; voxels that are NaN have none.

    Raises:
        DataError: data values that are no whole numbers, or more than `MOST` of them.
    """
    kind = volume.data.dtype
    if kind.kind in "iu" and kind.itemsize <= 2 and (volume.slope, volume.intercept) == (1, 0):
        counts, first = count_integers(volume)
        return [int(n) + first for n in np.flatnonzero(counts)]
    found = np.empty(0)
    for _, slab in slabs(volume):
        values = np.unique(slab)
        values = volume.slope * values[np.isfinite(values)].astype(np.float64) + volume.intercept
        if (values != np.round(values)).any():
            odd = values[values != np.round(values)][0]
            raise DataError(
                f"{volume.name}: {slab.dtype} values such as {odd:g}; expected a label map, of whole numbers: of "
                "scalars leave out --labels"
            )
        found = np.union1d(found, values)
        if len(found) > MOST:
            raise DataError(f"{volume.name}: more than {MOST} different values; expected a label map")
    return [int(value) for value in found]


def named_so(volume: Volume) -> bool:
    """Tell whether a volume holds integers and its name suggests a label map."""
    return volume.data.dtype.kind in "iu" and NAMED.search(volume.name) is not None


def recognised(volume: Volume, labels: Callable[[Volume], list[int]] = labels_in) -> bool:
    """Tell whether a volume is a label map: few different integers, and a name that says so; ``labels`` lists them."""
    if not named_so(volume):
        return False
    middle = len(volume.data) // 2
    first = np.unique(volume.data[middle : middle + 1])  # one slice decides for most
    return len(first) <= FEW and len(labels(volume)) <= FEW


def counts_of(volume: Volume) -> dict[float, int]:
    """Count the voxels of each data value, slice by slice."""
    found: dict[float, int] = {}
    for plane in planes(volume):
        values, many = np.unique(plane, return_counts=True)
        for value, n in zip(volume.slope * values.astype(np.float64) + volume.intercept, many, strict=True):
            found[float(value)] = found.get(float(value), 0) + int(n)
    return found
