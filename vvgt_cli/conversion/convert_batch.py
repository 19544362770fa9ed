"""Convert one volume or a batch of them, to files with an index, a page, or into memory."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vvgt_cli.conversion.batch import (
    LAYERS,
    LEVELS,
    LIVE,
    NO_PAGE,
    NODES,
    ONE,
    ONE_FILE,
    Batch,
    Functions,
    Item,
    check_options,
    options_in,
)
from vvgt_cli.conversion.clouds import Cloud, Clouds, write_together
from vvgt_cli.conversion.convert import convert_one
from vvgt_cli.conversion.fitting import plan_of
from vvgt_cli.conversion.frames import FrameSeries, is_glob_of_volumes
from vvgt_cli.conversion.index import FRAMES, FUNCTIONS, LABELS, entry, index_output, is_pattern, put_name, write_index
from vvgt_cli.conversion.labels import Labels
from vvgt_cli.conversion.manifest import Manifest, Shard, parse_shard
from vvgt_cli.conversion.merge import write_shard
from vvgt_cli.conversion.place import to_frame_of
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import DataError, NothingVisible, SeveralSteps, UsageError
from vvgt_cli.field.settings import BlockOptions
from vvgt_cli.files import claim
from vvgt_cli.gaussians.formats import format_of, is_page
from vvgt_cli.gaussians.formats.streamed import MANIFEST, folder_of, is_streamed
from vvgt_cli.gaussians.outputs import Output, check_outputs, claimed
from vvgt_cli.gaussians.targets import check_opened
from vvgt_cli.progress import Console, Once
from vvgt_cli.score.record import ConversionReport, Run

if TYPE_CHECKING:
    from vvgt_cli.conversion.result import Conversion
    from vvgt_cli.gaussians import PlyOptions
    from vvgt_cli.volume import UnitFrame

WHOLE_RUN = Shard()
PLACE = ("scale", "centre", "affine", "space", "length_unit", "up")  # facts of a file's place in the world
UNKNOWN = "0"  # stem of labels that are not read yet: not that of the index


class Files:
    """A file for each item of a batch, and their index; a series keeps a manifest, by which it resumes."""

    def __init__(self, request: ConvertRequest, shard: Shard) -> None:
        """Take the output names of ``request``."""
        self._request, self._shard = request, shard
        self._manifest: Manifest | None = None
        self._rows: dict[str, dict[str, Any]] = {}

    @property
    def _index(self) -> Output:
        return index_output(str(self._request.output))

    def _key(self, name: str) -> str:
        """Return the path of a file relative to the index, by which index and manifest have it."""
        return Path(os.path.relpath(name, Path(self._index.path).parent)).as_posix()

    def names(self, batch: Batch, stem: str) -> dict[str, str]:
        """Return an item's output, report and preview, as far as they are asked for, the output first.

        Raise UsageError unless patterns have a place for it.
        """
        facts, request = batch.places(stem), self._request
        given = {"output": request.output, "report": request.report, "preview": request.preview}
        return {
            key: put_name("-o" if key == "output" else f"--{key}", name, batch.kind, stem, facts)
            for key, name in given.items()
            if name is not None
        }

    def _named(self, request: ConvertRequest, names: Mapping[str, Any]) -> ConvertRequest:
        return replace(request, **names, overwrite=request.overwrite or self._manifest is not None)

    def open(self, batch: Batch, run: Run, stack: ExitStack) -> None:
        """Check the outputs, before and after the batch is prepared; ``stack`` holds the claim to a folder.

        Raises:
            UsageError: outputs that may not be written, or a folder of another series.
        """
        if self._request.overwrite and self.sharded:
            raise UsageError("--overwrite with --shard: shards would remove each other's files; remove the files first")
        self.names(batch, UNKNOWN)
        folder = Path(self._index.path).parent
        if is_streamed(self._request.output):
            stack.enter_context(folder_of(folder / MANIFEST))
        self._check(batch)
        batch.prepare(run)
        rows = self._check(batch)
        if not batch.resumes:
            return
        self._manifest = Manifest(folder, batch.settings(), self._shard, what="frames")
        stack.enter_context(claim(folder / self._shard.manifest))
        names = [self._key(name) for name in (*(n for row in rows for n in row.values()), self._index.path)]
        self._manifest.open(names, self._request.overwrite)
        self._manifest.record()

    def _check(self, batch: Batch) -> list[dict[str, str]]:
        """Check the outputs as far as stems are known, and return them; files of a series may exist."""
        request, stems, inputs = self._request, batch.stems, self._request.inputs()
        batch.check_names()
        rows, levels = [self.names(batch, stem) for stem in stems or [UNKNOWN]], is_streamed(request.output)
        every = [name for row in rows for name in row.values()]
        if same := [name for name, count in Counter(every).items() if count > 1]:
            raise UsageError(f"{same[0]} would hold several {batch.kind}; expected another place in its name, as {{}}")
        names = [name for name in every if not levels or self._key(name).startswith("..")]
        folders = sorted({str(Path(name).parent) for name in names})
        if batch.resumes and len(folders) > (0 if levels else 1):
            stated, more = ", ".join(folders[:3]), f", {Path(self._index.path).parent}, and those in it" * levels
            raise UsageError(f"-o, --report and --preview of a series: expected one folder{more}; got {stated}")
        if levels and not is_pattern(Path(str(request.output)).parent.name):
            raise UsageError(
                f"-o {request.output}: expected the place in the last folder's name, as out_{{}}/{MANIFEST}"
            )
        checked = rows[self._shard.index - 1 :][:1] if batch.resumes else rows  # shards make folders of their own
        outputs = [output for row in checked for output in self._named(request, row).outputs()]
        with ExitStack() as made:
            for row in checked:
                made.enter_context(folder_of(row["output"]))
            check_outputs([*outputs, self._index], inputs, request.overwrite or batch.resumes or not stems)
        check_outputs([self._index], inputs, request.overwrite or batch.resumes)
        return rows

    def wants(self, batch: Batch, stem: str) -> bool:
        """Return whether an item belongs to this shard and is not complete yet."""
        if self._manifest is None:
            return True
        own = map(self._key, self.names(batch, stem).values())
        return self._shard.holds(batch.stems.index(stem)) and not all(map(self._manifest.complete, own))

    def request(self, batch: Batch, item: Item) -> ConvertRequest:
        """Return the request of an item, to its files."""
        return self._named(item.request, self.names(batch, item.stem))

    def take(self, batch: Batch, item: Item, report: ConversionReport, facts: Mapping[str, Any]) -> None:
        """Record a complete item."""
        names = [self._key(name) for name in self.names(batch, item.stem).values()]
        row = self._rows[item.stem] = entry(item.name, report.gaussians, report.bytes, report, facts, names[0])
        if self._manifest is not None:
            self._manifest.record(names, {names[0]: {"row": row}})

    @property
    def sharded(self) -> bool:
        """Whether other runs convert some of the items."""
        return self._shard.count > 1

    def finish(self, batch: Batch, console: Console) -> None:
        """Write the index; for shards, of the items recorded so far, so that the last shard lists all."""
        path, manifest, known = self._index.path, self._manifest, -1
        rows = list(self._rows.values())
        while manifest is None or len(manifest.files) > known:
            if manifest is not None:
                known = len(manifest.files)
                files = (self._key(self.names(batch, stem)["output"]) for stem in batch.stems)
                rows = [manifest.files[file]["row"] for file in files if file in manifest.files]
            overwrite = self._request.overwrite or manifest is not None
            write_index(path, batch.kind, batch.volume, rows, batch.facts, overwrite)
            if manifest is None:
                break
            manifest.refresh()  # another shard may have recorded its last item meanwhile
        console.message(f"{path}: {len(rows)} {batch.kind}, {len(self._rows)} of them converted in this run")


def _cloud(
    batch: Batch, item: Item, conversion: Conversion, facts: dict[str, Any], first: tuple[UnitFrame, PlyOptions]
) -> Cloud:
    """Return a conversion without its volume, in the unit frame of the ``first`` volume, with its layout."""
    normals, own = conversion.normals(), conversion.field.source.volume.unit_frame()
    gaussians, ply, values = conversion.gaussians, conversion.ply, None
    if own != first[0]:  # another layer's
        gaussians = to_frame_of(gaussians, own, first[0])
        ply = replace(ply, **{name: getattr(first[1], name) for name in PLACE})
    if batch.kind == FRAMES and item.request.values:
        values = conversion.field.source.values(share=len(batch.stems))
    return Cloud(gaussians, conversion.report, ply, item.name, item.stem, facts, normals, values)


def _run(batch: Batch, files: Files | None, console: Console) -> Clouds:
    """Convert the items of a batch one after the other, to the ``files`` that are missing, or all of them into memory.

    Returns:
        The clouds that are in memory.

    Raises:
        UsageError: two items of one name; see also `Files.open`.
        KeyboardInterrupt: Ctrl-C ended an item early; it is not recorded, so that the same command converts it again.
    """
    once, clouds, first = Once(), list[Cloud](), None
    run = Run(replace(console, once=once), ConversionReport("convert"))
    with ExitStack() as stack:
        if files is not None:
            files.open(batch, run, stack)
        else:
            batch.check_names()
            batch.prepare(run)
            if batch.request.story is not None:
                batch.request.story.checked((), len(batch.stems))
        for item in batch.items(run, lambda stem: files is None or files.wants(batch, stem)):
            alone = replace(item.request, output=None, report=None, preview=None)
            request = alone if files is None else files.request(batch, item)
            try:
                conversion = convert_one(request, run.console, warm=batch.previous, finished=item.gaussians)
            except NothingVisible:
                if batch.kind != FRAMES or (files is not None and files.sharded):  # whose index would not know it
                    raise
                batch.facts["empty"] = sorted({*batch.facts["empty"], item.facts["frame"]})
                if len(batch.facts["empty"]) == len(batch.stems):
                    raise
                run.console.progress(f"skipped: {item.name} (nothing of it is visible)")
                continue
            if conversion.report.interrupted:
                raise KeyboardInterrupt
            facts = {**item.facts, **(batch.previous.facts() if batch.previous else {})}
            if files is not None:
                files.take(batch, item, conversion.report, facts)
            else:
                first = first or (conversion.field.source.volume.unit_frame(), conversion.ply)
                clouds.append(_cloud(batch, item, conversion, facts, first))
            del conversion  # and its volume
        for line in once.repeated():
            console.message(line)
        if files is not None:
            files.finish(batch, run.console)
    return Clouds(batch.kind, batch.volume, clouds, batch.facts)


def convert_all(
    requests: Mapping[str, ConvertRequest], *, as_clouds: bool = False, split_labels: bool = False,
    dry_run: bool = False, shard: str | None = None, after: Conversion | None = None, console: Console | None = None,
) -> Conversion | Clouds | str | None:  # fmt: skip
    """Convert a volume, the frames of a series, several looks or the labels of a map, to files or into memory.

    Args:
        requests: request of each look, by name; an ``output`` with a place for a number or name (``{}``) asks for a
            file each.
        as_clouds: return `Clouds` even for a single look.
        split_labels: make a cloud of each label.
        dry_run: plan one volume, and write nothing.
        shard: ``I/N``, the share of a series to convert.
        after: an earlier conversion of the same volume to start from.
        console: destination of messages.

    Returns:
        The conversion of one volume and look, `Clouds` that are in memory or in one file, or the plan of a dry run;
        None for a file each, and for a part of a volume.

    Raises:
        UsageError: contradictory options; raised before anything is read.
        DataError: see `convert`; complete files stay.
    """
    from vvgt_cli.conversion.previous_look import PreviousLook

    console, request = console or Console(), next(iter(requests.values()))
    output, numbered = request.output or "", is_pattern(request.output or "")
    flags = {"--dry-run": dry_run, "--shard": shard, "--split-labels": split_labels, "a file each": numbered}
    flags |= {"--no-values": is_page(output) and request.scored and not request.values, "after": after is not None}
    used = options_in(request) | {option for option, given in flags.items() if given}
    several = as_clouds or len(requests) > 1
    kind = FUNCTIONS if several else LABELS if split_labels else FRAMES if numbered else ONE
    named = LAYERS if kind == LABELS and request.source.layers else kind
    kinds = [*([LEVELS] if is_streamed(output) else []), named, *([LIVE] if request.live else [])]
    holds_several = is_page(output) or ((known := format_of(output)) is not None and known.write_nodes is not None)
    together = kind != ONE and holds_several and not numbered
    nodes = together and kind == FUNCTIONS and not is_page(output)
    also = {NO_PAGE: not is_page(output), ONE_FILE: together, NODES: nodes}
    for one in [*kinds, *(one for one, so in also.items() if so)]:
        check_options(one, used - {"--no-values"} if kind == FRAMES and one != NO_PAGE else used)
    check_opened(output, request.fit.target)
    if request.blocks is not None and request.blocks.shard is not None:
        write_shard(request, console)
        return None
    if is_streamed(output):
        request = replace(request, blocks=request.blocks or BlockOptions())
    if dry_run:
        return plan_of(request, console).text()
    holds_frames = not output or is_page(output)
    if kind == ONE and not (holds_frames and is_glob_of_volumes(request.source)):
        try:
            return convert_one(request, console, warm=None if after is None else PreviousLook(after))
        except SeveralSteps:
            if not holds_frames or not isinstance(request.source.volume, str):
                raise
    if kind == ONE:
        kind, together = FRAMES, bool(output)
        for one in [*([ONE_FILE] if together else []), FRAMES]:
            check_options(one, used - {"--no-values"})
    share = WHOLE_RUN if shard is None else parse_shard(shard)
    request = replace(request, shares_output=together)
    looks = {name: replace(request, source=one.source) for name, one in requests.items()}
    batch = FrameSeries(request, share) if kind == FRAMES else Labels(request) if kind == LABELS else Functions(looks)
    if together:
        return _save_one_file(batch, request, output, console)
    clouds = _run(batch, Files(request, share) if output else None, console)
    return None if output else clouds


def _save_one_file(batch: Batch, request: ConvertRequest, output: str, console: Console) -> Clouds:
    """Convert a batch to a page, or a file with a node an item; raise DataError if nothing is visible in any."""
    run = Run(console, ConversionReport("convert"))
    with claimed(request.outputs(), request.inputs(), request.overwrite):
        clouds = _run(batch, None, console)
        if not clouds:
            raise DataError(f"{output}: nothing is visible in any of its clouds; try another function")
        write_together(run, clouds, output, request.overwrite)
        run.finish()
    return clouds
