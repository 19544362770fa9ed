"""The frames of a time series as a batch: which there are, and the grid, range and function that all of them share."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.conversion.batch import Batch, Item
from vvgt_cli.conversion.index import FRAMES
from vvgt_cli.conversion.manifest import Shard
from vvgt_cli.conversion.place import way_up
from vvgt_cli.conversion.previous_frame import previous_frame
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import DataError, SeveralComponents, UsageError
from vvgt_cli.field.digests import digest, volume_digest
from vvgt_cli.field.layered import ALL, AUTO, COLOR, NONE, Content, functions_of, open_content
from vvgt_cli.field.open import automatic
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.files import read_text
from vvgt_cli.look.label_files import holds_table, read_labels
from vvgt_cli.look.labels import LabelTable, distinct
from vvgt_cli.network.card import CARD, find_model
from vvgt_cli.progress import Console
from vvgt_cli.score.record import Run
from vvgt_cli.version import VERSION
from vvgt_cli.volume import ReadOptions, Statistics, Volume, statistics
from vvgt_cli.volume.label_maps import labels_in, recognised
from vvgt_cli.volume.tiff import SUFFIXES
from vvgt_cli.volume.tiff.slices import matching

if TYPE_CHECKING:
    from vvgt_cli.look import TransferFunction

MOST_LIVE = 3_000_000  # Gaussians of all frames of a live page: 90 MB


@dataclass(frozen=True)
class Step:
    """A frame of a series: a file, or a time step of one.

    Attributes:
        name: for messages and the index.
        volume: as `SourceRequest.volume`.
        read: how to read it.
        time: of a step of a file that states it, with its unit, which may be "".
    """

    name: str
    volume: str
    read: ReadOptions
    time: tuple[float, str] | None = None

    def label(self) -> str:
        """Return name and time for a message."""
        if self.time is None:
            return self.name
        return f"{self.name} ({' '.join([f'{self.time[0]:g}', self.time[1]]).strip()})"

    def facts(self) -> dict[str, Any]:
        """Return its time as an index has it."""
        if self.time is None:
            return {}
        value, unit = self.time
        return {"time": value, **({"time_unit": unit} if unit else {})}


@dataclass(frozen=True)
class Survey:
    """Findings of the first pass over a series.

    Attributes:
        count: number of frames.
        own: range (lo, hi) of each frame's components, as `Content.classified` has them.
        whole: statistics of all frames together, of each component.
        first: the first frame without its values; all frames share its grid.
        content: digest of all frames' values.
        labels: of all frames, where they are label maps.
    """

    count: int
    own: list[list[tuple[float, float]]]
    whole: tuple[Statistics, ...]
    first: Content
    content: str
    labels: tuple[int, ...] | None

    @property
    def grid(self) -> Volume:
        """The volume whose grid all frames share."""
        return self.first.volumes[0]


class Series(Batch):
    """The frames of a glob of files, or the time steps of one file, under what all of them share.

    Nodes of the function that follow from the data (``--tf-range rescale``, percentiles, the histogram) follow from all
    frames together. Frames in which the function shows nothing are skipped, with a message.

    Raises:
        UsageError: no such files.
        DataError: a file that cannot be read.
    """

    kind, resumes = FRAMES, True

    def __init__(self, request: ConvertRequest, shard: Shard, page: bool) -> None:
        self._steps: Sequence[Step] = steps_of(request.source)
        volume, count = Path(request.source.path).name, len(self._steps)
        super().__init__(request, volume, [str(k) for k in range(count)])
        self._shard = shard
        self.previous = previous_frame(request, shard.count)
        self._most = max(MOST_LIVE // count, 1) if page and request.live else request.fit.max_gaussians

    def prepare(self, run: Run) -> None:
        """Read all frames once, for what they share.

        Raises:
            DataError: as `survey`; a function that shows nothing in any frame.
            UsageError: as `survey`.
        """
        request, steps, console = self.request, self._steps, run.console
        if self._most < request.fit.max_gaussians:
            console.say(f"{len(steps)} frames on one page: {self._most} Gaussians each, fewer than --max-gaussians")
            request = replace(request, fit=replace(request.fit, max_gaussians=self._most))
        if request.blocks is None:
            first = replace(request.source, volume=steps[0].volume, read=steps[0].read)
            request = replace(request, blocks=automatic(first, console))
        source = request.source
        with run.stage("frames") as stage:
            found = survey(steps, source.labels, source.tf, console, request.blocks is not None)
            source = replace(source, statistics=found.whole)
            if found.first.components_message:  # said once, not for every frame
                steps = [replace(step, read=replace(step.read, component=ALL)) for step in steps]
            if source.labels is None and found.labels is not None:
                source = replace(source, labels=AUTO)
            shown, distance = _functions(source, found)
            self._dark = [not source.layers and _dark(shown, own) for own in found.own]
            lo, hi = min(n.lo for n in found.whole), max(n.hi for n in found.whole)
            stage.note = (
                f"{len(steps)} of {' x '.join(map(str, found.grid.dims))}, values {lo:g} to {hi:g}; "
                f"{' + '.join(tf.name for tf in shown)}: opacity per {distance[0]:g} ({distance[1]})"
            )
        if all(self._dark):
            raise DataError(
                f"{source.volume}: {shown[0].name} shows nothing in any of {len(steps)} frames; try another function"
            )
        self._steps, self._survey, self._shown, self._distance = steps, found, shown, distance[0]
        self.request = replace(request, source=source)

    def items(self, run: Run, wanted: Callable[[str], bool]) -> Iterator[Item]:
        """Yield an item for each frame that shows something."""
        console, done, mine = run.console, 0, 0
        for k, (step, stem) in enumerate(zip(self._steps, self.stems, strict=True)):
            mine += self._shard.holds(k) and not self._dark[k]
            if not wanted(stem):
                continue
            if self._dark[k]:
                console.say(f"{step.name}: nothing of it is visible; it is skipped")
                continue
            console.say(f"{step.label()}: frame {k + 1} of {len(self._steps)}")
            source = replace(self.request.source, volume=step.volume, read=step.read)
            yield Item(step.name, stem, replace(self.request, source=source), {"frame": k, **step.facts()})
            done += 1
        console.say(f"{done} frames converted, {mine - done} were done before")

    def settings(self) -> dict[str, Any]:
        """Return everything that the files depend on, named as the command line names it."""
        request, survey = self.request, self._survey
        ply, grid = asdict(request.ply), survey.grid
        lighting = request.source.light.lighting(self._shown[0].lighting, grid.space)
        looks: list[Any] = []
        for tf in self._shown:
            looks += tf.labels if isinstance(tf, LabelTable) else (tf.opacity_nodes, tf.color_map)
        return {
            "version": VERSION,
            "volume": survey.content,
            "frames": survey.count,
            "function": digest(*looks),
            **({"layers": [repr(layer) for layer in request.source.layers]} if request.source.layers else {}),
            "opacity_unit_distance": self._distance,
            **({} if lighting is None else {"light": lighting.text()}),
            **({"live": True} if request.live else {}),
            **asdict(request.fit),
            **asdict(request.limits),
            "model": read_text(find_model(request.fit.model) / CARD) if request.fit.model else None,
            **{key: ply[key] for key in ("frame", "sh_degree", "comments")},
            "up": way_up(request.up, request.ply.frame, grid.space),
            "place": [grid.space, *grid.affine[:3].ravel().tolist()],
            "outputs": [Path(p).name for p in (request.output, request.report, request.preview) if p],
        }


def is_glob_of_volumes(path: str) -> bool:
    """Tell whether a path is a glob of files that are volumes of their own, and not slices of one."""
    if os.path.exists(path) or not set(path) & set("*?["):
        return False
    files = matching(path)
    if any(file.suffix.lower() not in SUFFIXES for file in files):
        return True
    return bool(files) and _pages(files[0]) > 1


def _pages(path: Path) -> int:
    """Return the number of pages of a TIFF; 1 where it cannot be read, which reading it reports."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            return len(file.pages)
    except Exception:  # whatever a damaged file makes of it
        return 1


def survey(
    steps: Sequence[Step], labels: str | LabelTable | None, tf: object, console: Console, stored: bool = False
) -> Survey:
    """Read every frame once, for the range and the digest of all.

    Args:
        steps: the frames.
        labels, tf: as they are asked for.
        console: for progress.
        stored: values stay in their files, of which slabs are read.

    Raises:
        DataError: a frame that cannot be read, or on another grid than the first.
        UsageError: frames of segments that overlap.
    """
    first: Content | None = None
    numbers, digests = [], []
    mapped, found = labels not in (None, NONE), set[int]()
    bar = console.bar("range")
    for k, step in enumerate(steps):
        content = open_content(step.volume, replace(step.read, stored=True, packed=True) if stored else step.read)
        if content.overlapping:
            raise UsageError(f"{step.name}: segments that overlap, in several layers; convert such frames one by one")
        first = first or replace(content, volumes=tuple(map(_hollow, content.volumes)))
        _check_frame(step, steps[0], content, first)
        if k == 0 and labels is None and tf is None and content.single_volume:
            mapped = holds_table(content.path) or recognised(content.volumes[0])
        if mapped and content.single_volume:
            found.update(labels_in(content.volumes[0]))
        numbers.append([statistics(volume) for volume in content.classified])
        digests += [volume_digest(volume) for volume in content.volumes]
        if bar:
            bar(k + 1, len(steps))
    if first is None:
        raise UsageError("a series without frames")
    whole = tuple(merge_statistics(parts) for parts in zip(*numbers, strict=True))
    own = [[(n.lo, n.hi) for n in parts] for parts in numbers]
    return Survey(len(steps), own, whole, first, digest(*digests), tuple(sorted(found)) if mapped else None)


def _hollow(volume: Volume) -> Volume:
    """The same without its values."""
    return replace(volume, data=np.broadcast_to(volume.data.dtype.type(0), volume.data.shape))


def _check_frame(step: Step, begin: Step, content: Content, first: Content) -> None:
    """Refuse frames of another grid, or of other components."""
    volume, grid = content.volumes[0], first.volumes[0]
    if _grid(volume) != _grid(grid):
        raise DataError(
            f"{step.name}: {_grid_text(volume)}; expected the grid of {begin.name}, {_grid_text(grid)}: frames of one "
            "series share it"
        )
    if (len(content.volumes), content.color) != (len(first.volumes), first.color):
        raise DataError(
            f"{step.name}: components {len(content.volumes)}; expected the {len(first.volumes)} of {begin.name}: "
            "frames of one series share them"
        )


def _grid(volume: Volume) -> tuple[Any, ...]:
    return volume.dims, volume.spacing, volume.origin, volume.direction, volume.space


def _grid_text(volume: Volume) -> str:
    parts = (volume.spacing, volume.origin, volume.direction)
    numbers = (" ".join(f"{value:g}" for value in values) for values in parts)
    return " x ".join(map(str, volume.dims)) + " voxels of {} from {} along {}".format(*numbers)


def merge_statistics(parts: Sequence[Statistics]) -> Statistics:
    """The statistics of several volumes as one; counts are spread evenly within each one's bins."""
    lo, hi = min(p.lo for p in parts), max(p.hi for p in parts)
    widest = max(parts, key=lambda p: p.edges[-1] - p.edges[0])
    ends = (lo, hi) if lo < hi else (widest.edges[0], widest.edges[-1])
    steps = np.arange(len(widest.edges)) / (len(widest.edges) - 1)
    edges = ends[0] * (1 - steps) + ends[1] * steps
    edges[0], edges[-1] = ends
    below = np.zeros(len(edges))
    for part in parts:
        below += np.interp(edges, part.edges, np.concatenate([[0], np.cumsum(part.histogram)]))
    below[0], below[-1] = 0, sum(int(p.histogram.sum()) for p in parts)
    histogram = np.diff(np.round(below)).astype(np.int64)
    return Statistics(lo, hi, sum(p.nan_count for p in parts), sum(p.inf_count for p in parts), histogram, edges)


def _dark(shown: Sequence[TransferFunction | LabelTable], own: Sequence[tuple[float, float]]) -> bool:
    """Whether nothing of a frame is visible."""
    return not any(tf.support(*limits) for tf, limits in zip(shown, own, strict=True))


def _functions(
    source: SourceRequest, frames: Survey
) -> tuple[Sequence[TransferFunction | LabelTable], tuple[float, str]]:
    """The function of each component, on data values, and the first one's unit distance with how it was chosen.

    They are the same for every frame.
    """
    from vvgt_cli.look import read_transfer_function, unit_distance
    from vvgt_cli.look.resolve import parse_tf_range

    if frames.labels is not None and frames.first.single_volume:
        return (_table(source.labels, frames.labels),), unit_distance(source.unit_distance, frames.grid)
    read = read_transfer_function(source.tf) if isinstance(source.tf, str) else source.tf
    shown = functions_of(frames.first, frames.whole, read, parse_tf_range(source.tf_range))
    given = read if read is not None and frames.first.single_volume else shown[0]
    return shown, unit_distance(source.unit_distance, frames.grid, given)


def _table(labels: str | LabelTable | None, found: Sequence[int]) -> LabelTable:
    """Of a series of label maps; colours that are made depend on a label's number alone."""
    if isinstance(labels, str) and labels != AUTO:
        return read_labels(labels).warned(found, "the series")
    return labels if isinstance(labels, LabelTable) else distinct(found)


def steps_of(source: SourceRequest) -> list[Step]:
    """The files of a glob, or the time steps of the one file that is named.

    Raises:
        UsageError: a glob that matches nothing.
        DataError: a file that cannot be read.
    """
    files = [] if os.path.exists(source.path) else matching(source.path)
    if not files and set(source.path) & set("*?[") and not os.path.exists(source.path):
        raise UsageError(
            f"{source.path}: no such files; with a number in -o expected the frames of a series, as 'run_*.vti', or "
            "a file of several time steps"
        )
    if len(files) > 1:
        return [Step(file.name, str(file), source.read) for file in files]
    volume = str(files[0]) if files else source.path
    name = Path(volume).name
    times = _times(volume, source.read)
    if len(times) == 1:
        return [Step(name, volume, source.read)]
    return [Step(f"{name} time {k}", volume, replace(source.read, time=k), time) for k, time in enumerate(times)]


def _times(volume: str, read: ReadOptions) -> list[tuple[float, str] | None]:
    """Time of each step of a file, None where it says none, whatever its components are."""
    from vvgt_cli.volume.registry import time_steps

    if read.component in (COLOR, ALL):
        read = replace(read, component=0)
    try:
        return time_steps(volume, read)
    except SeveralComponents:
        return time_steps(volume, replace(read, component=0))
