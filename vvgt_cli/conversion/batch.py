"""Batches: several clouds of one run, as files with an index, as one page, or in memory.

A batch is the frames of a series, several functions, or the labels of a map: it yields an `Item` for each cloud. One
loop (`_run`) converts them, one after the other, into a sink: `Files` or `Memory`; a page is saved from memory.
`CANNOT` lists the options that each kind of batch does not take.
"""

from __future__ import annotations

import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vvgt_cli.conversion.clouds import Cloud, Clouds
from vvgt_cli.conversion.convert import convert, convert_in_memory, open_field, plan_conversion, run_conversion
from vvgt_cli.conversion.gaussian_files import is_page
from vvgt_cli.conversion.index import (
    FRAMES,
    FUNCTIONS,
    INDEX,
    LABELS,
    entry,
    function_name,
    index_of,
    index_output,
    is_pattern,
    psnr_of,
    put_name,
    write_index,
)
from vvgt_cli.conversion.manifest import Manifest, Shard, parse_shard
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import DataError, SeveralSteps, UsageError
from vvgt_cli.field.layered import NONE, content_of, open_parts
from vvgt_cli.field.open import automatic
from vvgt_cli.files import claim
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.formats.streamed import is_streamed
from vvgt_cli.gaussians.outputs import check_outputs, claimed
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run

if TYPE_CHECKING:
    from vvgt_cli.conversion.result import Conversion
    from vvgt_cli.conversion.warm_start import WarmStart

ONE, LIVE, LEVELS, PAGE = "one volume", "--live", "streamed levels", "a page of several clouds"
WHOLE_RUN = Shard()
UNSAFE = re.compile(r"[^\w.-]+")  # characters that are not put into file names
WHOLE = "the limit is for one file, and there are several; try --max-gaussians"
CANNOT: dict[str, dict[str, str]] = {  # by kind of batch or output: options that it does not take, and a remedy
    ONE: {"--shard": "one volume is not divided; for a series put the number into -o, as out_{:04d}.ply"},
    FRAMES: {
        "--checkpoint": "a series resumes from its manifest; remove it",
        "--dry-run": "a plan is for one volume; try it on one of the frames",
        "after": "a series starts from its own frames; remove it",
    },
    FUNCTIONS: {
        "--checkpoint": "it is for one conversion; run the functions one by one",
        "--dry-run": "a plan is for one function; try it on one of them",
        "--shard": "shards are for series; run the functions one by one",
        "--live": "one live file can be shown under any function by 'vvgt recolor'; give one --tf",
        "--split-labels": "labels have a table of their own; give one or the other",
        "after": "only one conversion can start from another; give one function",
    },
    LABELS: {
        "--tf": "the colours of labels come from --labels; remove it",
        "--layer": "only the label map is divided; remove it",
        "--labels none": "it needs labels; remove it",
        "--dry-run": "a plan is for one file; remove it",
        "--shard": "shards are for series; remove it",
        "--checkpoint": "it is for one conversion; remove it",
        "--max-size": WHOLE,
        "--time-budget": "it is for one conversion, and there are several; try --steps",
        "--live": "a live file of the whole map can show each label alone; remove one of them",
        "after": "only one conversion can start from another; remove it",
    },
    LIVE: {"--dry-run": "live files need no plan; remove it", "after": "live files need no earlier one; remove it"},
    LEVELS: dict.fromkeys(
        (
            *("several --tf", "--steps", "--model", "--rule", "--target-psnr", "--time-budget", "--max-size", "--live"),
            *("--checkpoint", "--preview", "--dry-run", "--shard", "--split-labels"),
        ),
        "levels are made by one closed form alone; remove it",
    ),
    PAGE: {
        "--report": "a report is of one cloud; write a file each, as -o out_{}.ply",
        "--preview": "a preview is of one cloud; write a file each, as -o out_{}.ply",
        "--checkpoint": "it is for one conversion; write a file each, as -o out_{}.ply",
        "--max-size": WHOLE,
    },
}


@dataclass(frozen=True)
class Item:
    """One cloud of a batch.

    Attributes:
        name: name in the index, on pages and as a key.
        stem: part of file names: a frame's number, a function's name, a label's number and name.
        request: request of its conversion, without outputs.
        facts: further entries of its row in the index.
        gaussians: finished Gaussians, box frame, that only need scores; None where they are yet to be made.
    """

    name: str
    stem: str
    request: ConvertRequest
    facts: Mapping[str, Any] = field(default_factory=dict)
    gaussians: Gaussians | None = None


class Batch(ABC):
    """Several clouds to be made of one source.

    Attributes:
        kind: `FRAMES`, `FUNCTIONS` or `LABELS`.
        request: request that all share; its outputs have a place for the name.
        volume: name of the source.
        stems: stems of all items; `prepare` may have to find them first.
        facts: entries of the index as a whole.
        resumes: whether a later run of the same command continues where this one ends, by a manifest of `settings`.
        previous: warm start of each item, where items resemble each other.
    """

    kind: str
    resumes = False
    previous: WarmStart | None = None

    def __init__(self, request: ConvertRequest, volume: str, stems: Sequence[str] = ()) -> None:
        """Store what all items share."""
        self.request, self.volume, self.stems = request, volume, list(stems)
        self.facts: dict[str, Any] = {}

    @abstractmethod
    def prepare(self, run: Run) -> None:
        """Read what all items share."""

    @abstractmethod
    def items(self, run: Run, wanted: Callable[[str], bool]) -> Iterator[Item]:
        """Yield the items with a stem that is ``wanted``; skip those that show nothing, with a message."""

    def settings(self) -> dict[str, Any]:
        """Return everything that the files depend on, for a batch that ``resumes`` and is prepared."""
        return {}


class Functions(Batch):
    """One volume under several functions or looks, read and laid out once.

    Args:
        requests: name, conversion and, for the index, source of each function.
    """

    kind = FUNCTIONS

    def __init__(self, requests: Sequence[tuple[str, ConvertRequest, str]]) -> None:
        """Store the requests, with file names made of their names."""
        request = requests[0][1]
        given = request.source.volume
        volume = Path(given).name if isinstance(given, str) else content_of(given).volumes[0].name
        super().__init__(request, volume, [UNSAFE.sub("-", name).strip("-.") or "function" for name, *_ in requests])
        self._requests = list(requests)

    def prepare(self, run: Run) -> None:
        """Read the volume, where it fits in memory."""
        source = self.request.source
        blocks = self.request.blocks or automatic(source, run.console)
        if blocks is not None:
            self._requests = [(name, replace(one, blocks=blocks), fact) for name, one, fact in self._requests]
            return
        with run.stage("volume") as stage:
            given = source.volume
            content = open_parts(source.path, source.read) if isinstance(given, str) else content_of(given)
            content.prepare()
            stage.note = f"{content.volumes[0].name}, for {len(self._requests)} functions"
        self._requests = [
            (name, replace(one, source=replace(one.source, volume=content)), fact) for name, one, fact in self._requests
        ]

    def items(self, run: Run, wanted: Callable[[str], bool]) -> Iterator[Item]:
        """Yield an item for each function."""
        for number, ((name, request, fact), stem) in enumerate(zip(self._requests, self.stems, strict=True), 1):
            if wanted(stem):
                run.console.message(f"{fact}: function {number} of {len(self._requests)}")
                yield Item(name, stem, request, {"function": fact})


class Files:
    """The sink that writes a file for each item, and their index; a series keeps a manifest, by which it resumes."""

    def __init__(self, request: ConvertRequest, shard: Shard) -> None:
        """Take the output names of ``request``."""
        self._request, self._shard = request, shard
        self._manifest: Manifest | None = None
        self._rows: dict[str, dict[str, Any]] = {}
        self._stack = ExitStack()

    def names(self, kind: str, stem: str) -> list[str]:
        """Return the names of output, report and preview of an item.

        Raises:
            UsageError: a pattern without one place for the name.
        """
        request = self._request
        patterns = {"-o": request.output, "--report": request.report, "--preview": request.preview}
        return [put_name(option, pattern, kind, stem) for option, pattern in patterns.items() if pattern is not None]

    def _named(self, request: ConvertRequest, names: Sequence[str]) -> ConvertRequest:
        rest = list(names)
        output = rest.pop(0)
        report = rest.pop(0) if self._request.report is not None else None
        return replace(
            request, output=output, report=report, preview=rest.pop(0) if rest else None,
            overwrite=request.overwrite or self._manifest is not None,
        )  # fmt: skip

    def open(self, batch: Batch, run: Run) -> None:
        """Check the outputs, before and after the batch is prepared, and claim the folder of a series.

        Raises:
            UsageError: outputs that may not be written, or a folder of another series.
        """
        request, overwrite = self._request, self._request.overwrite
        if request.overwrite and self._shard.count > 1:
            raise UsageError("--overwrite with --shard: shards would remove each other's files; remove the files first")
        first = self.names(batch.kind, batch.stems[0] if batch.stems else INDEX)
        index = index_output(str(request.output))
        check_outputs([*self._named(request, first).outputs(), index], request.inputs(), overwrite or batch.resumes)
        self._check_stems(batch)
        batch.prepare(run)
        self._check_stems(batch)
        rows = [self.names(batch.kind, stem) for stem in batch.stems]
        if not batch.resumes:
            outputs = [output for row in rows for output in self._named(request, row).outputs()]
            check_outputs([*outputs, index], request.inputs(), overwrite)
            return
        folders = {str(Path(name).parent) for name in first}
        if len(folders) > 1:
            raise UsageError(f"-o, --report and --preview of a series: expected one folder; got {', '.join(folders)}")
        self._manifest = Manifest(Path(folders.pop()), batch.settings(), self._shard, what="frames")
        self._stack.enter_context(claim(self._manifest.folder / self._shard.manifest))
        self._manifest.open([Path(name).name for name in (*(n for row in rows for n in row), index.path)], overwrite)
        self._manifest.record()

    def close(self) -> None:
        """Release the folder."""
        self._stack.close()

    @staticmethod
    def _check_stems(batch: Batch) -> None:
        if len(set(batch.stems)) < len(batch.stems):
            stated = ", ".join(dict.fromkeys(batch.stems))
            raise UsageError(f"{len(batch.stems)} {batch.kind}, named {stated}: files would share a name; rename one")

    def wants(self, batch: Batch, stem: str) -> bool:
        """Return whether an item belongs to this shard and is not complete yet."""
        if self._manifest is None:
            return True
        own = [Path(name).name for name in self.names(batch.kind, stem)]
        return self._shard.holds(batch.stems.index(stem)) and not all(map(self._manifest.complete, own))

    def convert(self, batch: Batch, item: Item, console: Console) -> ConversionReport:
        """Convert an item to its files, and return the report."""
        return convert(
            self._named(item.request, self.names(batch.kind, item.stem)), console, item.gaussians, batch.previous
        )

    def take(self, batch: Batch, item: Item, report: ConversionReport, facts: Mapping[str, Any]) -> None:
        """Record a complete item."""
        names = [Path(name) for name in self.names(batch.kind, item.stem)]
        row = entry(item.name, report.gaussians, report.bytes, psnr_of(report), **item.facts, **facts)
        folder = Path(index_output(str(self._request.output)).path).parent
        row["file"] = Path(os.path.relpath(names[0], folder)).as_posix()
        self._rows[item.stem] = row
        if self._manifest is not None:
            self._manifest.record([name.name for name in names], {names[0].name: {"row": row}})

    def finish(self, batch: Batch, console: Console) -> dict[str, Any]:
        """Write and return the index; for shards, of the items recorded so far, so that the last shard lists all."""
        path, manifest, known = index_output(str(self._request.output)).path, self._manifest, -1
        rows = list(self._rows.values())
        while manifest is None or len(manifest.files) > known:
            if manifest is not None:
                known = len(manifest.files)
                files = (Path(self.names(batch.kind, stem)[0]).name for stem in batch.stems)
                rows = [manifest.files[file]["row"] for file in files if file in manifest.files]
            found = index_of(batch.kind, batch.volume, rows, **batch.facts)
            write_index(path, found, self._request.overwrite or manifest is not None)
            if manifest is None:
                break
            manifest.refresh()  # another shard may have recorded its last item meanwhile
        console.message(f"{path}: {len(rows)} {batch.kind}, {len(self._rows)} of them converted in this run")
        return found


class Memory:
    """The sink that keeps Gaussians, scores and layouts."""

    def __init__(self) -> None:
        """Start without clouds."""
        self._clouds: list[Cloud] = []
        self._made: Cloud | None = None

    def open(self, batch: Batch, run: Run) -> None:
        """Prepare the batch."""
        batch.prepare(run)

    def wants(self, batch: Batch, stem: str) -> bool:
        """Return True: every item is kept."""
        return True

    def convert(self, batch: Batch, item: Item, console: Console) -> ConversionReport:
        """Convert an item, release its volume, and return the report."""
        run = Run(console, ConversionReport("convert"))
        with open_field(run, item.request) as volume:
            found = run_conversion(run, item.request, volume, item.gaussians, batch.previous)
            normals = found.normals()
        run.finish()
        self._made = Cloud(found.gaussians, found.report, found.ply, item.name, item.stem, dict(item.facts), normals)
        return found.report

    def take(self, batch: Batch, item: Item, report: ConversionReport, facts: Mapping[str, Any]) -> None:
        """Keep an item."""
        assert self._made is not None
        self._clouds.append(replace(self._made, facts={**self._made.facts, **facts}))

    def finish(self, batch: Batch, console: Console) -> Clouds:
        """Return all items as clouds."""
        return Clouds(batch.kind, batch.volume, self._clouds, batch.facts)

    def close(self) -> None:
        """Do nothing."""


def _run(batch: Batch, sink: Files | Memory, console: Console) -> Any:
    """Convert the items of a batch that a sink wants, one after the other, and finish the sink.

    Raises:
        KeyboardInterrupt: Ctrl-C ended an item early; it is not recorded, so that the same command converts it again.
    """
    run = Run(console, ConversionReport("convert"))
    try:
        sink.open(batch, run)
        for item in batch.items(run, lambda stem: sink.wants(batch, stem)):
            report = sink.convert(batch, item, console)
            if report.interrupted:
                raise KeyboardInterrupt
            sink.take(batch, item, report, batch.previous.facts() if batch.previous else {})
        return sink.finish(batch, console)
    finally:
        sink.close()


def options_in(request: ConvertRequest) -> set[str]:
    """Return the options of `CANNOT` that a request uses."""
    fit, limits, source = request.fit, request.limits, request.source
    used = {
        "--checkpoint": request.checkpoint, "--report": request.report, "--preview": request.preview,
        "--live": request.live, "--tf": source.tf, "--layer": source.layers, "--labels none": source.labels == NONE,
        "--steps": fit.steps, "--model": fit.model, "--rule": fit.rule != INRIA.name,
        "--max-size": limits.max_megabytes, "--time-budget": limits.time_budget, "--target-psnr": limits.target_psnr,
    }  # fmt: skip
    return {option for option, value in used.items() if value}


def check_options(kind: str, used: Iterable[str]) -> None:
    """Check that a kind of batch or output takes all options.

    Raises:
        UsageError: names the first of them, and a remedy.
    """
    for option, why in CANNOT[kind].items():
        if option in used:
            raise UsageError(f"{option} with {kind}: {why}")


def convert_files(
    request: ConvertRequest, functions: Sequence[str] = (), *, split_labels: bool = False, dry_run: bool = False,
    shard: str | None = None, console: Console | None = None,
) -> str | None:  # fmt: skip
    """Convert one volume, the frames of a series, several functions or the labels of a map to files or a page.

    Args:
        request: the request; an ``output`` with a place for a number or name (``{}``) asks for several files.
        functions: all values of ``--tf``, the request's own included.
        split_labels: make a cloud of each label.
        dry_run: plan one volume, and write nothing.
        shard: ``I/N``, the share of a series to convert.
        console: destination of messages.

    Returns:
        The plan of a dry run.

    Raises:
        UsageError: contradictory options; raised before anything is read.
        DataError: see `convert`; complete files stay.
    """
    from vvgt_cli.conversion.frames import is_glob_of_volumes

    console, output = console or Console(), request.output or ""
    several, numbered = len(functions) > 1, is_pattern(output)
    flags = {"--dry-run": dry_run, "--shard": shard, "--split-labels": split_labels, "several --tf": several}
    used = options_in(request) | {option for option, given in flags.items() if given}
    kind = FUNCTIONS if several else LABELS if split_labels else FRAMES if numbered else ONE
    kinds = [LEVELS] if is_streamed(output) else [kind, *([LIVE] if request.live else [])]
    page = kind != ONE and is_page(output) and not numbered
    for one in [*kinds, *([PAGE] if page else [])]:
        check_options(one, used)
    if is_streamed(output):
        from vvgt_cli.conversion.shards.run import init_in_blocks, writes_streaming

        request = replace(request, blocks=request.blocks or automatic(request.source, console))
        if writes_streaming(request):
            init_in_blocks(request, console)
        return None
    if dry_run:
        return plan_conversion(request, console).text()
    if kind == ONE and not (is_page(output) and is_glob_of_volumes(request.source.path)):
        try:
            convert(request, console)
            return None
        except SeveralSteps:
            if not is_page(output):
                raise
    if kind == ONE:
        kind, page = FRAMES, True
        check_options(PAGE, used)
    share = WHOLE_RUN if shard is None else parse_shard(shard)
    looks = [(function_name(tf), replace(request, source=replace(request.source, tf=tf)), tf) for tf in functions]
    batch = _batch(kind, request, looks, share, page)
    if not page:
        _run(batch, Files(request, share), console)
        return None
    run = Run(console, ConversionReport("convert"))
    with claimed(request.outputs(), request.inputs(), request.overwrite):
        clouds = _run(batch, Memory(), console)
        if not clouds:
            raise DataError(f"{output}: nothing is visible in any of its clouds; try another function")
        with run.stage("write") as stage:
            size, total = clouds.save(output, overwrite=request.overwrite), sum(len(c.gaussians) for c in clouds.clouds)
            stage.note = f"{output}: {len(clouds)} clouds, {total} Gaussians, {size / 1e6:.1f} MB"
        run.finish()
    return None


def convert_to_memory(
    requests: Mapping[str, ConvertRequest], *, several: bool = False, split_labels: bool = False,
    after: Conversion | None = None, console: Console | None = None,
) -> Conversion | Clouds:  # fmt: skip
    """Convert one volume, the frames of a series, several looks or the labels of a map, without files.

    Args:
        requests: request of each look, by name.
        several: return `Clouds` even for a single look.
        split_labels: make a cloud of each label.
        after: an earlier conversion of the same volume to start from.
        console: destination of messages.

    Raises:
        UsageError, DataError: see `convert_files`.
    """
    from vvgt_cli.conversion.frames import is_glob_of_volumes
    from vvgt_cli.conversion.previous_look import PreviousLook

    console, request = console or Console(), next(iter(requests.values()))
    used = options_in(request) | ({"after"} if after else set()) | ({"--split-labels"} if split_labels else set())
    kind = FUNCTIONS if several else LABELS if split_labels else ONE
    for one in [kind, *([LIVE] if request.live else [])]:
        check_options(one, used)
    path = request.source.volume
    if kind == ONE and not (isinstance(path, str) and is_glob_of_volumes(path)):
        try:
            return convert_in_memory(request, console, None if after is None else PreviousLook(after))
        except SeveralSteps:
            if not isinstance(path, str):
                raise
    kind = FRAMES if kind == ONE else kind
    check_options(kind, used)
    batch = _batch(kind, request, [(name, one, name) for name, one in requests.items()])
    found: Clouds = _run(batch, Memory(), console)
    return found


def _batch(
    kind: str, request: ConvertRequest, functions: Sequence[tuple[str, ConvertRequest, str]], shard: Shard = WHOLE_RUN,
    page: bool = False,
) -> Batch:  # fmt: skip
    """Return the batch of a kind."""
    from vvgt_cli.conversion.frames import Series
    from vvgt_cli.conversion.labels import Labels

    if kind == FRAMES:
        return Series(request, shard, page)
    return Labels(request) if kind == LABELS else Functions(functions)
