"""The labels of a label map as a batch (`vvgt convert --split-labels`), whose clouds add up to the whole.

The whole map is converted as one scene, and each Gaussian is assigned to the label with most of it. Labels that others
hide are also converted alone, and their hidden Gaussians added; so are labels that their table switches off. Layers
(`--layer`) are converted one by one.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vvgt_cli.closed_form import VbmOptions
from vvgt_cli.conversion.batch import UNSAFE, Batch, Item
from vvgt_cli.conversion.changes import around
from vvgt_cli.conversion.fitting import fit, work_of
from vvgt_cli.conversion.index import LABELS
from vvgt_cli.conversion.opened import open_field
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import DataError, NothingVisible
from vvgt_cli.field.layered import OpenedFile, layers_of, told_apart
from vvgt_cli.field.open import automatic
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians import Gaussians, concatenate
from vvgt_cli.gaussians.frames import axes_of
from vvgt_cli.look import AUTO, NO_LABELS, NONE, Label, LabelTable, LightOptions, check_labels
from vvgt_cli.look.label_files import read_labels
from vvgt_cli.look.tables import extinction
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.volume import Volume
from vvgt_cli.volume.label_maps import extents_of, recognised
from vvgt_cli.volume.space import metres
from vvgt_cli.volume.stored import planes, values_at

MapLabel = tuple[Volume, LabelTable, Label]  # a label, and its map and table
Part = tuple[Item, MapLabel | None]  # a label and the request that would convert it alone; or a layer without labels
DARKENED = 0.1  # difference of colours that counts as much as a label's colour taken for black
OFFSETS = (-2.0, -1.0, 0.0, 1.0, 2.0)  # standard deviations along each axis at which labels are sampled
REACH = (1, 2, 4)  # voxels from a Gaussian in no label, within which labels are near


def text_of(part: Part) -> str:
    """Return the name of a layer, or number and name of a label, for a message."""
    item, label = part
    return f"layer {item.name}" if label is None else f"label {label[2].number}, {label[2].name}"


class Labels(Batch):
    """The labels of a label map, without transparent ones, converted as a whole and divided; of layers, those of each.

    They have at most ``max_gaussians`` Gaussians together, shared evenly among the layers. Hidden labels get a share by
    the labels' surfaces (voxels to the power of 2/3), visible ones the rest.
    """

    kind = LABELS

    def __init__(self, request: ConvertRequest) -> None:
        """Start without labels; `prepare` finds them."""
        super().__init__(request, "")
        self._layers: list[tuple[ConvertRequest, list[Part]]] = []

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
                content = one.content(stored=request.blocks is not None)
                firsts.append(content.volumes[0])
                check_lengths(firsts[0], firsts[-1])
                names.append(unused(content.volumes[0].name, names))
                self._layers.append((own, _parts(own, content, names[-1] if len(sources) > 1 else "", tables, used)))
                self.volume = self.volume or content.volumes[0].name
            self.facts = {"table": " + ".join(tables)}
            self.stems = [item.stem for _, parts in self._layers for item, _ in parts]
            stage.note = f"{self.volume}, {len(self.stems)} labels of {self.facts['table']}"

    def items(self, run: Run, wanted: Callable[[str], bool]) -> Iterator[Item]:
        """Yield an item with its Gaussians for each label, and for each layer without labels."""
        names: list[str] = [item.name for _, parts in self._layers for item, _ in parts]
        used: list[str] = []
        for request, parts in self._layers:
            for part, gaussians in zip(parts, _gaussians(request, parts, run), strict=True):
                if gaussians is None:
                    run.console.progress(f"skipped: {text_of(part)} (nothing of it is visible)")
                    continue
                run.console.progress(f"{text_of(part)}: {len(gaussians)} Gaussians")
                item = part[0]
                used.append(unused(item.name if names.count(item.name) == 1 else item.stem, used))
                yield replace(item, name=used[-1], gaussians=gaussians)


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


def _parts(
    request: ConvertRequest, content: OpenedFile, layer: str, tables: list[str], used: set[tuple[float, float, float]]
) -> list[Part]:  # fmt: skip
    """Return the labels of a map, or a ``layer`` as a whole if it is none; add to ``tables`` and ``used`` colours.

    Raises:
        DataError: see `convert`; of a single map, no label is visible.
    """
    source = request.source
    labels = source.labels or (None if layer else AUTO)
    plain = labels == NO_LABELS or not content.single_volume or (labels is None and source.tf is not None)
    if not content.overlapping and (plain or (labels is None and not recognised(content.volumes[0]))):
        name = layer or content.volumes[0].name
        whole = replace(source, volume=content) if request.blocks is None else source
        return [(Item(name, UNSAFE.sub("-", name), replace(request, source=whole)), None)]
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
    parts: list[Part] = []
    divided = shares([extent.count for *_, extent in shown], request.fit.max_gaussians)
    for (volume, table, label, extent), share in zip(shown, divided, strict=True):
        alone = replace(_source(request, content, volume), labels=table.only(label.number))
        again = numbers.count(label.number) > 1  # of segments that overlap
        stem = f"{volume.name.rpartition(' ')[2]}-{label.stem}" if again else label.stem
        facts = label.facts() | extent.measures(volume)
        if layer:
            facts["parents"] = (layer, *label.parents)
        one = replace(request, source=alone, fit=replace(request.fit, max_gaussians=share))
        parts.append((Item(label.name, stem, one, facts), (volume, table, label)))
    return parts


def _source(request: ConvertRequest, content: OpenedFile, volume: Volume) -> SourceRequest:
    """Return the source of one label map of the file, in memory or in blocks."""
    source = request.source
    if request.blocks is None:
        return replace(source, volume=volume)
    if len(content.volumes) == 1:
        return source
    number = next(k for k, other in enumerate(content.volumes) if other is volume)
    return replace(source, read=replace(source.read, component=number))


def _gaussians(request: ConvertRequest, parts: Sequence[Part], run: Run) -> list[Gaussians | None]:
    """Return the Gaussians of each label, visible and hidden ones, box frame; None where there are none."""
    console = run.console
    labels = [label for _, label in parts if label is not None]
    overlapping = len({id(volume) for volume, *_ in labels}) > 1  # a Gaussian would mix their colours
    if len(labels) < 2 or overlapping or not any(label.opacity for *_, label in labels):
        return [_alone(item.request, console) for item, _ in parts]
    whole = replace(request, source=replace(parts[0][0].request.source, labels=labels[0][1]))
    plain = replace(whole, source=replace(whole.source, light=LightOptions((NONE,))))
    with open_field(run, plain) as field, run.stage("hidden"):
        form = field.pyramid(VbmOptions(request.fit.max_gaussians, request.fit.screen)).form
        assert form is not None
        from vvgt_cli.closed_form.tree import HIDDEN

        unseen = ~around(form.seen.largest > HIDDEN, np.maximum)
        hides = HiddenCells(unseen, form.seen.edge, form.half, form.step)
    hidden: list[list[Gaussians]] = []
    for part, (volume, _, label) in zip(parts, labels, strict=True):
        hidden.append([])
        off = not label.opacity
        if not off and not hides.meet_label(volume, label.number):
            continue
        console.progress(f"{text_of(part)}: converting {'it alone: off' if off else 'what others hide of it'}")
        alone = _alone(part[0].request, console)
        if alone is not None:
            hidden[-1].append(alone if off else alone.take(hides.contain(alone)))
    console.message("all labels: converting what is visible")
    remaining = max(request.fit.max_gaussians - sum(len(one) for mine in hidden for one in mine), 1)
    seen = _fit(replace(whole, fit=replace(request.fit, max_gaussians=remaining)), console)
    on = [k for k, (*_, label) in enumerate(labels) if label.opacity]
    owner = np.array(on)[assign_labels(seen, [labels[k] for k in on])]
    both = [concatenate([*mine, seen.take(owner == k)]) for k, mine in enumerate(hidden)]
    return [one if len(one) else None for one in both]


def _alone(request: ConvertRequest, console: Console) -> Gaussians | None:
    """Convert a label or layer as if it were the only one; return None where nothing is visible."""
    try:
        return _fit(request, console)
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


@dataclass(frozen=True)
class HiddenCells:
    """Cells that no view sees, nor any of their neighbours.

    Attributes:
        cells: (nz, ny, nx) bool.
        edge: (3,) edges (x, y, z) of a cell in voxels.
        half, step: (3,) half extents and voxel edges of the scene, unit frame.
    """

    cells: np.ndarray
    edge: np.ndarray
    half: np.ndarray
    step: np.ndarray

    def contain(self, gaussians: Gaussians) -> np.ndarray:
        """Return (K,) bool, whether the centre of each Gaussian is hidden."""
        voxels = (gaussians.means.astype(np.float64) + self.half) / self.step
        i, j, k = (self._along(axis, voxels[:, axis]) for axis in range(3))
        return self.cells[k, j, i]

    def meet_label(self, volume: Volume, number: int) -> bool:
        """Return whether part of a label's surface, where it meets other labels or the box, is hidden."""
        middles = [np.arange(n) + 0.5 for n in volume.dims]
        x, y, z = (self._along(axis, middles[axis]) for axis in range(3))
        none = np.zeros(volume.data.shape[1:], bool)
        stored = (volume.slope * plane.astype(np.float64) + volume.intercept == number for plane in planes(volume))
        before, here = none, next(stored)
        for k in range(len(volume.data)):
            after = next(stored, none)
            inside = here & before & after
            inside[1:] &= here[:-1]
            inside[:-1] &= here[1:]
            inside[:, 1:] &= here[:, :-1]
            inside[:, :-1] &= here[:, 1:]
            inside[[0, -1]] = inside[:, [0, -1]] = False
            if (here & ~inside & self.cells[z[k]][y][:, x]).any():
                return True
            before, here = here, after
        return False

    def _along(self, axis: int, voxels: np.ndarray) -> np.ndarray:
        """Return (n,) int64, the cell along an axis of positions in voxels from the box's corner."""
        n = self.cells.shape[2 - axis]
        return np.clip(np.floor(voxels / self.edge[axis]), 0, n - 1).astype(np.int64)


def assign_labels(gaussians: Gaussians, shown: Sequence[tuple[Volume, LabelTable, Label]]) -> np.ndarray:
    """Return (K,) int64, the index of the label with most of each Gaussian's extinction, else a near one, by colour.

    Args:
        gaussians: box frame.
        shown: labels with their maps and tables; all maps are on one grid.
    """
    frame = shown[0][0].unit_frame()
    votes = np.zeros((len(gaussians), len(shown)), np.float32)
    tau = extinction(np.array([label.opacity for *_, label in shown]), 1.0)
    axes = axes_of(gaussians)
    for axis in range(3):
        for offset in OFFSETS:
            points = gaussians.means + offset * axes[:, :, axis]
            index = np.floor((points + frame.half) / frame.step).astype(np.int64)
            _vote(index, np.exp(-0.5 * offset**2) * tau, shown, votes)
    labels: np.ndarray = votes.argmax(axis=1)
    lost = np.flatnonzero(votes.max(axis=1) == 0)
    near = _near(np.floor((gaussians.means[lost] + frame.half) / frame.step).astype(np.int64), tau, shown)
    colors = np.array([label.color for *_, label in shown])
    for k, candidates in zip(lost, near, strict=True):
        own = gaussians.colors[k]
        share = np.clip(colors @ own / np.maximum((colors**2).sum(axis=1), 1e-6), 0, 1)  # light darkens
        distance = np.abs(share[:, None] * colors - own).sum(axis=1) + DARKENED * (1 - share)
        labels[k] = np.where(candidates, distance, np.inf).argmin()
    return labels


def _near(index: np.ndarray, weights: np.ndarray, shown: Sequence[tuple[Volume, LabelTable, Label]]) -> np.ndarray:
    """Return (K, labels) bool, the labels near voxels ``index`` (K, 3) (x, y, z); all where none is within `REACH`."""
    nearby = np.zeros((len(index), len(shown)), np.float32)
    for reach in REACH:
        rows = np.flatnonzero(nearby.max(axis=1) == 0)
        votes = np.zeros((len(rows), len(shown)), np.float32)
        shifts = np.array(list(itertools.product((-reach, 0, reach), repeat=3)))
        around = (index[rows][:, None] + shifts).reshape(-1, 3)  # in one pass over a map that stays in its file
        _vote(around, weights, shown, votes, np.repeat(np.arange(len(rows)), len(shifts)))
        nearby[rows] = votes
    return (nearby > 0) | (nearby.max(axis=1, keepdims=True) == 0)


def _vote(
    index: np.ndarray, weights: np.ndarray, shown: Sequence[tuple[Volume, LabelTable, Label]], votes: np.ndarray,
    owner: np.ndarray | None = None,
) -> None:  # fmt: skip
    """Add the ``weights`` (labels,) of the labels of voxels ``index`` (K, 3) (x, y, z) to ``votes`` (K, labels).

    With ``owner`` (K,), each counts in that row instead, once for several voxels of a label.
    """
    maps = {id(volume): volume for volume, *_ in shown}
    dims = np.array(shown[0][0].dims)
    rows = np.flatnonzero(((index >= 0) & (index < dims)).all(axis=1))
    for key, volume in maps.items():
        values = values_at(volume, index[rows])
        own = [(label.number, k) for k, (other, _, label) in enumerate(shown) if id(other) == key]
        numbers, columns = (np.array(part) for part in zip(*sorted(own), strict=True))
        at = np.minimum(np.searchsorted(numbers, values), len(numbers) - 1)
        there = numbers[at] == values
        row = rows[there] if owner is None else owner[rows[there]]
        votes[row, columns[at[there]]] += weights[columns[at[there]]].astype(np.float32)
