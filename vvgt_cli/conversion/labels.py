"""The labels of a label map as a batch (`vvgt convert --split-labels`), whose clouds add up to the whole.

The whole map is converted as one scene, and each Gaussian is assigned to the label with most of it. Labels that others
hide are also converted alone, and their hidden Gaussians added.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.closed_form import VbmOptions
from vvgt_cli.conversion.batch import Batch, Item
from vvgt_cli.conversion.convert import fit_gaussians, open_field
from vvgt_cli.conversion.index import LABELS
from vvgt_cli.conversion.label_assignment import assign_labels, hidden_cells
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import NothingVisible
from vvgt_cli.field.layered import AUTO, Content, content_of, layers_of, open_content
from vvgt_cli.field.open import automatic
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.types import concatenate
from vvgt_cli.look.labels import Label, LabelTable, check_labels
from vvgt_cli.look.lighting import NONE, LightOptions
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.volume import Volume
from vvgt_cli.volume.label_maps import counts_of

if TYPE_CHECKING:
    from vvgt_cli.dvr.layers import Layer

LONGEST = 80  # characters of a label's name in a file name


@dataclass(frozen=True)
class MapLabel:
    """A visible label of a map, and the request that would convert it alone."""

    volume: Volume
    table: LabelTable
    label: Label
    request: ConvertRequest
    stem: str

    def text(self) -> str:
        """Return number and name for a message."""
        return f"label {self.label.number}, {self.label.name}"


class Labels(Batch):
    """The visible labels of a label map, converted as a whole and divided.

    They have at most ``max_gaussians`` Gaussians together. Hidden ones get a share by the labels' surfaces
    (voxels to the power of 2/3), visible ones the rest.
    """

    kind = LABELS

    def __init__(self, request: ConvertRequest) -> None:
        """Start without labels; `prepare` finds them."""
        super().__init__(request, "")
        self._labels: list[MapLabel] = []

    def prepare(self, run: Run) -> None:
        """Read the map and its table.

        Raises:
            DataError: see `convert`; no label is visible.
        """
        source = self.request.source
        with run.stage("volume") as stage:
            self.request = request = replace(self.request, blocks=self.request.blocks or automatic(source, run.console))
            content = _content(source, request.blocks is not None)
            maps = layers_of(content, None, source.labels or AUTO)
            check_labels([layer.tf for layer in maps])
            self._labels = _visible(request, content, maps)
            self.volume, self.facts = maps[0].volume.name, {"table": " + ".join(layer.tf.name for layer in maps)}
            self.stems = [one.stem for one in self._labels]
            stage.note = f"{self.volume}, {len(self._labels)} labels of {self.facts['table']}"

    def items(self, run: Run, wanted: Callable[[str], bool]) -> Iterator[Item]:
        """Yield an item with its Gaussians for each label that is visible."""
        names = [one.label.name for one in self._labels]
        for one, gaussians in zip(self._labels, _gaussians(self.request, self._labels, run), strict=True):
            if gaussians is None:
                run.console.message(f"skipped: {one.text()} (nothing of it is visible)")
                continue
            run.console.message(f"{one.text()}: {len(gaussians)} Gaussians")
            label = one.label
            facts = {"label": label.number, "color": label.color, "opacity": label.opacity}
            name = label.name if names.count(label.name) == 1 else one.stem
            yield Item(name, one.stem, one.request, facts, gaussians)


def _content(source: SourceRequest, stored: bool) -> Content:
    """Return the content of the map's file, or the map itself."""
    if not isinstance(source.volume, str):
        return content_of(source.volume)
    read = replace(source.read, stored=True, packed=True) if stored else source.read
    return open_content(source.path, read)


def _visible(request: ConvertRequest, content: Content, maps: Sequence[Layer]) -> list[MapLabel]:
    """Return the visible labels, each with its own request and its share of the budget."""
    shown = [
        (layer.volume, layer.tf, label)
        for layer in maps
        if isinstance(layer.tf, LabelTable)
        for label in layer.tf.labels
        if label.opacity > 0
    ]
    numbers = [label.number for *_, label in shown]
    found = []
    for (volume, table, label), share in zip(shown, shares(shown, request.fit.max_gaussians), strict=True):
        source = replace(_source(request, content, volume), labels=table.only(label.number))
        alone = replace(request, source=source, fit=replace(request.fit, max_gaussians=share))
        again = numbers.count(label.number) > 1  # of segments that overlap
        stem = f"{volume.name.rpartition(' ')[2]}-{file_name(label)}" if again else file_name(label)
        found.append(MapLabel(volume, table, label, alone, stem))
    return found


def _source(request: ConvertRequest, content: Content, volume: Volume) -> SourceRequest:
    """Return the source of one label map of the file, in memory or in blocks."""
    source = request.source
    if request.blocks is None:
        return replace(source, volume=volume)
    if len(content.volumes) == 1:
        return source
    number = next(k for k, other in enumerate(content.volumes) if other is volume)
    return replace(source, read=replace(source.read, component=number))


def _gaussians(request: ConvertRequest, labels: Sequence[MapLabel], run: Run) -> list[Gaussians | None]:
    """Return the Gaussians of each label, visible and hidden ones, box frame; None where there are none."""
    console = run.console
    if len(labels) == 1 or len({id(label.volume) for label in labels}) > 1:
        return [_alone(label, console) for label in labels]  # a Gaussian would mix colours of overlapping segments
    whole = replace(request, source=replace(labels[0].request.source, labels=labels[0].table))
    plain = replace(whole, source=replace(whole.source, light=LightOptions((NONE,))))
    with open_field(run, plain) as field, run.stage("hidden"):
        form = field.pyramid(VbmOptions(request.fit.max_gaussians, request.fit.size)).form
        assert form is not None
        from vvgt_cli.closed_form.tree import HIDDEN

        hides = hidden_cells(form.seen.largest > HIDDEN, form.seen.edge, form.half, form.step)
    hidden: list[list[Gaussians]] = []
    for label in labels:
        hidden.append([])
        if not hides.meet_label(label.volume, label.label.number):
            continue
        console.message(f"{label.text()}: converting what others hide of it")
        alone = _alone(label, console)
        if alone is not None:
            hidden[-1].append(alone.take(hides.contain(alone)))
    console.message("all labels: converting what is visible")
    remaining = max(request.fit.max_gaussians - sum(len(one) for mine in hidden for one in mine), 1)
    seen = _fit(replace(whole, fit=replace(request.fit, max_gaussians=remaining)), console)
    owner = assign_labels(seen, [(label.volume, label.table, label.label) for label in labels])
    both = [concatenate([*mine, seen.take(owner == k)]) for k, mine in enumerate(hidden)]
    return [one if len(one) else None for one in both]


def _alone(label: MapLabel, console: Console) -> Gaussians | None:
    """Convert a label as if it were the only one; return None where nothing is visible."""
    try:
        return _fit(label.request, console)
    except NothingVisible:
        return None


def _fit(request: ConvertRequest, console: Console) -> Gaussians:
    """Return the fitted Gaussians of a request, box frame; Ctrl-C ends the batch."""
    run = Run(console, ConversionReport("convert"))
    found = fit_gaussians(run, request)
    if run.report.interrupted:
        raise KeyboardInterrupt
    return found


def shares(shown: Sequence[tuple[Volume, LabelTable, Label]], budget: int) -> list[int]:
    """Return the number of Gaussians of each label, at least one, and otherwise at most ``budget`` together."""
    weight = np.array([max(count, 1) for count in _voxels(shown)], np.float64) ** (2 / 3)
    weight = np.maximum(weight / weight.sum(), 0.01)
    return [max(int(budget * share), 1) for share in weight / weight.sum()]


def _voxels(shown: Sequence[tuple[Volume, LabelTable, Label]]) -> list[int]:
    """Return the number of voxels of each label; every map is counted once."""
    counts: dict[int, dict[float, int]] = {}
    for volume, *_ in shown:
        if id(volume) not in counts:
            counts[id(volume)] = counts_of(volume)
    return [counts[id(volume)].get(float(label.number), 0) for volume, _, label in shown]


def file_name(label: Label) -> str:
    """Return the unique number of a label and its name in plain characters."""
    return f"{label.number}-{re.sub(r'[^0-9A-Za-z]+', '-', label.name)[:LONGEST].strip('-')}".strip("-")
