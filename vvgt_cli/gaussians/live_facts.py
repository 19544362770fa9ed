"""Facts about the values that Gaussians carry, in comments of a file's header."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, NoLiveForm
from vvgt_cli.look import ColorMap, Label, LabelTable, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.readers.minimal import read
from vvgt_cli.look.resolve import unit_of_values
from vvgt_cli.look.to_json import to_text
from vvgt_cli.volume import BINS, Statistics, Volume, edges_of

COLUMNS = ("value", "spread", "length", "axis_x", "axis_y", "axis_z")
NXYZ, LABEL, LAYER = ("nx", "ny", "nz"), "label", "layer"
VALUES, LABEL_ROW, LAYER_ID = slice(0, 6), 9, 10  # columns of `Gaussians.live`
AXIS, GRADIENT = slice(3, 6), slice(6, 9)  # the same; the gradient is stored as the normal in a file
QUOTE = '"'  # begins a unit or quantity that is written as JSON
SAMPLED = 64  # nodes of a function that cannot be stored exactly
MAX_LABELS = 500  # that fit in a header
MAX_FUNCTION = 12_000  # characters: some loaders read only the first 10 KB of a header
WORD = "live"


@dataclass(frozen=True)
class LiveFacts:
    """Facts about the volume that the values come from, and about the file's own look.

    Attributes:
        lo, hi: range of the data values.
        dims: voxels along (x, y, z), which default unit distances depend on.
        histogram: (256,) counts over the range.
        unit: unit of the values, "" if unknown.
        function: minimal JSON of the function that the file's colours and opacities come from.
        labels: labels of a label map, indexed by the row that Gaussians carry; there is no function then.
        name: name of the volume, for one of several layers.
        distance: world length that the opacity refers to, for one of several layers.
        others: the layers or channels after the first.
        quantity: what the values are, "" if unknown.
    """

    lo: float
    hi: float
    dims: tuple[int, int, int]
    histogram: tuple[int, ...] = ()
    unit: str = ""
    function: str = ""
    labels: tuple[Label, ...] = ()
    name: str = ""
    distance: float | None = None
    others: tuple[LiveFacts, ...] = ()
    quantity: str = ""

    @property
    def layers(self) -> tuple[LiveFacts, ...]:
        """Each layer by itself; at least this one."""
        return (replace(self, others=()), *self.others)

    @property
    def grain(self) -> float:
        """Edge of a voxel, as by `grain_of`."""
        return grain_of(self.dims)

    @property
    def most_labels(self) -> int:
        """Number of labels of the layer with the most, 0 if all layers carry values."""
        return max(len(layer.labels) for layer in self.layers)

    @classmethod
    def of(
        cls, volume: Volume, stats: Statistics, look: TransferFunction | LabelTable, layer_count: int = 1
    ) -> LiveFacts:
        """Return the facts for a volume, its statistics and look; ``layer_count`` is the file's number of layers.

        Raise NoLiveForm for more than `MAX_LABELS` labels.
        """
        if isinstance(look, LabelTable):
            labels = look.structures or look.labels  # of a frame without labels, its background
            if len(labels) > MAX_LABELS:
                raise NoLiveForm(f"{volume.name}: {len(labels)} labels; a live form has at most {MAX_LABELS}")
            numbers = [float(label.number) for label in labels]
            return cls(min(numbers, default=0.0), max(numbers, default=0.0), volume.dims, labels=labels)
        counts = tuple(int(n) for n in stats.histogram)
        lo, hi = stats.lo, stats.hi
        unit, function = unit_of_values(volume.values_in, look), function_text(look, lo, hi, layer_count)
        return cls(lo, hi, volume.dims, counts, unit, function, quantity=volume.quantity)

    def statistics(self) -> Statistics:
        """Return the statistics that place functions on the data."""
        return Statistics(self.lo, self.hi, 0, 0, np.array(self.histogram, np.int64), edges_of(self.lo, self.hi))

    def baked(self) -> dict[str, Any]:
        """Return the file's function as parsed JSON, {} without one."""
        return dict(json.loads(self.function)) if self.function else {}

    def tf(self, name: str) -> TransferFunction:
        """Return the file's own function on data values; raise DataError if the file ``name`` has none."""
        if not self.function:
            raise DataError(f"{name}: no function in its header; expected one: pass --tf")
        return read(self.baked(), f"the function of {name}")

    def lines(self) -> list[str]:
        """Return the comment lines; `one_comment` parses them."""
        if self.others:
            return [line for layer in self.layers for line in (layer.title(), *layer.lines())]
        dims = " ".join(map(str, self.dims))
        named = (("unit", self.unit), ("quantity", self.quantity))
        texts = (
            (word, text if text.isascii() and text[0] != QUOTE else json.dumps(text)) for word, text in named if text
        )
        unit = [f"comment vvgt live {word} {text}" for word, text in texts]
        values = f"comment vvgt live values {self.lo!r} {self.hi!r} dims {dims}"
        if self.labels:
            return [values, *(f"comment vvgt live label {label.comment()}" for label in self.labels)]
        return [
            values,
            *unit,
            "comment vvgt live histogram " + " ".join(map(str, self.histogram)),
            "comment vvgt live function " + self.function,
        ]

    def shown_like(self, other: LiveFacts) -> bool:
        """Return whether another file can be shown alike: as many layers, of labels or of one range and function."""
        looks = [
            [bool(one.labels) or (one.lo, one.hi, one.function) for one in facts.layers] for facts in (self, other)
        ]
        return looks[0] == looks[1]

    def title(self) -> str:
        """Return the comment line that introduces one of several layers."""
        return f"comment vvgt live layer {self.distance!r} {json.dumps(self.name)}"


def grain_of(dims: tuple[int, int, int]) -> float:
    """Return the edge of a voxel, unit-frame length, as if the box were a cube."""
    return 2 / max(dims)


def function_text(tf: TransferFunction, lo: float, hi: float, layer_count: int = 1) -> str:
    """Return a function on data values as one line of minimal JSON, resampled to `SAMPLED` nodes if necessary.

    ``layer_count`` is the number of functions that must fit in a header.
    """
    try:
        text = json.dumps(json.loads(to_text(tf, "minimal")))
        if len(text) <= MAX_FUNCTION // layer_count:
            return text
    except DataError:
        pass
    x = np.linspace(lo, hi, SAMPLED) if hi > lo else np.array([lo])
    few = TransferFunction(tf.name, PiecewiseOpacity(x, tf.opacity(x).round(5)), ColorMap(x, tf.color(x).round(4)))
    return json.dumps(json.loads(to_text(few, "minimal")))


def one_comment(text: str) -> dict[str, Any]:
    """Return the facts of a comment, from the text after ``vvgt live``; raise ValueError or IndexError for others."""
    word, text = text.split(None, 1)
    words = text.split()
    if word == "values":
        lo, hi = float(words[0]), float(words[1])
        dims = tuple(int(size) for size in words[3:])
        if words[2] != "dims" or len(dims) != 3 or min(dims) < 1 or not -math.inf < lo <= hi < math.inf:
            raise ValueError(text)
        return {"lo": lo, "hi": hi, "dims": dims}
    if word == "layer":
        distance, name = text.split(None, 1)
        if not 0 < float(distance) < math.inf or not isinstance(name := json.loads(name), str):
            raise ValueError(text)
        return {"name": name, "distance": float(distance)}
    if word in ("unit", "quantity"):
        return {word: str(json.loads(text)) if text[:1] == QUOTE else text}
    if word == "histogram":
        counts = tuple(int(count) for count in words)
        if len(counts) != BINS or min(counts) < 0:
            raise ValueError(text)
        return {"histogram": counts}
    if word == "label":
        return {"labels": (Label.parse(text),)}
    if word == "function" and isinstance(json.loads(text), dict):
        return {"function": text}
    raise ValueError(text)


def live_facts(layers: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> LiveFacts | None:
    """Merge the facts of comments, one mapping per layer; None if some, or some of the file's columns, are missing."""
    whole = set(COLUMNS) <= set(columns) and all("lo" in one for one in layers)
    whole = whole and all(LABEL in columns if "labels" in one else "histogram" in one for one in layers)
    if not whole or (len(layers) > 1 and LAYER not in columns):
        return None
    first, *others = [LiveFacts(**one) for one in layers]
    return replace(first, others=tuple(others))
