"""`vvgt init` in blocks: count, choose the cells' size, integrate, cut, write."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, astuple, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.conversion.convert import ply_options
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import UsageError
from vvgt_cli.files import check_room
from vvgt_cli.jit.ahead import BLOCKS, COUNT_REAL, COUNT_WHOLE
from vvgt_cli.progress import Console
from vvgt_cli.runs.layered import ALL, COLOR, NONE
from vvgt_cli.runs.outputs import STDOUT, claimed, write_text
from vvgt_cli.runs.place import remarks
from vvgt_cli.runs.record import ConversionReport, Run
from vvgt_cli.runs.source import Source, describe_source, tf_record, volume_record
from vvgt_cli.scale.grid import sample_spacing
from vvgt_cli.scale.levels import level_outputs
from vvgt_cli.scale.merge import write_merged
from vvgt_cli.scale.parts import CELLS, Parts
from vvgt_cli.scale.plan import Plan, disk_bytes, finest_level, most_cells
from vvgt_cli.scale.runners import Here, Processes, Runner
from vvgt_cli.scale.settings import BlockOptions, block_edge, cell_grid, counted_boxes, slices_at_once
from vvgt_cli.scale.sight import Sight, looks
from vvgt_cli.scale.source import InBlocks, Samples, files_of, needs_histogram, open_in_blocks, resolved
from vvgt_cli.share import format_of
from vvgt_cli.version import VERSION

if TYPE_CHECKING:
    from vvgt_cli.scale.grid import CellGrid
    from vvgt_cli.scale.tasks import CellBlocks, CountBlocks

LAYOUT = 3  # of parts: one more whenever what is in them changes


class Later(Exception):
    """Parts of other shards are missing: nothing more can be done now."""

    def __init__(self, what: str, missing: int) -> None:
        super().__init__(what)
        self.what, self.missing = what, missing


def init_in_blocks(request: ConvertRequest, options: BlockOptions, console: Console | None = None) -> ConversionReport:
    """Volume to `.ply` by the closed form, of which only blocks are ever in memory.

    With ``options.shard`` the output is a folder of blocks, which `merge` puts together.

    Raises:
        UsageError, DataError: as `vvgt_cli.conversion.convert.initialise_only`; what blocks cannot do.
    """
    refuse(request, options)
    run = Run(console or Console(), ConversionReport("init"))
    if options.shard is not None:
        assert request.output is not None
        _shard(run, request, options, Parts(Path(request.output).absolute()))
        return run.finish()
    outputs = [*request.outputs(), *level_outputs(request.output, options.levels)]
    with claimed(outputs, request.inputs(), request.overwrite), beside(request.output) as parts:
        make_parts(run, request, options, parts, Sight(request.fit.size))
        write_merged(run, parts, request.output or STDOUT, request.overwrite, options.levels)
        run.finish()
        if request.report:
            write_text(request.report, run.report.to_json(), request.overwrite)
        parts.remove()
    return run.report


def merge(
    folder: str, output: str, overwrite: bool = False, console: Console | None = None, levels: int = 1
) -> ConversionReport:
    """Make a `.ply`, or one of each of ``levels`` of detail, of the blocks that shards have left in a folder.

    Raises:
        UsageError: not such a folder, or an output that may not be written.
        DataError: blocks are missing or damaged.
    """
    from vvgt_cli.runs.outputs import Output

    run = Run(console or Console(), ConversionReport("merge"))
    parts = Parts(Path(folder))
    parts.settings()
    outputs = [Output("-o", output, (".ply",), splats=True), *level_outputs(output, levels)]
    with claimed(outputs, [], overwrite):
        write_merged(run, parts, output, overwrite, levels)
    return run.finish()


def refuse(request: ConvertRequest, options: BlockOptions) -> None:
    """What is not done in blocks."""
    if request.fit.init != "vbm":
        raise UsageError(f"--init {request.fit.init}: needs the whole volume in memory; in blocks: vbm")
    light = request.source.light
    if (any(light.lights) and light.lights != ("none",)) or light.shadows or light.occlusion:
        raise UsageError("--light: shading needs the whole volume in memory; blocks are lit by nothing")
    source = request.source
    if source.labels not in (None, NONE) or source.layers or source.read.component in (COLOR, ALL):
        raise UsageError(
            "labels, layers, colours and channels together need the whole volume in memory, not blocks of it: give the "
            "job more memory (--memory), or take one component (--component N, --labels none)"
        )
    if request.output and options.shard is None and format_of(request.output):
        raise UsageError(f"-o {request.output}: blocks are written as a .ply; give a name that ends in .ply")
    if options.shard is not None and options.scheduler is not None:
        raise UsageError("--shard and --scheduler both share the blocks out; give one of them")
    if options.shard is not None and options.levels > 1:
        raise UsageError("--levels: a shard leaves blocks; give it to 'vvgt merge'")
    if options.shard is not None and (request.output in (None, STDOUT) or request.report):
        raise UsageError("--shard: -o is a folder of blocks then, there is no --report; 'vvgt merge' makes the .ply")


@contextmanager
def beside(output: str | None) -> Iterator[Parts]:
    """Where blocks are kept: beside the output, so that the same command goes on there after it was ended."""
    if output is None or output == STDOUT:
        with tempfile.TemporaryDirectory(prefix="vvgt-") as folder:
            yield Parts(Path(folder) / "blocks")
        return
    target = Path(output).absolute()
    yield Parts(target.with_name(f".{target.name[:80]}.blocks"))


def _runner(options: BlockOptions) -> Runner:
    threads = int(os.environ.get("NUMBA_NUM_THREADS", "1"))
    if options.scheduler is not None:
        from vvgt_cli.scale.dask_runner import Dask

        return Dask(options.scheduler, options.workers, threads)
    return Processes(options.workers, threads) if options.workers > 1 else Here()


def _settings(request: ConvertRequest, opened: InBlocks, sight: Sight) -> dict[str, Any]:
    """All that parts depend on."""
    path = opened.request.path
    found = [file.stat() for file in files_of(path)]
    facts = [sum(f.st_size for f in found), max(f.st_mtime_ns for f in found)] if found else []
    tf = request.source.tf
    text = Path(tf).read_text("utf-8", "replace") if isinstance(tf, str) and os.path.isfile(tf) else repr(tf)
    return {
        "version": [VERSION, LAYOUT],
        "volume": [path, *facts],
        "read": {key: value for key, value in asdict(opened.request.read).items() if value is not None},
        "function": [text, request.source.tf_range, request.source.unit_distance],
        "gaussians": request.fit.max_gaussians,
        "size": request.fit.size,
        "views": list(astuple(sight)),
        "ply": [request.ply.frame, request.up, request.ply.sh_degree, request.ply.comments],
    }


def _shard(run: Run, request: ConvertRequest, options: BlockOptions, parts: Parts) -> None:
    """Do a shard's share of what can be done now, and say what is left."""
    try:
        make_parts(run, request, options, parts, Sight(request.fit.size))
    except Later as later:
        run.console.say(
            f"{later.what}: this shard's share is done, {later.missing} blocks are other shards'; run the same array "
            "again when they are"
        )
    else:
        run.console.say(f"all blocks are there; next: vvgt merge {request.output} -o OUT.ply")


def make_parts(run: Run, request: ConvertRequest, options: BlockOptions, parts: Parts, sight: Sight) -> Source:
    """Every block's part, those that are there taken as they are; and the plan of the file.

    Returns:
        What was read: a volume whose values stay where they are.

    Raises:
        Later: other shards' blocks are missing.
    """
    from vvgt_cli.scale.tasks import CountBlocks, Place

    opened, edge = _opened(run, request, options, parts, sight)
    place = Place(opened.request.path, opened.request.read, str(parts.folder))
    boxes = counted_boxes(opened.volume, edge, sample_spacing(opened.volume.dims))
    counts, second = CountBlocks(place, boxes, slices_at_once(opened.volume, edge, boxes)), None
    with _runner(options) as runner:
        _do(run, runner, counts, options, "count")
        if needs_histogram(request.source) and not _counted(opened):
            from vvgt_cli.volume.tallies import with_limits

            whole = with_limits(counts.merged()[0], opened.volume)
            second = replace(counts, limits=(whole.lo, whole.hi))
            _do(run, runner, second, options, "histogram")
        source, limits, samples = resolved(opened, counts, second)
        for line in (describe_source(source), *remarks(source.volume, ply_options(request, source))):
            run.console.say(line)
        cells, voxels = _cells(request, source, limits, samples, place, edge, sight)
        _plan(request, source, cells.grid).save(parts)
        _check_disk(run, cells, voxels, request.fit.max_gaussians)
        _do(run, runner, cells, options, "integrate")
    return source


def _opened(
    run: Run, request: ConvertRequest, options: BlockOptions, parts: Parts, sight: Sight
) -> tuple[InBlocks, int]:
    """The volume, and the edge of its blocks in voxels; their folder is there then, and kernels are compiled."""
    from vvgt_cli.dvr.scene import kernel_type
    from vvgt_cli.vbm.closed_form import pixel_width

    with run.stage("open") as stage:
        opened = open_in_blocks(request.source, options, pixel_width(request.fit.size))
        volume = opened.volume
        settings = _settings(request, opened, sight)
        edge = parts.kept_edge(settings) if options.size is None else None
        edge = edge or block_edge(volume, options)
        there = parts.open(settings | {"blocks": edge}, ours=options.shard is None)
        stage.note = f"{volume.name}: {' x '.join(map(str, volume.dims))} {volume.data.dtype.name}, blocks of {edge}"
    for line in (opened.told, f"going on with the blocks in {parts.folder}" if there else None):
        if line:
            run.console.say(line)
    run.compile(BLOCKS, kernel_type(volume))
    if _counted(opened):
        run.compile(COUNT_WHOLE)
    else:  # as `tallies.tally` gives them
        run.compile(COUNT_REAL, "float32" if volume.data.dtype == np.float32 else "float64")
    return opened, edge


def _counted(opened: InBlocks) -> bool:
    from vvgt_cli.volume.tallies import counted

    return counted(opened.volume)


def _do(run: Run, runner: Runner, task: CountBlocks | CellBlocks, options: BlockOptions, name: str) -> None:
    """The tasks of a pass that are this run's and not done.

    Raises:
        Later: others are missing.
    """
    parts, everything = task.place.parts, range(len(task))
    index, count = options.shard or (1, 1)
    own = parts.missing(task.kind, (n for n in everything if n % count == index - 1))
    with run.stage(name) as stage:
        runner.run(task, own, run.console.bar(name))
        stage.note = f"{len(own)} of {len(task)} blocks" + (f", {runner.workers} workers" if runner.workers > 1 else "")
    missing = parts.missing(task.kind, everything)
    if missing:
        raise Later(name, len(missing))


def _plan(request: ConvertRequest, source: Source, grid: CellGrid) -> Plan:
    """What merging needs to know."""
    return Plan(
        grid, request.fit.max_gaussians, request.fit.size, source.volume.direction, ply_options(request, source),
        volume_record(source), tf_record(source, request.source),
    )  # fmt: skip


def _check_disk(run: Run, cells: CellBlocks, voxels: float, budget: int) -> None:
    """Say what the blocks will take on disk, of ``voxels`` that are visible.

    Raises:
        DataError: more than is free.
    """
    parts, rays = cells.place.parts, sum(len(look.pixels) * len(look.offsets) for look in looks(cells.sight))
    need = disk_bytes(cells.grid, voxels, budget, rays) - parts.bytes(CELLS)
    if need > 0 and parts.missing(CELLS, range(len(cells))):
        run.console.say(f"on disk meanwhile: about {need / 1e6:.0f} MB in {parts.folder}")
        check_room(parts.folder / CELLS, need)


def _cells(
    request: ConvertRequest, source: Source, limits: tuple[float, float], samples: Samples, place: Any, edge: int,
    sight: Sight,
) -> tuple[CellBlocks, float]:  # fmt: skip
    """The pass that integrates, with the cells' size from the samples, and how many voxels they say are visible."""
    from vvgt_cli.cameras import default_views
    from vvgt_cli.dvr.scene import kernel_rule
    from vvgt_cli.scale.tasks import CellBlocks
    from vvgt_cli.transfer.tables import build_tables
    from vvgt_cli.vbm.closed_form import MARCH_SIZE, visible_share
    from vvgt_cli.vbm.visibility import widening

    if source.lighting is not None:
        raise UsageError(f"{source.tf.name}: is shaded, which needs the whole volume in memory; add --light none")
    volume, frame = source.volume, source.volume.unit_frame()
    rule = kernel_rule(volume, lambda: limits)
    tables = build_tables(
        source.tf, (source.statistics.lo, source.statistics.hi), slope=rule.slope, intercept=rule.intercept,
        unit_distance=source.unit_distance, world_per_unit=1 / frame.scale,
    )  # fmt: skip
    share = sum(w * visible_share(tables, rule.apply(brick)) for brick, w in zip(*samples, strict=True))
    visible = share * volume.data.size / samples[1].sum()
    exponent = _exponent(request, np.array(frame.step), visible)
    march = widening(
        np.array(volume.dims), exponent, np.array(frame.step), default_views("train", size=MARCH_SIZE)
    )  # fmt: skip
    return CellBlocks(place, cell_grid(volume, exponent, edge, march), rule, sight, tables), visible


def _exponent(request: ConvertRequest, step: np.ndarray, voxels: float) -> np.ndarray:
    """Exponents (3,) of the base cells: no finer than the screen tells, and than budget and disk have use for."""
    from vvgt_cli.scale.grid import TILE_BITS
    from vvgt_cli.vbm.closed_form import level_within
    from vvgt_cli.vbm.moments import blocks, exponents

    level = level_within(step, voxels, most_cells(request.fit.max_gaussians), finest_level(step, request.fit.size))
    most = 1 << TILE_BITS
    while blocks(exponents(step, level))[1].max() > most:  # of voxels so thin that a block of them is many cells
        level += 1
    return exponents(step, level)
