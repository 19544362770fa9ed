"""The labels of a label map as a batch (`vvgt convert --split-labels`), whose clouds add up to the whole.

The whole map is converted as one scene, and each Gaussian is assigned to the label with most of it. Labels that others
hide are also converted alone, and their hidden Gaussians added; so are labels that their table switches off. Layers
(`--layer`) are converted one by one.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vvgt_cli.closed_form import VbmOptions
from vvgt_cli.conversion.batch import UNSAFE, Batch, Item
from vvgt_cli.conversion.fitting import fit, work_of
from vvgt_cli.conversion.index import LABELS
from vvgt_cli.conversion.label_assignment import assign_labels, hidden_cells
from vvgt_cli.conversion.opened import open_field
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import DataError, NothingVisible
from vvgt_cli.field.layered import IN_MEMORY, OpenedFile, content_of, is_plain, layers_of, open_content, told_apart
from vvgt_cli.field.open import automatic
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians import Gaussians, concatenate
from vvgt_cli.look import AUTO, NO_LABELS, NONE, Label, LabelTable, LightOptions, check_labels
from vvgt_cli.look.label_files import read_labels
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.volume import Volume
from vvgt_cli.volume.label_maps import extents_of
from vvgt_cli.volume.space import metres


@dataclass(frozen=True)
class LabelItem:
    """A label, or a layer without labels, and the request that would convert it alone."""

    name: str
    stem: str
    request: ConvertRequest
    facts: dict[str, Any]

    def text(self) -> str:
        """Return its name for a message."""
        return f"layer {self.name}"


@dataclass(frozen=True)
class MapLabel(LabelItem):
    """A label of a map."""

    volume: Volume
    table: LabelTable
    label: Label

    def text(self) -> str:
        """Return number and name for a message."""
        return f"label {self.label.number}, {self.label.name}"


class Labels(Batch):
    """The labels of a label map, without transparent ones, converted as a whole and divided; of layers, those of each.

    They have at most ``max_gaussians`` Gaussians together, of which each layer gets as many. Hidden labels get a share
    by the labels' surfaces (voxels to the power of 2/3), visible ones the rest.
    """

    kind = LABELS

    def __init__(self, request: ConvertRequest) -> None:
        """Start without labels; `prepare` finds them."""
        super().__init__(request, "")
        self._layers: list[tuple[ConvertRequest, list[LabelItem]]] = []

    def prepare(self, run: Run) -> None:
        """Read the map and its table, and those of the layers.

        Raise DataError as `convert`, or if no label is visible.
        """
        source = self.request.source
        with run.stage("volume") as stage:
            self.request = request = replace(self.request, blocks=self.request.blocks or automatic(source, run.console))
            sources = [replace(source, layers=()), *(replace(one, light=source.light) for one in source.layers)]
            budget = max(request.fit.max_gaussians // len(sources), 1)
            tables: list[str] = []
            firsts: list[Volume] = []
            used: set[tuple[float, float, float]] = set()
            names: list[str] = []
            for one in sources:
                own = replace(request, source=one, fit=replace(request.fit, max_gaussians=budget))
                content = _content(one, request.blocks is not None)
                firsts.append(content.volumes[0])
                check_lengths(firsts[0], firsts[-1])
                names.append(unused(content.volumes[0].name, names))
                self._layers.append((own, _parts(own, content, names[-1] if len(sources) > 1 else "", tables, used)))
                self.volume = self.volume or content.volumes[0].name
            self.facts = {"table": " + ".join(tables)}
            items = [part for _, parts in self._layers for part in parts]
            self.stems = [part.stem for part in items]
            stage.note = f"{self.volume}, {len(items)} labels of {self.facts['table']}"

    def items(self, run: Run, wanted: Callable[[str], bool]) -> Iterator[Item]:
        """Yield an item with its Gaussians for each label, and for each layer without labels."""
        names: list[str] = [part.name for _, parts in self._layers for part in parts]
        used: list[str] = []
        for request, parts in self._layers:
            for part, gaussians in zip(parts, _gaussians(request, parts, run), strict=True):
                if gaussians is None:
                    run.console.progress(f"skipped: {part.text()} (nothing of it is visible)")
                    continue
                run.console.progress(f"{part.text()}: {len(gaussians)} Gaussians")
                name = part.name if names.count(part.name) == 1 else part.stem
                used.append(unused(name, used))
                yield Item(used[-1], part.stem, part.request, part.facts, gaussians)


def unused(name: str, used: Sequence[str]) -> str:
    """Return a name that is not used yet, with a number from 2 on where it is."""
    return next(one for k in itertools.count(1) if (one := name if k == 1 else f"{name} {k}") not in used)


def check_lengths(first: Volume, other: Volume) -> None:
    """Raise DataError for a layer whose lengths are in another unit than the first volume's, or in an unknown one."""
    own, its = ("mm" if volume.space else volume.unit for volume in (first, other))
    if metres(own) != metres(its):
        raise DataError(
            f"{other.name}: its lengths are in {its or 'no stated unit'}, those of {first.name} in "
            f"{own or 'no stated unit'}; expected one unit: write files with places in mm, or convert them apart"
        )


def _content(source: SourceRequest, stored: bool) -> OpenedFile:
    """Return the content of the map's file, or the map itself."""
    read = replace(source.read, stored=True, packed=True) if stored else source.read
    return open_content(source.path, read) if isinstance(source.volume, str) else content_of(source.volume)


def _parts(
    request: ConvertRequest, content: OpenedFile, layer: str, tables: list[str], used: set[tuple[float, float, float]]
) -> list[LabelItem]:  # fmt: skip
    """Return the labels of a map, or a ``layer`` as a whole if it is none; add to ``tables`` and ``used`` colours.

    Raises:
        DataError: see `convert`; of a single map, no label is visible.
    """
    source = request.source
    labels = source.labels or (None if layer else AUTO)
    if not content.overlapping and (not content.single_volume or is_plain(content, source.tf, labels, (), IN_MEMORY)):
        name = layer or content.volumes[0].name
        whole = replace(source, volume=content) if request.blocks is None else source
        return [LabelItem(name, UNSAFE.sub("-", name), replace(request, source=whole), {})]
    read = read_labels(labels) if isinstance(labels, str) and labels not in (AUTO, NO_LABELS) else labels
    maps = layers_of(content, None, read, distance=source.unit_distance)
    maps = told_apart(maps, used) if layer else maps
    tables += [one.tf.name for one in maps]
    if not layer:
        check_labels([one.tf for one in maps])
    shown = []
    for whole_map in maps:
        volume, table, extents = whole_map.volume, whole_map.tf, extents_of(whole_map.volume)
        assert isinstance(table, LabelTable)
        table.warn_hidden(extents, volume.name, split=True)
        for label in table.labels:
            extent = extents.get(float(label.number))
            if label.shown_opacity > 0 and extent is not None:
                shown.append((volume, table, label, extent))
    numbers = [label.number for *_, label, _ in shown]
    items: list[LabelItem] = []
    divided = shares([extent.count for *_, extent in shown], request.fit.max_gaussians)
    for (volume, table, label, extent), share in zip(shown, divided, strict=True):
        alone = replace(_source(request, content, volume), labels=table.only(label.number))
        again = numbers.count(label.number) > 1  # of segments that overlap
        stem = f"{volume.name.rpartition(' ')[2]}-{label.stem}" if again else label.stem
        facts = label.facts() | extent.measures(volume)
        if layer:
            facts["parents"] = (layer, *label.parents)
        one = replace(request, source=alone, fit=replace(request.fit, max_gaussians=share))
        items.append(MapLabel(label.name, stem, one, facts, volume, table, label))
    return items


def _source(request: ConvertRequest, content: OpenedFile, volume: Volume) -> SourceRequest:
    """Return the source of one label map of the file, in memory or in blocks."""
    source = request.source
    if request.blocks is None:
        return replace(source, volume=volume)
    if len(content.volumes) == 1:
        return source
    number = next(k for k, other in enumerate(content.volumes) if other is volume)
    return replace(source, read=replace(source.read, component=number))


def _gaussians(request: ConvertRequest, parts: Sequence[LabelItem], run: Run) -> list[Gaussians | None]:
    """Return the Gaussians of each label, visible and hidden ones, box frame; None where there are none."""
    console = run.console
    labels = [part for part in parts if isinstance(part, MapLabel)]
    overlapping = len({id(label.volume) for label in labels}) > 1  # a Gaussian would mix their colours
    if len(labels) < 2 or overlapping or not any(label.label.opacity for label in labels):
        return [_alone(part, console) for part in parts]
    whole = replace(request, source=replace(labels[0].request.source, labels=labels[0].table))
    plain = replace(whole, source=replace(whole.source, light=LightOptions((NONE,))))
    with open_field(run, plain) as field, run.stage("hidden"):
        form = field.pyramid(VbmOptions(request.fit.max_gaussians, request.fit.screen)).form
        assert form is not None
        from vvgt_cli.closed_form.tree import HIDDEN

        hides = hidden_cells(form.seen.largest > HIDDEN, form.seen.edge, form.half, form.step)
    hidden: list[list[Gaussians]] = []
    for label in labels:
        hidden.append([])
        off = not label.label.opacity
        if not off and not hides.meet_label(label.volume, label.label.number):
            continue
        console.progress(f"{label.text()}: converting {'it alone: off' if off else 'what others hide of it'}")
        alone = _alone(label, console)
        if alone is not None:
            hidden[-1].append(alone if off else alone.take(hides.contain(alone)))
    console.message("all labels: converting what is visible")
    remaining = max(request.fit.max_gaussians - sum(len(one) for mine in hidden for one in mine), 1)
    seen = _fit(replace(whole, fit=replace(request.fit, max_gaussians=remaining)), console)
    on = [k for k, label in enumerate(labels) if label.label.opacity]
    owner = np.array(on)[assign_labels(seen, [(labels[k].volume, labels[k].table, labels[k].label) for k in on])]
    both = [concatenate([*mine, seen.take(owner == k)]) for k, mine in enumerate(hidden)]
    return [one if len(one) else None for one in both]


def _alone(part: LabelItem, console: Console) -> Gaussians | None:
    """Convert a label or layer as if it were the only one; return None where nothing is visible."""
    try:
        return _fit(part.request, console)
    except NothingVisible:
        return None


def _fit(request: ConvertRequest, console: Console) -> Gaussians:
    """Return the fitted Gaussians of a request, box frame; Ctrl-C ends the batch."""
    run = Run(console, ConversionReport("convert"))
    with open_field(run, request) as field:
        work = work_of(run, request, field)
        fit(work, request)
    if run.report.interrupted:
        raise KeyboardInterrupt
    return work.current()


def shares(voxels: Sequence[int], budget: int) -> list[int]:
    """Return the number of Gaussians of each label, at least one, and otherwise at most ``budget`` together."""
    weight = np.array(voxels, np.float64) ** (2 / 3)
    weight = np.maximum(weight / weight.sum(), 0.01)
    return [max(int(budget * share), 1) for share in weight / weight.sum()]
