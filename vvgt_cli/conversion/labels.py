"""`vvgt convert --split-labels`: one `.ply` a label of a label map, and an index; together they are the whole.

What some view sees of the whole is converted as one scene, and each Gaussian goes to the label that owns most of it;
what the whole hides is converted label by label, and of that the hidden Gaussians are added.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.conversion.convert import convert, fitted, opened
from vvgt_cli.conversion.functions import beside, named
from vvgt_cli.conversion.index import INDEX, LABELS, entry_of, index_of, index_output, write_index
from vvgt_cli.conversion.owners import hidden_in, owners
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import NothingVisible, UsageError
from vvgt_cli.field.layered import AUTO, NONE, Content, content_of, layers_of, open_parts
from vvgt_cli.field.open import automatic
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.outputs import check_outputs
from vvgt_cli.gaussians.types import together
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
class Part:
    """A label of a map: what makes its file."""

    volume: Volume
    table: LabelTable
    label: Label
    request: ConvertRequest
    stem: str  # in the place of a name

    def facts(self) -> dict[str, Any]:
        """What an index says of it."""
        return {"label": self.label.number, "color": self.label.color, "opacity": self.label.opacity}


@dataclass(frozen=True)
class Split:
    """A label map in its parts.

    Attributes:
        request: of the whole, in blocks where it is large.
        parts: the visible labels.
        volume, table: names.
    """

    request: ConvertRequest
    parts: Sequence[Part]
    volume: str
    table: str


def convert_labels(request: ConvertRequest, console: Console | None = None) -> dict[str, Any]:
    """Convert a label map as a whole, file every Gaussian under its label, add what is hidden, and write the index.

    The files hold at most ``max_gaussians`` together. What the whole hides gets its share by the labels' surfaces
    (voxels to the power of 2/3), the rest is for what is seen.

    Returns:
        The index, as its JSON has it.

    Raises:
        UsageError: outputs without a place for the name, a function or layers beside the labels, a size or time.
        DataError: as `convert`.
    """
    console = console or Console()
    named(request, INDEX, "label")  # its errors come before the volume
    index, inputs = index_output(str(request.output)), request.source.paths()
    check_outputs([index], inputs, request.overwrite)
    run = Run(console, ConversionReport("convert"))
    whole = split(run, request)
    outputs = [output for part in whole.parts for output in part.request.outputs()]
    check_outputs([*outputs, index], inputs, request.overwrite)
    rows = []
    for part, gaussians in shared_out(run, whole):
        console.say(f"label {part.label.number}, {part.label.name}: to {part.request.output}")
        report = convert(part.request, console, gaussians)
        row = entry_of(part.label.name, report, **part.facts())
        rows.append({**row, "file": beside(str(part.request.output), Path(index.path).parent)})
    found = index_of(LABELS, whole.volume, rows, table=whole.table)
    write_index(index.path, found, request.overwrite)
    console.say(f"{index.path}: {len(rows)} labels")
    return found


def split(run: Run, request: ConvertRequest) -> Split:
    """Read a label map: its visible labels, each with a request of its own.

    Raises:
        UsageError: a function or layers beside the labels, a size or time.
        DataError: as `convert`.
    """
    source = request.source
    if source.tf is not None or source.layers or source.labels == NONE:
        raise UsageError("--split-labels is of one label map: leave out --tf, --layer and --labels none")
    if request.limits.max_megabytes is not None:
        raise UsageError("--max-size is of one file; --split-labels makes several: give --max-gaussians for all")
    if request.limits.time_budget is not None:
        raise UsageError(
            "--time-budget is of one file; --split-labels fits several times: give --steps or leave it out"
        )
    with run.stage("volume") as stage:
        blocks = request.blocks or automatic(source, run.console)
        request = replace(request, blocks=blocks)
        content = _content(source, blocks is not None)
        maps = layers_of(content, None, source.labels or AUTO)
        check_labels([layer.tf for layer in maps])
        parts = _parts(request, content, maps)
        tables = " + ".join(layer.tf.name for layer in maps)
        stage.note = f"{maps[0].volume.name}, {len(parts)} labels of {tables}"
    return Split(request, parts, maps[0].volume.name, tables)


def shared_out(run: Run, whole: Split) -> Iterator[tuple[Part, Gaussians]]:
    """The Gaussians of each label, box frame; of one that shows nothing a line is said.

    Raises:
        DataError, UsageError: as `convert`.
    """
    for part, gaussians in zip(whole.parts, _gaussians(whole.request, whole.parts, run), strict=True):
        if gaussians is None:
            run.console.say(f"label {part.label.number}, {part.label.name}: nothing visible; it gets no file")
        else:
            yield part, gaussians


def _content(source: SourceRequest, stored: bool) -> Content:
    """What the map's file holds, or the map itself."""
    if not isinstance(source.volume, str):
        return content_of(source.volume)
    read = replace(source.read, stored=True, packed=True) if stored else source.read
    return open_parts(source.path, read)


def _parts(request: ConvertRequest, content: Content, maps: Sequence[Layer]) -> list[Part]:
    """The visible labels, each with a request of its own; the budget is that of its share."""
    shown = [
        (layer.volume, layer.tf, label)
        for layer in maps
        if isinstance(layer.tf, LabelTable)
        for label in layer.tf.labels
        if label.opacity > 0
    ]
    numbers = [label.number for *_, label in shown]
    parts = []
    for (volume, table, label), share in zip(shown, shares(shown, request.fit.max_gaussians), strict=True):
        source = replace(_source(request, content, volume), labels=table.only(label.number))
        alone = replace(request, source=source, fit=replace(request.fit, max_gaussians=share))
        again = numbers.count(label.number) > 1  # of segments that overlap
        name = f"{volume.name.rpartition(' ')[2]}-{file_name(label)}" if again else file_name(label)
        parts.append(Part(volume, table, label, named(alone, name, "label"), name))
    return parts


def _source(request: ConvertRequest, content: Content, volume: Volume) -> SourceRequest:
    """One label map of the file: as it was read, or in blocks where it is."""
    source = request.source
    if request.blocks is None:
        return replace(source, volume=volume)
    if len(content.volumes) == 1:
        return source
    number = next(k for k, other in enumerate(content.volumes) if other is volume)
    return replace(source, read=replace(source.read, component=number))


def _gaussians(request: ConvertRequest, parts: Sequence[Part], run: Run) -> list[Gaussians | None]:
    """Of every part, box frame: what the whole hides of it, and its share of the whole; None where nothing is seen."""
    console = run.console
    if len(parts) == 1 or len({id(part.volume) for part in parts}) > 1:
        return [_alone(part, console) for part in parts]  # of segments that overlap colours would mix in a Gaussian
    whole = replace(request, source=replace(parts[0].request.source, labels=parts[0].table))
    plain = replace(whole, source=replace(whole.source, light=LightOptions()))
    with opened(run, plain) as field, run.stage("hidden"):
        near, edge = field.hidden(request.fit.max_gaussians, request.fit.size)
        frame = field.source.volume.unit_frame()
        hides = hidden_in(near, edge, np.array(frame.half), np.array(frame.step))
    hidden: list[list[Gaussians]] = []
    for part in parts:
        hidden.append([])
        if not hides.any_of(part.volume, part.label.number):
            continue
        console.say(f"label {part.label.number}, {part.label.name}: what the others hide of it")
        alone = _alone(part, console)
        if alone is not None:
            hidden[-1].append(alone.take(hides.whether(alone)))
    console.say("all labels together: what is seen of them")
    left = max(request.fit.max_gaussians - sum(len(one) for mine in hidden for one in mine), 1)
    seen = _fitted(replace(whole, fit=replace(request.fit, max_gaussians=left)), console)
    owner = owners(seen, [(part.volume, part.table, part.label) for part in parts])
    both = [together([*mine, seen.take(owner == k)]) for k, mine in enumerate(hidden)]
    return [one if len(one) else None for one in both]


def _alone(part: Part, console: Console) -> Gaussians | None:
    """A label as though there were no other; None where nothing of it is seen."""
    try:
        return _fitted(part.request, console)
    except NothingVisible:
        return None


def _fitted(request: ConvertRequest, console: Console) -> Gaussians:
    """Gaussians of a request, box frame; Ctrl-C ends the whole."""
    run = Run(console, ConversionReport("convert"))
    found = fitted(run, request)
    if run.report.refinement and run.report.refinement["reason"] == "interrupted":
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
