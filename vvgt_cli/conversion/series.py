"""`vvgt convert` of a time series: one `.ply` a frame, under one function, range and grid, and an index of all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from vvgt_cli.conversion.carried import carries
from vvgt_cli.conversion.convert import convert
from vvgt_cli.conversion.frames import Series, common, interrupted, steps_of, with_blocks
from vvgt_cli.conversion.index import FRAMES, entry, frame_names, index_of, index_output, psnr_of, write_index
from vvgt_cli.conversion.manifest import Manifest, Shard
from vvgt_cli.conversion.place import way_up
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import UsageError
from vvgt_cli.field.digests import digest
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.files import claim, read_text
from vvgt_cli.gaussians.outputs import check_outputs
from vvgt_cli.look.labels import LabelTable
from vvgt_cli.network.card import CARD, find_model
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.version import VERSION


def convert_series(request: ConvertRequest, shard: Shard, console: Console | None = None) -> dict[str, Any]:
    """Convert every frame that ``request.source.volume``, a glob or a file of time steps, has and that is not done yet.

    Nodes of the function that follow from the data (``--tf-range rescale``, percentiles, the histogram) follow from all
    frames together. Frames in which the function shows nothing get no file, and a line says so.

    Args:
        request: of all frames; its outputs have a place for the frame's number.
        shard: which part of the frames to convert.
        console: for messages.

    Returns:
        The index of the frames that are there, those of other parts included.

    Raises:
        UsageError: no such files, outputs without a place for a number, a folder that holds another series.
        DataError: a frame that cannot be read, or on another grid than the first.
    """
    if request.overwrite and shard.count > 1:
        raise UsageError("--overwrite with --shard: parts would remove each other's files; remove the files instead")
    console = console or Console()
    steps = steps_of(request.source)
    request = with_blocks(request, steps, console)
    names, index = _outputs(request, len(steps))
    series = common(Run(console, ConversionReport("convert")), request, steps)
    manifest = Manifest(Path(names[0][0]).parent, _settings(request, series), shard, what="frames")
    with claim(manifest.folder / shard.manifest):
        manifest.open([Path(name).name for name in (*(n for row in names for n in row), index)], request.overwrite)
        manifest.record()
        done = _frames(request, series, names, manifest, console)
        mine = sum(shard.holds(k) and not dark for k, dark in enumerate(series.dark))
        console.say(f"{done} frames converted, {mine - done} were done before")
        return _indexed(index, request.source.path, series, names, manifest)


def _frames(
    request: ConvertRequest, series: Series, names: Sequence[list[str]], manifest: Manifest, console: Console
) -> int:
    """Convert what is missing of this part's frames; returns how many."""
    done = 0
    carry = carries(request, manifest.shard.count)
    for k, step in enumerate(series.steps):
        own = [Path(name).name for name in names[k]]
        if not manifest.shard.holds(k) or all(map(manifest.complete, own)):
            continue
        if series.dark[k]:
            console.say(f"{step.name}: nothing of it is visible; it gets no file")
            continue
        console.say(f"{step.told()}: frame {k + 1} of {len(series.steps)}, to {names[k][0]}")
        report = convert(_frame(request, series.source_of(step), names[k]), console, carry=carry)
        if interrupted(report):
            raise KeyboardInterrupt  # the frame is there, but not what it would be: it is made again
        facts = {"gaussians": report.gaussians, "psnr": psnr_of(report), **(carry.facts() if carry else {})}
        manifest.record(own, {own[0]: facts})
        done += 1
    return done


def _indexed(
    index: str, volume: str, series: Series, names: Sequence[list[str]], manifest: Manifest
) -> dict[str, Any]:  # fmt: skip
    """Write the index of what all parts have recorded; the part that ends last finds all of it."""
    known = -1
    found: dict[str, Any] = {}
    while len(manifest.files) > known:  # another part may have recorded its last frame meanwhile
        known = len(manifest.files)
        files = []
        for k, (step, row) in enumerate(zip(series.steps, names, strict=True)):
            file = Path(row[0]).name
            if (there := manifest.files.get(file)) is not None:
                facts = step.facts() | ({"moved": there["moved"]} if "moved" in there else {})
                one = entry(step.name, there.get("gaussians"), there["bytes"], there.get("psnr"), frame=k, **facts)
                files.append({**one, "file": file})
        found = index_of(FRAMES, Path(volume).name, files)
        write_index(index, found, overwrite=True)
        manifest.refresh()
    return found


def _outputs(request: ConvertRequest, count: int) -> tuple[list[list[str]], str]:
    """Output, report and preview of every frame, checked as far as the first frame's tell; and the index."""
    patterns = {"-o": request.output, "--report": request.report, "--preview": request.preview}
    columns = [frame_names(option, pattern, count) for option, pattern in patterns.items() if pattern is not None]
    rows = [list(row) for row in zip(*columns, strict=True)]
    index = index_output(str(request.output))
    first = _frame(request, request.source, rows[0])
    check_outputs([*first.outputs(), index], request.source.paths()[1:], overwrite=True)
    folders = {str(Path(name).parent) for name in rows[0]}
    if len(folders) > 1:
        raise UsageError(f"the frames, reports and previews of a series go to one folder; got {', '.join(folders)}")
    return rows, index.path


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


def _settings(request: ConvertRequest, series: Series) -> dict[str, Any]:
    """Everything that the files depend on; named as the command line names it."""
    frames, shown = series.frames, series.shown
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
        "opacity_unit_distance": series.distance,
        **({} if lighting is None else {"light": lighting.text()}),
        **({"live": True} if request.live else {}),
        **asdict(request.fit),
        **asdict(request.limits),
        "model": read_text(find_model(request.fit.model) / CARD) if request.fit.model else None,
        **{key: ply[key] for key in ("frame", "sh_degree", "comments")},
        "up": way_up(request.up, request.ply.frame, frames.grid.space),
        "place": [frames.grid.space, *frames.grid.affine[:3].ravel().tolist()],
        "outputs": [Path(p).name for p in (request.output, request.report, request.preview) if p],
    }
