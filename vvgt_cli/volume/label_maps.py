"""Label maps: what labels a volume holds, and whether it is one by its type, its name and how few it has."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, Unsuitable
from vvgt_cli.volume.space import MILLIMETRE, metres
from vvgt_cli.volume.stats import count_integers, slabs
from vvgt_cli.volume.stored import planes
from vvgt_cli.volume.types import Volume

FEW = 512  # labels up to which a volume that is named so is taken for a label map
MASKS = 16  # the same of a volume that is called a mask: the grey values of a masked scan are more
NAMED = re.compile(r"label|seg(?![a-z])|segment|atlas|parc|aseg|mask(?!ed)", re.I)
MAX_LABELS = 1 << 21  # labels that are counted
SORTED = 1 << 16  # span of a plane's values above which they are sorted, not counted


def labels_in(volume: Volume) -> list[int]:
    """List a volume's labels, ascending, without NaN; errors are those of `whole_numbers`."""
    kind = volume.data.dtype
    if kind.kind in "iu" and kind.itemsize <= 2 and (volume.slope, volume.intercept) == (1, 0):
        counts, first = count_integers(volume)
        return [int(n) + first for n in np.flatnonzero(counts)]
    distinct = np.empty(0)
    for _, slab in slabs(volume):
        values = np.unique(slab)
        distinct = np.union1d(distinct, values[np.isfinite(values)].astype(np.float64))
        values = whole_numbers(distinct, volume)
    return list(map(int, values))


def whole_numbers(stored: np.ndarray, volume: Volume) -> np.ndarray:
    """Return the labels (m,), ascending, that ``stored`` values (n,) of a volume stand for.

    Raises:
        Unsuitable: fractions, more than `MAX_LABELS`, or integers that float64 does not tell apart.
    """
    values = np.unique(volume.slope * stored + volume.intercept)
    if volume.data.dtype.kind in "iu" and np.abs(values).max(initial=0) >= 2**53:
        raise Unsuitable(f"{volume.name}: labels of 2^53 or more, which would be merged; renumber them from 0")
    if len(values) > MAX_LABELS:
        raise Unsuitable(f"{volume.name}: more than {MAX_LABELS} different values; expected a label map")
    if (odd := values[values != np.round(values)]).size:
        raise Unsuitable(
            f"{volume.name}: {volume.data.dtype} values such as {odd[0]:g}; expected a label map, of whole numbers: of "
            "scalars leave out --labels"
        )
    return values


def named_so(volume: Volume) -> bool:
    """Tell whether a volume's file says that it is a label map, or its name suggests it."""
    return volume.segments is not None or NAMED.search(volume.name) is not None


def recognised(volume: Volume, labels: Callable[[Volume], list[int]] = labels_in) -> bool:
    """Tell whether a volume is a label map: its file says so, or its name and few different whole numbers do.

    ``labels`` lists the numbers.
    """
    if volume.segments is not None or not named_so(volume):
        return volume.segments is not None
    most = MASKS if {word.lower() for word in NAMED.findall(volume.name)} == {"mask"} else FEW
    middle = len(volume.data) // 2
    first = volume.slope * np.unique(volume.data[middle : middle + 1]) + volume.intercept  # one slice decides for most
    first = first[np.isfinite(first)]
    try:
        return len(first) <= most and bool((first == np.round(first)).all()) and len(labels(volume)) <= most
    except DataError:  # fractions elsewhere
        return False


@dataclass
class Extent:
    """The voxels of a label.

    Attributes:
        count: their number.
        total: (3,) float64, sum of their indices (x, y, z).
        first, last: (3,) smallest and largest index.
    """

    count: int
    total: np.ndarray
    first: np.ndarray
    last: np.ndarray

    def measures(self, volume: Volume) -> dict[str, Any]:
        """Return volume, centroid and bounds in the world of ``volume``.

        Keys name the unit: millilitres and mm, or none if the unit of the world is not known. Bounds are two corners
        of a box along the world's axes, around the label's box along the volume's own.
        """
        affine, metre = volume.affine, metres("mm" if volume.space else volume.unit)
        scale, ends = 1.0 if metre is None else metre / MILLIMETRE, ("", "") if metre is None else ("_ml", "_mm")
        steps, origin = scale * affine[:3, :3], scale * affine[:3, 3]
        corners = np.array(list(itertools.product(*zip(self.first - 0.5, self.last + 0.5, strict=True)))) @ steps.T
        size = self.count * abs(float(np.linalg.det(steps)))
        return {
            "voxels": self.count,
            f"volume{ends[0]}": size if metre is None else size / 1000,
            f"centroid{ends[1]}": (steps @ (self.total / self.count) + origin).tolist(),
            f"bounds{ends[1]}": [(corners.min(axis=0) + origin).tolist(), (corners.max(axis=0) + origin).tolist()],
        }


def extents_of(volume: Volume) -> dict[float, Extent]:
    """Return the voxels of each data value, slice by slice; voxels that are NaN have none."""
    extents: dict[float, Extent] = {}
    nx, ny, _ = volume.dims
    y, x = (index.ravel() for index in np.indices((ny, nx)))
    for z, plane in enumerate(planes(volume)):
        values, index = _numbered(plane)
        counts = np.bincount(index)
        sums = [np.bincount(index, along) for along in (x, y)]
        spans = [_spans(index, along, (len(values), size)) for along, size in ((x, nx), (y, ny))]
        for k in np.flatnonzero(np.isfinite(values)):
            value = float(volume.slope * float(values[k]) + volume.intercept)
            low, high = (np.array([spans[0][end][k], spans[1][end][k], z]) for end in (0, 1))
            total = np.array([sums[0][k], sums[1][k], z * counts[k]], np.float64)
            one = extents.get(value)
            if one is None:
                extents[value] = Extent(int(counts[k]), total, low, high)
                continue
            one.count, one.total = one.count + int(counts[k]), one.total + total
            one.first, one.last = np.minimum(one.first, low), np.maximum(one.last, high)
    return extents


def _numbered(plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the different values (n,) of a plane, ascending, and which of them each of its voxels has."""
    low = plane.min()
    if plane.dtype.kind not in "iu" or int(plane.max()) - int(low) > SORTED:
        values, index = np.unique(plane, return_inverse=True)
        return values, index.ravel()
    offset = plane.ravel().astype(np.int64) - int(low)
    there = np.bincount(offset) > 0
    return np.flatnonzero(there) + int(low), (np.cumsum(there) - 1)[offset]


def _spans(index: np.ndarray, along: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest position ``along`` an axis (n,) of each ``index`` (n,), of (many, size)."""
    there = np.zeros(shape, bool)
    there[index, along] = True
    return there.argmax(axis=1), shape[1] - 1 - there[:, ::-1].argmax(axis=1)
