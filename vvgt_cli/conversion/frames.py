"""The frames of a time series as a batch, with the grid, range and function that all of them share."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.conversion.batch import Batch, Item
from vvgt_cli.conversion.index import FRAMES, frame_facts, index_path
from vvgt_cli.conversion.manifest import Shard, file_digest
from vvgt_cli.conversion.place import up_axis
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import DataError, SeveralComponents, UsageError
from vvgt_cli.field.digests import digest, volume_digest
from vvgt_cli.field.layered import ALL, OpenedFile, functions_of, open_content
from vvgt_cli.field.open import automatic, facts_of
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.files import read_text
from vvgt_cli.gaussians.formats import is_page
from vvgt_cli.look.label_files import table_for
from vvgt_cli.look.labels import AUTO, NO_LABELS, LabelTable
from vvgt_cli.network.card import CARD, find_model
from vvgt_cli.progress import Console, counted
from vvgt_cli.score.record import Run
from vvgt_cli.version import VERSION
from vvgt_cli.volume import ReadOptions, Statistics, Volume, edges_of, statistics
from vvgt_cli.volume.label_maps import labels_in, recognised
from vvgt_cli.volume.medical.masks import hold_volumes, mask_files
from vvgt_cli.volume.readers import is_glob
from vvgt_cli.volume.tiff.slices import matching

if TYPE_CHECKING:
    from vvgt_cli.look import TransferFunction


@dataclass(frozen=True)
class Step:
    """A frame of a series: a file, or a time step of one.

    Attributes:
        name: name in messages and the index.
        volume: see `SourceRequest.volume`.
        read: how to read it.
        time: time of the step and its unit, which may be ""; None where the file has none.
        named: "step" and "stem" of its input (`frame_facts`).
    """

    name: str
    volume: str
    read: ReadOptions
    time: tuple[float, str] | None = None
    named: Mapping[str, str] = field(default_factory=dict)

    def label(self) -> str:
        """Return name and time for a message."""
        if self.time is None:
            return self.name
        return f"{self.name} ({' '.join([f'{self.time[0]:g}', self.time[1]]).strip()})"

    def facts(self) -> dict[str, Any]:
        """Return step, stem and time as entries of an index."""
        if self.time is None:
            return {**self.named}
        value, unit = self.time
        return {**self.named, "time": value, **({"time_unit": unit} if unit else {})}


@dataclass(frozen=True)
class Survey:
    """The result of the first pass over a series.

    Attributes:
        count: number of frames.
        ranges: range (lo, hi) of each component of each frame, in the order of `OpenedFile.classified`.
        whole: statistics of each component over all frames.
        first: the first frame without its values; all frames share its grid.
        content: digest of all frames' values.
        labels: labels of all frames, where they are label maps.
    """

    count: int
    ranges: list[list[tuple[float, float]]]
    whole: tuple[Statistics, ...]
    first: OpenedFile
    content: str
    labels: tuple[int, ...] | None

    @property
    def grid(self) -> Volume:
        """Return the volume whose grid all frames share."""
        return self.first.volumes[0]


class FrameSeries(Batch):
    """The frames of a glob of files, or the time steps of one file, under what all of them share.

    Nodes of the function that follow from the data (``--tf-range rescale``, percentiles, the histogram) follow from all
    frames together. Frames in which the function shows nothing are skipped, with a message.

    Raises:
        UsageError: no file matches.
        DataError: a file cannot be read.
    """

    kind, resumes = FRAMES, True

    def __init__(self, request: ConvertRequest, shard: Shard) -> None:
        """List the frames."""
        from vvgt_cli.conversion.previous_frame import previous_frame

        outputs = (request.output, request.report, request.preview)
        given = any("{time" in (name or "") for name in outputs)
        timed = given or request.output is None or is_page(request.output)
        self._steps: Sequence[Step] = list_steps(request.source, timed)
        volume, count = Path(request.source.path).name, len(self._steps)
        super().__init__(request, volume, [str(k) for k in range(count)])
        self._shard = shard
        self.previous = previous_frame(request, shard.count)

    def prepare(self, run: Run) -> None:
        """Read all frames once, for what they share.

        Raises:
            DataError: see `survey`; the function shows nothing in any frame.
            UsageError: see `survey`.
        """
        request, steps, console = self.request, self._steps, run.console
        if request.blocks is None:
            request = replace(request, blocks=automatic(self.sources()[0], console))
        source = request.source
        with run.stage("frames") as stage:
            surveyed = survey(steps, source.labels, source.tf, console, request.blocks is not None)
            source = replace(source, statistics=surveyed.whole)
            if surveyed.first.components_message:  # reported once, not for every frame
                steps = [replace(step, read=replace(step.read, component=ALL)) for step in steps]
            if source.labels is None and surveyed.labels is not None:
                source = replace(source, labels=AUTO)
            shown, distance = _functions(source, surveyed)
            seen = [any(tf.support(*span) for tf, span in zip(shown, spans, strict=True)) for spans in surveyed.ranges]
            self._dark = [not (source.layers or one) for one in seen]
            lo, hi = min(n.lo for n in surveyed.whole), max(n.hi for n in surveyed.whole)
            stage.note = (
                f"{len(steps)} of {' x '.join(map(str, surveyed.grid.dims))}, values {lo:g} to {hi:g}; "
                f"{' + '.join(tf.name for tf in shown)}: opacity per {distance[0]:g} ({distance[1]})"
            )
        if all(self._dark):
            raise DataError(
                f"{source.volume}: {shown[0].name} shows nothing in any of {len(steps)} frames; try another function"
            )
        self._steps, self._survey, self._shown, self._distance = steps, surveyed, shown, distance[0]
        self.request = replace(request, source=source)
        self.facts = {"empty": [k for k, dark in enumerate(self._dark) if dark]}

    def places(self, stem: str) -> dict[str, Any]:
        """Return step, time and stem of a frame, as far as its input states them."""
        return self._steps[int(stem)].facts()

    def sources(self) -> list[SourceRequest]:
        """Return the request of each frame, with what all share once that is prepared."""
        return [replace(self.request.source, volume=step.volume, read=step.read) for step in self._steps]

    def items(self, run: Run, wanted: Callable[[str], bool]) -> Iterator[Item]:
        """Yield an item for each frame that shows something."""
        console, done, mine = run.console, 0, 0
        for k, (step, stem, source) in enumerate(zip(self._steps, self.stems, self.sources(), strict=True)):
            mine += self._shard.holds(k) and not self._dark[k]
            if not wanted(stem):
                continue
            if self._dark[k]:
                console.progress(f"skipped: {step.name} (nothing of it is visible)")
                continue
            console.progress(f"{step.label()}: frame {k + 1} of {len(self._steps)}")
            yield Item(step.name, stem, replace(self.request, source=source), {"frame": k, **step.facts()})
            empty = k in self.facts["empty"]
            done, mine = done + (not empty), mine - empty
        console.message(f"{done} frames converted, {mine - done} were complete before")

    def settings(self) -> dict[str, Any]:
        """Return everything that the files depend on, named as the command line names it."""
        request, survey = self.request, self._survey
        ply, grid, folder = asdict(request.ply), survey.grid, Path(index_path(str(request.output))).parent
        lighting = request.source.light.lighting(self._shown[0].lighting, grid.space)
        looks: list[Any] = []
        for tf in self._shown:
            looks += tf.labels if isinstance(tf, LabelTable) else (tf.opacity_nodes, tf.color_map)
        return {
            "version": VERSION,
            "volume": survey.content,
            "frames": survey.count,
            "function": digest(*looks),
            **({"layers": list(map(_layer_facts, request.source.layers))} if request.source.layers else {}),
            "opacity_unit_distance": self._distance,
            **({} if lighting is None else {"light": lighting.key()}),
            **({"live": True} if request.live else {}),
            "title": request.title,
            "values": request.values,
            **({"story": list(request.story.steps)} if request.story else {}),
            **asdict(request.fit),
            "model": read_text(find_model(request.fit.model) / CARD) if request.fit.model else None,
            **{key: ply[key] for key in ("frame", "sh_degree", "comments", "camera")},
            "level": request.blocks and request.blocks.level,
            "up": up_axis(request.up, request.ply.frame, grid.space),
            "place": [grid.space, *grid.affine[:3].ravel().tolist()],
            "outputs": [os.path.relpath(p, folder) for p in (request.output, request.report, request.preview) if p],
        }


def _layer_facts(layer: SourceRequest) -> list[Any]:
    """Return what a layer depends on: files by their content."""
    own = (layer.volume, layer.tf, layer.labels)
    facts = [file_digest(Path(x)) if isinstance(x, str) and os.path.isfile(x) else facts_of(x) for x in own]
    return [digest(replace(layer, volume="", tf=None, labels=None)), *facts]


def is_glob_of_volumes(source: SourceRequest) -> bool:
    """Return whether a source is a glob of files that each hold a frame, and not slices of one volume, or masks."""
    path = source.volume
    if not isinstance(path, str) or not is_glob(path) or not hold_volumes(matching(path)):
        return False
    return source.labels == NO_LABELS or not mask_files(path)


def survey(
    steps: Sequence[Step], labels: str | LabelTable | None, tf: object, console: Console, stored: bool = False
) -> Survey:
    """Read every frame once, for the range and the digest of all.

    Args:
        steps: the frames.
        labels: requested label table.
        tf: requested function.
        console: draws progress.
        stored: read values from their files slab by slab.

    Raises:
        DataError: a frame cannot be read, or is on another grid than the first.
        UsageError: the segments of a frame overlap.
    """
    first: OpenedFile | None = None
    stats, digests = [], []
    mapped, present = labels not in (None, NO_LABELS), set[int]()
    for k, step in enumerate(counted(steps, console.bar("range"))):
        content = open_content(step.volume, replace(step.read, stored=True, packed=True) if stored else step.read)
        if content.overlapping:
            raise UsageError(f"{step.name}: its segments overlap; convert such frames one by one")
        if first is None:  # with zeros that take no memory as its values
            blank = [replace(v, data=np.broadcast_to(v.data.dtype.type(0), v.data.shape)) for v in content.volumes]
            first = replace(content, volumes=tuple(blank))
        _check_frame(step, steps[0], content, first)
        if k == 0 and labels is None and tf is None and content.single_volume:
            mapped = recognised(content.volumes[0])
        if mapped and content.single_volume:
            present.update(labels_in(content.volumes[0]))
        stats.append([statistics(volume) for volume in content.classified])
        digests += [volume_digest(volume) for volume in content.volumes]
    if first is None:
        raise UsageError("the series has no frames; expected one or more")
    whole = tuple(merge_statistics(rows) for rows in zip(*stats, strict=True))
    own = [[(n.lo, n.hi) for n in rows] for rows in stats]
    return Survey(len(steps), own, whole, first, digest(*digests), tuple(sorted(present)) if mapped else None)


def _check_frame(step: Step, begin: Step, content: OpenedFile, first: OpenedFile) -> None:
    """Check that a frame has the grid and the components of the first."""
    content.volumes[0].check_grid(step.name, first.volumes[0], begin.name, "frames of one series share it")
    if (len(content.volumes), content.color) != (len(first.volumes), first.color):
        raise DataError(
            f"{step.name}: components {len(content.volumes)}; expected the {len(first.volumes)} of {begin.name}: "
            "frames of one series share them"
        )


def merge_statistics(volumes: Sequence[Statistics]) -> Statistics:
    """Merge the statistics of several volumes; counts are spread evenly within the bins of each."""
    lo, hi = min(p.lo for p in volumes), max(p.hi for p in volumes)
    edges = edges_of(lo, hi)
    below = np.zeros(len(edges))
    for one in volumes:
        below += np.interp(edges, one.edges, np.concatenate([[0], np.cumsum(one.histogram)]))
    below[0], below[-1] = 0, sum(int(p.histogram.sum()) for p in volumes)
    histogram = np.diff(np.round(below)).astype(np.int64)
    return Statistics(lo, hi, sum(p.nan_count for p in volumes), sum(p.inf_count for p in volumes), histogram, edges)


def _functions(
    source: SourceRequest, frames: Survey
) -> tuple[Sequence[TransferFunction | LabelTable], tuple[float, str]]:
    """Return the functions of all components on data values, and the unit distance with how it was chosen.

    They are the same for every frame.
    """
    from vvgt_cli.look import read_transfer_function, unit_distance
    from vvgt_cli.look.resolve import parse_tf_range

    if frames.labels is not None and frames.first.single_volume:
        table = table_for(source.labels or AUTO, frames.labels, "the series", frames.grid.segments)
        return (table,), unit_distance(source.unit_distance, frames.grid)
    read = read_transfer_function(source.tf) if isinstance(source.tf, str) else source.tf
    shown = functions_of(frames.first, frames.whole, read, parse_tf_range(source.tf_range))
    given = read if read is not None and frames.first.single_volume else shown[0]
    return shown, unit_distance(source.unit_distance, frames.grid, given)


def list_steps(source: SourceRequest, timed: bool = False) -> list[Step]:
    """List the files of a glob, whose times are looked for if ``timed``, or the time steps of a single file.

    Raises:
        UsageError: the glob matches nothing.
        DataError: a file cannot be read.
    """
    files = [] if os.path.exists(source.path) else matching(source.path)
    if not files and is_glob(source.path):
        raise UsageError(
            f"{source.path}: no file matches; with a number in -o expected the frames of a series, as 'run_*.vti', or "
            "a file with several time steps"
        )
    names = list(map(str, files)) or [source.path]
    times = _times(names[0], source.read) if len(names) == 1 else []
    if len(times) > 1:
        one, (facts,) = names[0], frame_facts(names)
        return [
            Step(f"{Path(one).name} time {k}", one, replace(source.read, time=k), time, {**facts, "step": str(k)})
            for k, time in enumerate(times)
        ]
    return [
        Step(Path(one).name, one, source.read, _stated_time(one, source.read) if timed else None, facts)
        for one, facts in zip(names, frame_facts(names), strict=True)
    ]


def _stated_time(volume: str, read: ReadOptions) -> tuple[float, str] | None:
    """Return the time of a file of one step and its unit, None where it states none."""
    from vvgt_cli.volume.vtk.xml import time_value

    if os.path.isfile(volume) and (value := time_value(Path(volume))) is not None:
        return value, ""
    times = _times(volume, read)
    return times[0] if len(times) == 1 else None


def _times(volume: str, read: ReadOptions) -> list[tuple[float, str] | None]:
    """List the time of each step of a file, None where it has none, whatever its components are."""
    from vvgt_cli.volume.registry import time_steps

    read = replace(read, stored=True, packed=True)
    if isinstance(read.component, str):
        read = replace(read, component=0)
    try:
        return time_steps(volume, read)
    except SeveralComponents:
        return time_steps(volume, replace(read, component=0))
