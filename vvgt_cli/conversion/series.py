"""`vvgt convert` of a time series: one `.ply` a frame, under one function, range and grid for all of them."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.conversion.convert import convert
from vvgt_cli.conversion.manifest import Manifest, Shard
from vvgt_cli.conversion.place import way_up
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import DataError, SeveralComponents, UsageError
from vvgt_cli.field.digests import digest, volume_digest
from vvgt_cli.field.layered import ALL, AUTO, COLOR, NONE, Content, functions_of, open_parts
from vvgt_cli.field.open import automatic
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.files import claim, read_text
from vvgt_cli.gaussians.outputs import check_outputs
from vvgt_cli.look.label_files import holds_table, read_labels
from vvgt_cli.look.labels import LabelTable, distinct
from vvgt_cli.network.card import CARD, find_model
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.version import VERSION
from vvgt_cli.volume import ReadOptions, Statistics, Volume, statistics
from vvgt_cli.volume.label_maps import labels_in, recognised

if TYPE_CHECKING:
    from vvgt_cli.look import TransferFunction

FIELD = re.compile(r"\{(?::0?\d{0,2}d)?\}")


def is_pattern(output: str) -> bool:
    """Whether an output's name has a place for a frame's number, as ``out_{:04d}.ply``."""
    return FIELD.search(output) is not None


def frame_names(option: str, pattern: str, count: int) -> list[str]:
    """The names of ``count`` frames, numbered from 0.

    Raises:
        UsageError: not one place for a number.
    """
    if len(FIELD.findall(pattern)) != 1 or set(FIELD.sub("", pattern)) & set("{}"):
        raise UsageError(f"{option} {pattern}: expected one place for the frame's number, as out_{{:04d}}.ply")
    return [pattern.format(k) for k in range(count)]


@dataclass(frozen=True)
class Step:
    """A frame of a series: a file, or a time step of one.

    Attributes:
        name: for messages.
        volume: as `SourceRequest.volume`.
        read: how to read it.
    """

    name: str
    volume: str
    read: ReadOptions


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


def convert_series(request: ConvertRequest, shard: Shard, console: Console | None = None) -> int:
    """Convert every frame that ``request.source.volume``, a glob or a file of time steps, has and that is not done yet.

    Nodes of the function that follow from the data (``--tf-range rescale``, percentiles, the histogram) follow from all
    frames together. Frames in which the function shows nothing get no file, and a line says so.

    Args:
        request: of all frames; its outputs have a place for the frame's number.
        shard: which part of the frames to convert.
        console: for messages.

    Returns:
        How many frames were converted.

    Raises:
        UsageError: no such files, outputs without a place for a number, a folder that holds another series.
        DataError: a frame that cannot be read, or on another grid than the first.
    """
    if request.overwrite and shard.count > 1:
        raise UsageError("--overwrite with --shard: parts would remove each other's files; remove the files instead")
    console = console or Console()
    source = request.source
    steps = steps_of(source)
    if request.blocks is None:
        first = replace(source, volume=steps[0].volume, read=steps[0].read)
        request = replace(request, blocks=automatic(first, console))
    names = _outputs(request, len(steps))
    run = Run(console, ConversionReport("convert"))
    with run.stage("frames") as stage:
        frames = survey(steps, source.labels, source.tf, console, request.blocks is not None)
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
    manifest = Manifest(Path(names[0][0]).parent, _settings(request, frames, shown, distance[0]), shard, what="frames")
    with claim(manifest.folder / shard.manifest):
        manifest.open([Path(name).name for row in names for name in row], request.overwrite)
        manifest.record()
        done = _frames(request, source, steps, names, dark, manifest, console)
    mine = sum(shard.holds(k) and not d for k, d in enumerate(dark))
    console.say(f"{done} frames converted, {mine - done} were done before")
    return done


def _frames(
    request: ConvertRequest,
    source: SourceRequest,
    steps: Sequence[Step],
    names: Sequence[list[str]],
    dark: Sequence[bool],
    manifest: Manifest,
    console: Console,
) -> int:
    """Convert what is missing of this part's frames; returns how many."""
    done = 0
    for k, step in enumerate(steps):
        own = [Path(name).name for name in names[k]]
        if not manifest.shard.holds(k) or all(map(manifest.complete, own)):
            continue
        if dark[k]:
            console.say(f"{step.name}: nothing of it is visible; it gets no file")
            continue
        console.say(f"{step.name}: frame {k + 1} of {len(steps)}, to {names[k][0]}")
        report = convert(_frame(request, replace(source, volume=step.volume, read=step.read), names[k]), console)
        if report.refinement and report.refinement["reason"] == "interrupted":
            raise KeyboardInterrupt  # the frame is there, but not what it would be: it is made again
        manifest.record(own)
        done += 1
    return done


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
        return read_labels(labels)
    return labels if isinstance(labels, LabelTable) else distinct(found)


def steps_of(source: SourceRequest) -> list[Step]:
    """The files of a glob, or the time steps of the one file that is named.

    Raises:
        UsageError: a glob that matches nothing.
        DataError: a file that cannot be read.
    """
    from vvgt_cli.volume.slices import matching

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
    count = _count(volume, source.read)
    if count == 1:
        return [Step(name, volume, source.read)]
    return [Step(f"{name} time {k}", volume, replace(source.read, time=k)) for k in range(count)]


def _count(volume: str, read: ReadOptions) -> int:
    """Time steps of a file, whatever its components are."""
    from vvgt_cli.volume.registry import time_steps

    if read.component in (COLOR, ALL):
        read = replace(read, component=0)
    try:
        return time_steps(volume, read)
    except SeveralComponents:
        return time_steps(volume, replace(read, component=0))


def _outputs(request: ConvertRequest, count: int) -> list[list[str]]:
    """Output, report and preview of every frame, checked as far as the first frame's tell."""
    patterns = {"-o": request.output, "--report": request.report, "--preview": request.preview}
    columns = [frame_names(option, pattern, count) for option, pattern in patterns.items() if pattern is not None]
    rows = [list(row) for row in zip(*columns, strict=True)]
    check_outputs(_frame(request, request.source, rows[0]).outputs(), request.source.paths()[1:], overwrite=True)
    folders = {str(Path(name).parent) for name in rows[0]}
    if len(folders) > 1:
        raise UsageError(f"the frames, reports and previews of a series go to one folder; got {', '.join(folders)}")
    return rows


def _frame(request: ConvertRequest, source: SourceRequest, names: list[str]) -> ConvertRequest:
    """The request of one frame; the manifest has said that its outputs may be replaced."""
    rest = list(names)
    return replace(
        request,
        source=source,
        output=rest.pop(0),
        report=rest.pop(0) if request.report is not None else None,
        preview=rest.pop(0) if request.preview is not None else None,
        overwrite=True,
    )


def _settings(
    request: ConvertRequest, frames: Frames, shown: Sequence[TransferFunction | LabelTable], distance: float
) -> dict[str, Any]:
    """Everything that the files depend on; named as the command line names it."""
    ply = asdict(request.ply)
    lighting = request.source.light.lighting(shown[0].lighting, frames.grid.space)
    looks: list[Any] = []
    for tf in shown:
        looks += tf.labels if isinstance(tf, LabelTable) else (tf.opacity_nodes, tf.color_map)
    return {
        "version": VERSION,
        "volume": frames.content,
        "frames": frames.count,
        "function": digest(*looks),
        **({"layers": [repr(layer) for layer in request.source.layers]} if request.source.layers else {}),
        "opacity_unit_distance": distance,
        **({} if lighting is None else {"light": lighting.text()}),
        **asdict(request.fit),
        **asdict(request.limits),
        "model": read_text(find_model(request.fit.model) / CARD) if request.fit.model else None,
        **{key: ply[key] for key in ("frame", "sh_degree", "comments")},
        "up": way_up(request.up, request.ply.frame, frames.grid.space),
        "place": [frames.grid.space, *frames.grid.affine[:3].ravel().tolist()],
        "outputs": [Path(p).name for p in (request.output, request.report, request.preview) if p],
    }
