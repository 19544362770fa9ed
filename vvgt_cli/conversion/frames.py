"""The frames of a time series: which there are, and what all of them share: grid, range, function."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import DataError, SeveralComponents, UsageError
from vvgt_cli.field.digests import digest, volume_digest
from vvgt_cli.field.layered import ALL, AUTO, COLOR, NONE, Content, functions_of, open_parts
from vvgt_cli.field.open import automatic
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.look.label_files import holds_table, read_labels
from vvgt_cli.look.labels import LabelTable, distinct
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.volume import ReadOptions, Statistics, Volume, statistics
from vvgt_cli.volume.label_maps import labels_in, recognised

if TYPE_CHECKING:
    from vvgt_cli.look import TransferFunction


@dataclass(frozen=True)
class Step:
    """A frame of a series: a file, or a time step of one.

    Attributes:
        name: for messages.
        volume: as `SourceRequest.volume`.
        read: how to read it.
        time: of a step of a file that says it, with its unit, which may be "".
    """

    name: str
    volume: str
    read: ReadOptions
    time: tuple[float, str] | None = None

    def told(self) -> str:
        """Name and time."""
        return (
            self.name if self.time is None else f"{self.name} ({' '.join([f'{self.time[0]:g}', self.time[1]]).strip()})"
        )

    def facts(self) -> dict[str, Any]:
        """Its time as an index has it."""
        if self.time is None:
            return {}
        value, unit = self.time
        return {"time": value, **({"time_unit": unit} if unit else {})}


@dataclass(frozen=True)
class Frames:
    """What the first pass over a series found.

    Attributes:
        count: how many there are.
        own: range (lo, hi) of each frame's components, as `Content.classified` has them.
        whole: statistics of all frames together, of each component.
        first: the first frame without its values; the grid of all of them is its.
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
        """That all frames share."""
        return self.first.volumes[0]


@dataclass(frozen=True)
class Series:
    """Frames under what is common to them.

    Attributes:
        steps: the frames.
        source: of all of them, but for volume and read.
        frames: what the first pass found.
        shown: the function of each component, on data values.
        distance: world length that opacity is per.
        dark: of each frame, whether nothing of it is visible.
    """

    steps: Sequence[Step]
    source: SourceRequest
    frames: Frames
    shown: Sequence[TransferFunction | LabelTable]
    distance: float
    dark: Sequence[bool]

    def source_of(self, step: Step) -> SourceRequest:
        """Of one frame."""
        return replace(self.source, volume=step.volume, read=step.read)


def with_blocks(request: ConvertRequest, steps: Sequence[Step], console: Console) -> ConvertRequest:
    """The request of all frames, in blocks where the first one is large."""
    if request.blocks is not None:
        return request
    first = replace(request.source, volume=steps[0].volume, read=steps[0].read)
    return replace(request, blocks=automatic(first, console))


def common(run: Run, request: ConvertRequest, steps: Sequence[Step]) -> Series:
    """Read all frames once: what they share.

    Raises:
        DataError: as `survey`; a function that shows nothing in any frame.
        UsageError: as `survey`.
    """
    source = request.source
    with run.stage("frames") as stage:
        frames = survey(steps, source.labels, source.tf, run.console, request.blocks is not None)
        source = replace(source, statistics=frames.whole)
        if frames.first.unasked:  # said once, not for every frame
            steps = [replace(step, read=replace(step.read, component=ALL)) for step in steps]
        if source.labels is None and frames.labels is not None:
            source = replace(source, labels=AUTO)
        shown, distance = _functions(source, frames)
        dark = [not source.layers and _dark(shown, own) for own in frames.own]
        lo, hi = min(n.lo for n in frames.whole), max(n.hi for n in frames.whole)
        stage.note = (
            f"{len(steps)} of {' x '.join(map(str, frames.grid.dims))}, values {lo:g} to {hi:g}; "
            f"{' + '.join(tf.name for tf in shown)}: opacity per {distance[0]:g} ({distance[1]})"
        )
    if all(dark):
        raise DataError(
            f"{source.volume}: {shown[0].name} shows nothing in any of {len(steps)} frames; try another function"
        )
    return Series(steps, source, frames, shown, distance[0], dark)


def interrupted(report: ConversionReport) -> bool:
    """Whether Ctrl-C ended gradient descent."""
    return report.refinement is not None and report.refinement["reason"] == "interrupted"


def survey(
    steps: Sequence[Step], labels: str | LabelTable | None, tf: object, console: Console, stored: bool = False
) -> Frames:
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
        content = open_parts(step.volume, replace(step.read, stored=True, packed=True) if stored else step.read)
        if content.overlapping:
            raise UsageError(f"{step.name}: segments that overlap, in several layers; convert such frames one by one")
        first = first or replace(content, volumes=tuple(map(_hollow, content.volumes)))
        _check_frame(step, steps[0], content, first)
        if k == 0 and labels is None and tf is None and content.one_field:
            mapped = holds_table(content.path) or recognised(content.volumes[0])
        if mapped and content.one_field:
            found.update(labels_in(content.volumes[0]))
        numbers.append([statistics(volume) for volume in content.classified])
        digests += [volume_digest(volume) for volume in content.volumes]
        if bar:
            bar(k + 1, len(steps))
    if first is None:
        raise UsageError("a series without frames")
    whole = tuple(merge_statistics(parts) for parts in zip(*numbers, strict=True))
    own = [[(n.lo, n.hi) for n in parts] for parts in numbers]
    return Frames(len(steps), own, whole, first, digest(*digests), tuple(sorted(found)) if mapped else None)


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
    source: SourceRequest, frames: Frames
) -> tuple[Sequence[TransferFunction | LabelTable], tuple[float, str]]:
    """The function of each component, on data values, and the first one's unit distance with how it was chosen.

    They are the same for every frame.
    """
    from vvgt_cli.look import read_transfer_function, unit_distance
    from vvgt_cli.look.resolve import parse_tf_range

    if frames.labels is not None and frames.first.one_field:
        return (_table(source.labels, frames.labels),), unit_distance(source.unit_distance, frames.grid)
    read = read_transfer_function(source.tf) if isinstance(source.tf, str) else source.tf
    shown = functions_of(frames.first, frames.whole, read, parse_tf_range(source.tf_range))
    given = read if read is not None and frames.first.one_field else shown[0]
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
    from vvgt_cli.volume.tiff.slices import matching

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
