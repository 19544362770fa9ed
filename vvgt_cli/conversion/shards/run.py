"""`vvgt init` in blocks: count, choose the size of cells, integrate, cut, write; at once, or by shards and a merge."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from vvgt_cli.conversion.convert import degree_of, ply_options
from vvgt_cli.conversion.place import placement_warnings
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.conversion.shards.merge import write_merged
from vvgt_cli.conversion.shards.plan import Plan, disk_bytes, most_cells
from vvgt_cli.conversion.shards.score import scored_views
from vvgt_cli.conversion.shards.streamed import folder_of
from vvgt_cli.errors import UsageError
from vvgt_cli.field.block_store import CELLS, BlockStore
from vvgt_cli.field.blocked import Blocked, MissingBlocks
from vvgt_cli.field.cells import CellBlocks
from vvgt_cli.field.open import FieldNeeds, blocked, store_beside
from vvgt_cli.field.settings import BlockOptions
from vvgt_cli.field.source import tf_record, volume_record
from vvgt_cli.files import check_disk_space
from vvgt_cli.gaussians.formats import format_of
from vvgt_cli.gaussians.formats.streamed import is_streamed
from vvgt_cli.gaussians.outputs import STDOUT, Output, claimed, write_text
from vvgt_cli.jit.ahead import DRAW, INIT, RENDER, for_blocks, for_degree
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run


def writes_streaming(request: ConvertRequest) -> bool:
    """Return whether the closed form is written batch by batch, without all Gaussians in memory."""
    options = request.blocks
    if is_streamed(request.output):
        if request.fit.init != "vbm" or (options is not None and options.shard):
            raise UsageError(
                f"-o {request.output} needs moments: remove --init, and --shard, whose blocks 'vvgt merge' "
                "reads (docs/scale.md)"
            )
        return True
    other = request.fit.init != "vbm" or bool(request.output and options is not None and format_of(request.output))
    if options is not None and options.shard is not None:
        if other:
            raise UsageError(
                "--shard writes blocks of moments: remove --init and other formats, or convert at once (docs/scale.md)"
            )
        return True
    return options is not None and not other


def init_in_blocks(request: ConvertRequest, console: Console | None = None) -> ConversionReport:
    """Convert a volume to a `.ply` by the closed form, with only blocks of it in memory.

    With ``shard`` of ``request.blocks`` the output is a folder of blocks for `merge`.

    Raises:
        UsageError, DataError: see `vvgt_cli.conversion.convert.initialise_only`; shards with other options.
    """
    options = request.blocks or BlockOptions()
    _check_options(request, options)
    run = Run(console or Console(), ConversionReport("init"))
    if options.shard is not None:
        assert request.output is not None
        _shard(run, request, options, BlockStore(Path(request.output).absolute()))
        return run.finish()
    with (
        _written(request.output, request) as outputs,
        claimed(outputs, request.inputs(), request.overwrite),
        store_beside(request.output) as store,
    ):
        make_blocks(run, request, options, store)
        write_merged(run, store, request.output or STDOUT, request.overwrite)
        run.finish()
        if request.report:
            write_text(request.report, run.report.to_json(), request.overwrite)
        store.remove()
    return run.report


def merge(folder: str, output: str, overwrite: bool = False, console: Console | None = None) -> ConversionReport:
    """Make a `.ply`, or streamed SOG, of the blocks that shards have written into a folder.

    Raises:
        UsageError: the folder has no blocks, or the output may not be written.
        DataError: blocks are missing or damaged.
    """
    run = Run(console or Console(), ConversionReport("merge"))
    store = BlockStore(Path(folder))
    store.settings()
    with _written(output) as outputs, claimed(outputs, [], overwrite):
        write_merged(run, store, output, overwrite)
    return run.finish()


@contextmanager
def _written(output: str | None, request: ConvertRequest | None = None) -> Iterator[list[Output]]:
    """Yield the files that will be written; make the folder of a streamed SOG."""
    if output is not None and is_streamed(output):
        more = [] if request is None else replace(request, output=None).outputs()
        with folder_of(output):
            yield [Output("-o", output), *more]
    elif request is not None:
        yield request.outputs()
    else:
        yield [Output("-o", output or STDOUT, (".ply",), splats=True)]


def _check_options(request: ConvertRequest, options: BlockOptions) -> None:
    """Check that options do not contradict each other."""
    if options.shard is not None and options.scheduler is not None:
        raise UsageError("--shard and --scheduler both distribute the blocks; give one of them")
    if options.shard is not None and (request.output in (None, STDOUT) or request.report):
        raise UsageError("--shard: expected a folder of blocks as -o and no --report; 'vvgt merge' makes the .ply")


def _shard(run: Run, request: ConvertRequest, options: BlockOptions, store: BlockStore) -> None:
    """Process the blocks of a shard that can be processed now, and report what remains."""
    try:
        make_blocks(run, request, options, store)
    except MissingBlocks as later:
        run.console.message(
            f"{later.what}: this shard is done, {later.missing} blocks of other shards are missing; run the same array "
            "again once they are complete"
        )
    else:
        run.console.message(f"all blocks are complete; next: vvgt merge {request.output} -o OUT.ply")


def make_blocks(run: Run, request: ConvertRequest, options: BlockOptions, store: BlockStore) -> None:
    """Make all blocks, reusing existing ones, and the plan of the file.

    Raises:
        MissingBlocks: other shards' blocks are missing.
    """
    budget, size = request.fit.max_gaussians, request.fit.size
    wanted = FieldNeeds(budget, size, request.ply.sh_degree, most_cells(budget))
    with blocked(run, request.source, options, store, wanted) as field:
        source, ply = field.source, ply_options(request, field.source)
        for line in placement_warnings(source.volume, ply):
            run.console.message(line)
        degree = degree_of(request, source)
        run.compile(for_degree(for_blocks(source.kernels((RENDER, *INIT, *DRAW))), degree), source.kernel_type())
        field.views.expect(scored_views(size))
        cells = field.cells(size, budget, wanted.most)
        assert cells.rays is not None
        Plan(
            cells.grid, budget, size, source.volume.direction, ply, volume_record(source),
            tf_record(source, request.source), cells.rays.kind, source.labels_alone, degree,
        ).save(store, cells.light)  # fmt: skip
        _check_disk(run, field, cells, budget, degree)
        with run.stage("integrate") as stage:
            done = field.run_pass(cells, "integrate")
            workers = field.run_pass.runner.workers
            stage.note = f"{done} of {len(cells)} blocks" + (f", {workers} workers" if workers > 1 else "")


def _check_disk(run: Run, field: Blocked, cells: CellBlocks, budget: int, degree: int) -> None:
    """Report the bytes that the blocks will take on disk.

    Raises:
        DataError: the disk is too small.
    """
    assert cells.rays is not None
    rays = sum(len(cast.pixels) * len(cast.offsets) for cast in cells.rays.bundles())
    store = cells.store
    need = disk_bytes(cells.grid, field.visible, budget, rays, cells.light is not None, degree) - store.bytes(CELLS)
    if need > 0 and store.missing(CELLS, range(len(cells))):
        run.console.message(f"on disk meanwhile: about {need / 1e6:.0f} MB in {store.folder}")
        check_disk_space(store.folder, need)
