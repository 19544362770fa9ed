"""The labels of a label map as a batch (`vvgt convert --split-labels`): together they are the whole.

What some view sees of the whole is converted as one scene, and each Gaussian goes to the label that owns most of it;
what the whole hides is converted label by label, and of that the hidden Gaussians are added.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.closed_form import VbmOptions
from vvgt_cli.conversion.batch import Batch, Item
from vvgt_cli.conversion.convert import fitted, opened
from vvgt_cli.conversion.index import LABELS
from vvgt_cli.conversion.label_assignment import assign_labels, hidden_in
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import NothingVisible
from vvgt_cli.field.layered import AUTO, Content, content_of, layers_of, open_content
from vvgt_cli.field.open import automatic
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.types import concatenate
from vvgt_cli.look.labels import Label, LabelTable, check_labels
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.volume import Volume
from vvgt_cli.volume.label_maps import counts_of

if TYPE_CHECKING:
    from vvgt_cli.dvr.layers import Layer

LONGEST = 80  # characters of a label's name in a file's


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

    Their Gaussians are at most ``max_gaussians`` together. Those that the whole hides get a share by the labels'
    surfaces (voxels to the power of 2/3), the rest is for what is seen.
    """

    kind = LABELS

    def __init__(self, request: ConvertRequest) -> None:
        super().__init__(request, "")
        self._labels: list[MapLabel] = []

    def prepare(self, run: Run) -> None:
        """Read the map and its table.

        Raises:
            DataError: as `convert`; no label is visible.
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
        """Yield an item with its Gaussians for each label of which something is visible."""
        names = [one.label.name for one in self._labels]
        for one, gaussians in zip(self._labels, _gaussians(self.request, self._labels, run), strict=True):
            if gaussians is None:
                run.console.say(f"{one.text()}: nothing visible; it is skipped")
                continue
            run.console.say(f"{one.text()}: {len(gaussians)} Gaussians")
            label = one.label
            facts = {"label": label.number, "color": label.color, "opacity": label.opacity}
            name = label.name if names.count(label.name) == 1 else one.stem
            yield Item(name, one.stem, one.request, facts, gaussians)


def _content(source: SourceRequest, stored: bool) -> Content:
    """What the map's file holds, or the map itself."""
    if not isinstance(source.volume, str):
        return content_of(source.volume)
    read = replace(source.read, stored=True, packed=True) if stored else source.read
    return open_content(source.path, read)


def _visible(request: ConvertRequest, content: Content, maps: Sequence[Layer]) -> list[MapLabel]:
    """Return the visible labels, each with a request of its own, whose budget is that of its share."""
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
    """One label map of the file: as it was read, or in blocks where it is."""
    source = request.source
    if request.blocks is None:
        return replace(source, volume=volume)
    if len(content.volumes) == 1:
        return source
    number = next(k for k, other in enumerate(content.volumes) if other is volume)
    return replace(source, read=replace(source.read, component=number))


def _gaussians(request: ConvertRequest, parts: Sequence[MapLabel], run: Run) -> list[Gaussians | None]:
    """Of every part, box frame: what the whole hides of it, and its share of the whole; None where nothing is seen."""
    console = run.console
    if len(parts) == 1 or len({id(part.volume) for part in parts}) > 1:
        return [_alone(part, console) for part in parts]  # of segments that overlap colours would mix in a Gaussian
    whole = replace(request, source=replace(parts[0].request.source, labels=parts[0].table))
    plain = replace(whole, source=replace(whole.source, light=LightOptions()))
    with opened(run, plain) as field, run.stage("hidden"):
        form = field.pyramid(VbmOptions(request.fit.max_gaussians, request.fit.size)).form
        assert form is not None
        from vvgt_cli.closed_form.tree import HIDDEN

        hides = hidden_in(form.seen.largest > HIDDEN, form.seen.edge, form.half, form.step)
    hidden: list[list[Gaussians]] = []
    for part in parts:
        hidden.append([])
        if not hides.any_of(part.volume, part.label.number):
            continue
        console.say(f"{part.text()}: what the others hide of it")
        alone = _alone(part, console)
        if alone is not None:
            hidden[-1].append(alone.take(hides.whether(alone)))
    console.say("all labels together: what is seen of them")
    left = max(request.fit.max_gaussians - sum(len(one) for mine in hidden for one in mine), 1)
    seen = _fitted(replace(whole, fit=replace(request.fit, max_gaussians=left)), console)
    owner = assign_labels(seen, [(part.volume, part.table, part.label) for part in parts])
    both = [concatenate([*mine, seen.take(owner == k)]) for k, mine in enumerate(hidden)]
    return [one if len(one) else None for one in both]


def _alone(part: MapLabel, console: Console) -> Gaussians | None:
    """A label as though there were no other; None where nothing of it is seen."""
    try:
        return _fitted(part.request, console)
    except NothingVisible:
        return None


def _fitted(request: ConvertRequest, console: Console) -> Gaussians:
    """Gaussians of a request, box frame; Ctrl-C ends the whole."""
    run = Run(console, ConversionReport("convert"))
    found = fitted(run, request)
    if run.report.interrupted:
        raise KeyboardInterrupt
    return found


def shares(shown: Sequence[tuple[Volume, LabelTable, Label]], budget: int) -> list[int]:
    """Gaussians of each label, at most ``budget`` in all but for one a label."""
    weight = np.array([max(count, 1) for count in _voxels(shown)], np.float64) ** (2 / 3)
    weight = np.maximum(weight / weight.sum(), 0.01)
    return [max(int(budget * share), 1) for share in weight / weight.sum()]


def _voxels(shown: Sequence[tuple[Volume, LabelTable, Label]]) -> list[int]:
    """Voxels of each label in its map; every map is counted once."""
    counts: dict[int, dict[float, int]] = {}
    for volume, *_ in shown:
        if id(volume) not in counts:
            counts[id(volume)] = counts_of(volume)
    return [counts[id(volume)].get(float(label.number), 0) for volume, _, label in shown]


def file_name(label: Label) -> str:
    """Its number, which no other has, and its name in plain characters."""
    return f"{label.number}-{re.sub(r'[^0-9A-Za-z]+', '-', label.name)[:LONGEST].strip('-')}".strip("-")
