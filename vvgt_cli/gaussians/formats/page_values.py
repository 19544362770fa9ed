"""The volume's values and labels on its page, on grids that `page/volume.mjs` decodes.

A grid is packed by gzip: its codes, each minus the one before it along x (modulo 2^bits), as planes of their low and,
with 16 bits, high bytes. Differences are stored as `(d << 1) ^ (d >> bits - 1)`, so that small ones are small numbers.
A value is ``lo + step * (code - missing)``, unknown where ``code < missing``; a label is number ``code - 1`` of a list.
"""

from __future__ import annotations

import gzip
import json
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from vvgt_cli.errors import NoLiveForm
from vvgt_cli.gaussians.formats.page_presets import offers
from vvgt_cli.gaussians.live_facts import LiveFacts
from vvgt_cli.look import LabelTable, Lighting, TransferFunction
from vvgt_cli.look.recognise import in_hounsfield
from vvgt_cli.look.resolve import unit_of_values
from vvgt_cli.volume import BINS, Statistics, Volume, edges_of
from vvgt_cli.volume.averaged import averaged, coarser, sampled

ELEMENT = "values"  # prefix of the ids of elements, followed by the number of the layer
MAX_CELLS = 1 << 24  # cells of all grids of a page: up to as many, all voxels
FEWEST = 1 << 15  # where there is less room, none
SMALLEST = FEWEST * 2 * 4 / 3 + 4096  # bytes that those take on a page at most
CLOSER = 0.95  # of the room: grids that did not fit are made for this share of it
LEVELS = 4096  # steps of the range of most values
MOST_VALUES = (0.1, 99.9)  # percentiles that bound most values
CODES = 1 << 16
OF_LABELS = Statistics(0, 0, 0, 0, np.zeros(BINS, np.int64), edges_of(0, 0))
EXACT = 1e-6  # steps by which rounding may move a mean of equal values


class PageLayer(NamedTuple):
    """A layer of a volume without colours of its own.

    Attributes:
        volume: scalars or a label map.
        look: function, or table of a label map.
        distance: world length that its opacity refers to.
        statistics: of the scalars; None: those of the grid.
        lighting: that they are shown with; None: none.
    """

    volume: Volume
    look: TransferFunction | LabelTable
    distance: float
    statistics: Statistics | None = None
    lighting: Lighting | None = None


class Values(NamedTuple):
    """The values of a page.

    Attributes:
        facts: of the grid of each layer shown.
        contents: of each, the packed codes.
        look: of all layers, which the page begins with; None where it cannot be changed there.
        limited: grids are coarser for want of room.
        offered: of each layer, what `page_presets.offers` returns.
    """

    facts: tuple[dict[str, Any], ...]
    contents: tuple[bytes, ...]
    look: LiveFacts | None = None
    limited: bool = False
    offered: tuple[dict[str, Any], ...] = ()

    @property
    def size(self) -> float:
        """Bytes on a page."""
        return len(json.dumps((self.facts, self.offered))) + sum(map(len, self.contents)) * 4 / 3

    @property
    def labels(self) -> int:
        """Count of labels that are named."""
        return sum(len(one.get("labels", ())) for one in self.facts)

    @property
    def elements(self) -> dict[str, bytes]:
        """Contents by the ids of their elements."""
        return {one["element"]: content for one, content in zip(self.facts, self.contents, strict=True)}

    def __str__(self) -> str:
        """Describe the grids for whoever sends the page."""
        grids = [" x ".join(map(str, one["dims"])) for one in self.facts]
        return (
            f"values of the volume ({', '.join(grids)} voxels{', coarser for --max-megabytes' if self.limited else ''})"
        )


def values_of(layers: Sequence[PageLayer | None], room: float | None = None, share: int = 1) -> Values | None:
    """Return the grids of layers, read part by part.

    Args:
        layers: None for one with colours, which has no grid; the look of none can be changed then.
        room: bytes that they may take on a page.
        share: number of volumes, such as frames, that a page's cells are shared among.

    Returns:
        None if no layer has a grid, or there is no room for `FEWEST` cells.
    """
    most = MAX_CELLS if share == 1 else max(MAX_CELLS // share, FEWEST)
    grids = _grids(layers, most)
    while grids is not None and room is not None and grids.size > room:
        if most <= FEWEST:
            return None
        cells = sum(math.prod(one["dims"]) for one in grids.facts)
        most = max(int(cells * min(CLOSER * max(room, 0) / grids.size, CLOSER)), FEWEST)
        grids = _grids(layers, most, limited=True)
    return grids


def _grids(layers: Sequence[PageLayer | None], most: int, limited: bool = False) -> Values | None:
    """Return the grids of layers, of at most so many cells together, as `values_of` does."""
    shown = [(number, layer) for number, layer in enumerate(layers) if layer is not None]
    facts, contents, looks, offered, shares = [], [], [], [], {}
    for n, (number, layer) in enumerate(sorted(shown, key=lambda one: one[1].volume.data.size)):
        shares[number] = most // (len(shown) - n)  # what small ones leave, large ones have
        most -= min(layer.volume.data.size, shares[number])
    for number, (volume, look, distance, statistics, lighting) in shown:
        dims = coarser(volume, shares[number])
        values = None if isinstance(look, LabelTable) else averaged(volume, dims)
        if isinstance(look, LabelTable):
            own, codes, known = *_labels(look, volume, dims), OF_LABELS
        else:
            assert values is not None
            own, codes, known = _values(volume, look, values)
        name = volume.name if len(layers) > 1 else ""
        with suppress(NoLiveForm):  # of too many labels
            one = LiveFacts.of(volume, statistics or known, look, len(layers))
            looks.append(replace(one, name=name, distance=distance))
            offered.append({} if values is None else offers(looks[-1], volume, values, lighting))
        stretch = np.array(volume.dims) / dims
        affine = volume.affine[:3] @ np.vstack([np.diag([*stretch, 1.0])[:3], [0, 0, 0, 1.0]])
        affine[:, 3] += volume.affine[:3, :3] @ ((stretch - 1) / 2)  # the middle of the first cell
        facts.append(
            {
                "layer": number, "title": name, "dims": list(dims), "bits": 8 * codes.itemsize,
                "affine": affine.ravel().tolist(), "cell": stretch.round(1).tolist(), "element": f"{ELEMENT}-{number}",
            } | own
        )  # fmt: skip
        contents.append(packed(codes))
    begun = replace(looks[0], others=tuple(looks[1:])) if len(looks) == len(layers) else None
    return Values(tuple(facts), tuple(contents), begun, limited, tuple(offered)) if facts else None


def _values(volume: Volume, tf: TransferFunction, values: np.ndarray) -> tuple[dict[str, Any], np.ndarray, Statistics]:
    """Return facts and codes (nz, ny, nx) of the means of values (nz, ny, nx), and their statistics."""
    known = values[np.isfinite(values)]
    lo, hi = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    edges = edges_of(lo, hi)
    wide = bool((np.diff(edges) > 0).all())  # or all values are one, but for rounding
    counts = np.histogram(known, edges)[0] if wide else np.zeros(BINS, np.int64)
    statistics = Statistics(lo, hi, 0, 0, counts, edges)
    a, b = map(float, np.percentile(known, MOST_VALUES)) if len(known) else (0.0, 0.0)
    missing = int(len(known) < values.size)
    step = max(((b - a) or (hi - lo)) / LEVELS, (hi - lo) / (CODES - 3)) or 1.0
    if volume.data.dtype.kind in "iub":  # whole steps between stored values, so that these are exact
        one = abs(volume.slope)
        step = one * max(math.ceil(step / one), 1) if step > one / 2 else one
        lo = volume.intercept + one * math.floor((lo - volume.intercept) / one + EXACT)
    codes = np.rint((np.nan_to_num(values, nan=lo - missing * step) - lo) / step) + missing
    unit = unit_of_values(volume.values_in, tf)
    around = not unit and lo < 0 < hi and 1 < hi - lo < 1e6  # as air's and tissue's are
    ct = unit == "HU" or (around and in_hounsfield(*np.histogram(known, 256)))
    facts = {
        "lo": lo, "step": step, "missing": missing, "level": (a + b) / 2, "window": (b - a) or step,
        "unit": unit, "ct": ct, "quantity": volume.quantity,
    }  # fmt: skip
    return facts, codes.astype(np.uint8 if codes.max(initial=0) < 256 else np.uint16), statistics


def _labels(
    table: LabelTable, volume: Volume, dims: tuple[int, int, int]
) -> tuple[dict[str, Any], np.ndarray]:  # fmt: skip
    """Return facts and codes (nz, ny, nx) of labels, as many as fit."""
    labels = table.structures[: CODES - 1]
    numbers = np.array([one.number for one in labels], np.float64)
    values = sampled(volume, dims)
    row = np.searchsorted(numbers, values).clip(max=len(numbers) - 1)
    codes = np.where(numbers[row] == values, row + 1, 0).astype(np.uint8 if len(labels) < 256 else np.uint16)
    return {"labels": [label.page_entry() for label in labels]}, codes


def packed(codes: np.ndarray) -> bytes:
    """Pack codes (nz, ny, nx) uint8 or uint16."""
    signed = np.dtype(f"i{codes.itemsize}")
    steps = np.diff(codes, axis=2, prepend=codes.dtype.type(0)).view(signed)
    folded = ((steps << 1) ^ (steps >> (8 * codes.itemsize - 1))).astype(signed.newbyteorder("<"))
    return gzip.compress(folded.view(np.uint8).reshape(-1, codes.itemsize).T.tobytes(), 6, mtime=0)
