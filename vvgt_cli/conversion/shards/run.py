"""Conversion to a file in blocks and regions, or by shards: count, integrate, cut, refine, write, score."""

from __future__ import annotations

import math
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.blocks import spread_blocks
from vvgt_cli.conversion.file_layout import degree_of, ply_options
from vvgt_cli.conversion.place import placement_warnings
from vvgt_cli.conversion.plan import most_steps, steps_in_time
from vvgt_cli.conversion.request import HARMONIC_BYTES, VERTEX_BYTES, ConvertRequest, Limits
from vvgt_cli.conversion.shards.cut import Cut, ShardPlan, cut_of, disk_bytes
from vvgt_cli.conversion.shards.regions import Refiner, StoredGaussians, make_regions
from vvgt_cli.conversion.shards.streamed import write_streamed
from vvgt_cli.conversion.stages.closed_form import FAINT_LOGIT, NEARLY, TOO_FAINT, thin
from vvgt_cli.conversion.stages.refinement import HARMONICS
from vvgt_cli.errors import UsageError
from vvgt_cli.field.block_store import CELLS, BlockStore
from vvgt_cli.field.blocked import Blocked, MissingBlocks, Pass
from vvgt_cli.field.cells import CellBlocks
from vvgt_cli.field.digests import digest
from vvgt_cli.field.field import Picture
from vvgt_cli.field.open import FieldNeeds, blocked, runner_of, store_beside, thread_count
from vvgt_cli.field.rays import RayFile, composed
from vvgt_cli.field.settings import MANY, BlockOptions, worker_count
from vvgt_cli.field.source import tf_record, volume_record
from vvgt_cli.field.workload import pace
from vvgt_cli.files import atomic_write, check_disk_space
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.formats import format_of
from vvgt_cli.gaussians.formats.streamed import MANIFEST, folder_of, is_streamed
from vvgt_cli.gaussians.frames import transform
from vvgt_cli.gaussians.outputs import STDOUT, Output, claimed, write_text
from vvgt_cli.gaussians.ply import ply_header, ply_rows
from vvgt_cli.gaussians.rules import INRIA, Rule
from vvgt_cli.gaussians.types import concatenate
from vvgt_cli.jit.ahead import DRAW, INIT, OPTIMIZE, RENDER, for_blocks, for_degree
from vvgt_cli.progress import Console
from vvgt_cli.resources import free_memory
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.score.viewing import PREVIEW_VIEWS

if TYPE_CHECKING:
    from vvgt_cli.images.metrics import Scores


DERIVED = ("coarse", "trees", "closed-", "errors-", "written-")  # what a merge adds to a folder of blocks
A_STEP, A_WRITE = 5e-7, 2e-5  # seconds a Gaussian: of a step with its share of views, and of the file
BLOCKS_A_VIEW = 64  # of 16 x 16 px, by which test views are scored
RAYS_A_PIXEL = 2  # along its edge
A_GAUSSIAN = 400  # bytes to draw a Gaussian


def writes_streaming(request: ConvertRequest) -> bool:
    """Return whether the output is written batch by batch, without all Gaussians in memory."""
    options = request.blocks
    if is_streamed(request.output):
        if request.fit.init != "vbm" or (options is not None and options.shard):
            raise UsageError(
                f"-o {request.output} needs moments: remove --init, and --shard, whose blocks 'vvgt merge' "
                "reads (docs/scale.md)"
            )
        return True
    other = request.fit.init != "vbm" or bool(request.output and format_of(request.output))
    if options is not None and options.shard is not None:
        if other:
            raise UsageError(
                "--shard writes blocks of moments: remove --init and other formats, or convert at once (docs/scale.md)"
            )
        return True
    return options is not None and not other


def convert_in_batches(request: ConvertRequest, console: Console | None = None) -> ConversionReport:
    """Convert a volume to a `.ply` or to levels, with only blocks of it and regions of Gaussians in memory.

    With ``shard`` of ``request.blocks`` the output is a folder of blocks for `merge`.

    Args:
        request: the request.
        console: destination of messages.

    Raises:
        UsageError, DataError: see `vvgt_cli.conversion.convert.initialise_only`; shards with other options.
    """
    options = request.blocks or BlockOptions()
    _check_options(request, options)
    run = Run(console or Console(), ConversionReport("init" if request.fit.steps == 0 else "convert"))
    if options.shard is not None:
        assert request.output is not None
        _shard(run, request, options, BlockStore(Path(request.output).absolute()))
        return run.finish()
    with (
        folder_of(request.output),
        claimed(request.outputs(), request.inputs(), request.overwrite),
        store_beside(request.output) as store,
        _opened(run, request, options, store) as field,
    ):
        make_blocks(run, request, field)
        refiner = partial(refiner_of, run, request, field)
        write_merged(run, field.run_pass, request.output or STDOUT, request.overwrite, refiner)
        run.finish()
        if request.report:
            write_text(request.report, run.report.to_json(), request.overwrite)
        store.remove()
    return run.report


def gaussians_by_regions(run: Run, request: ConvertRequest, field: Blocked) -> Gaussians:
    """Return a volume's Gaussians, box frame, refined region by region; errors are those of `write_merged`."""
    budget = request.budget(degree_of(request, field.source))
    request = replace(request, fit=replace(request.fit, max_gaussians=budget))
    run.console.message(f"more than {MANY:,} Gaussians: refined region by region (docs/scale.md)")
    make_blocks(run, request, field)
    cut = cut_of(run, field.run_pass)
    threshold, stored, _ = closed_form(run, field.run_pass, cut)
    over = cut.over_tiles(threshold)
    refiner = refiner_of(run, request, field)
    if refiner is not None:
        thresholds = np.full((len(cut.pyramid), 1), threshold)
        stored = make_regions(run, field.run_pass, cut, thresholds, refiner, least=False)
    return concatenate([gaussians for gaussians, _ in chain(stored.regions(), [] if over is None else [over])])


def refiner_of(run: Run, request: ConvertRequest, field: Blocked) -> Refiner | None:
    """Return the refiner of a request's steps, as many as there is time for; None for no steps."""
    fit, limits = request.fit, request.limits
    steps, degree = most_steps(fit, limits), degree_of(request, field.source)
    chosen = field.run_pass.store.folder / f"steps-{digest(steps, limits.time_budget)[:16]}"
    if chosen.is_file():
        steps = int(chosen.read_text("ascii"))
        run.console.message(f"{steps} steps in the time budget, as the interrupted run chose")
    elif steps and limits.time_budget is not None:
        each = A_STEP * pace() * HARMONICS[degree] * fit.max_gaussians / field.run_pass.runner.workers
        left = limits.time_budget - run.elapsed() - A_WRITE * fit.max_gaussians
        steps = steps_in_time(steps, left, lambda steps: steps * each)
        if not steps:
            run.skip("refinement", f"{max(left, 0.0):.1f} s remain")
        with atomic_write(chosen, overwrite=True) as temporary:
            temporary.write_text(str(steps), "ascii")
    if not steps:
        return None
    run.compile(for_degree(OPTIMIZE, degree))
    return Refiner(field.reader, field.light, replace(fit, steps=steps), Limits(limits.target_psnr))


def merge(folder: str, output: str, overwrite: bool = False, console: Console | None = None) -> ConversionReport:
    """Make a `.ply`, or streamed SOG, of the blocks that shards have written into a folder.

    Raises:
        UsageError: the folder has no blocks, or the output may not be written.
        DataError: blocks are missing or damaged.
    """
    run = Run(console or Console(), ConversionReport("merge"))
    store = BlockStore(Path(folder).absolute())
    store.settings()
    plan, threads = ShardPlan.load(store), thread_count()
    workers = worker_count(BlockOptions(), math.prod(plan.grid.blocks.dims), plan.budget, threads)
    endings = (MANIFEST,) if is_streamed(output) else (".ply",)
    with (
        folder_of(output),
        claimed([Output("-o", output, endings, splats=True)], [], overwrite),
        runner_of(BlockOptions(workers=workers), threads) as runner,
    ):
        write_merged(run, Pass(runner, store, run.console.bar), output, overwrite)
    for kind in store.folder.iterdir():
        if kind.name.startswith(DERIVED):
            shutil.rmtree(kind)
    return run.finish()


def _check_options(request: ConvertRequest, options: BlockOptions) -> None:
    """Check that options do not contradict each other."""
    if options.shard is not None and options.scheduler is not None:
        raise UsageError("--shard and --scheduler both distribute the blocks; give one of them")
    if options.shard is not None and (request.output in (None, STDOUT) or request.report):
        raise UsageError("--shard: expected a folder of blocks as -o and no --report; 'vvgt merge' makes the .ply")


def _shard(run: Run, request: ConvertRequest, options: BlockOptions, store: BlockStore) -> None:
    """Process the blocks of a shard that can be processed now, and report what remains."""
    try:
        with _opened(run, request, options, store) as field:
            make_blocks(run, request, field)
    except MissingBlocks as later:
        run.console.message(
            f"{later.what}: this shard is done, {later.missing} blocks of other shards are missing; run the same array "
            "again once they are complete"
        )
    else:
        run.console.message(f"all blocks are complete; next: vvgt merge {request.output} -o OUT.ply")


def _opened(
    run: Run, request: ConvertRequest, options: BlockOptions, store: BlockStore
) -> AbstractContextManager[Blocked]:
    budget = request.fit.max_gaussians
    wanted = FieldNeeds(budget, request.fit.size, request.ply.sh_degree, on_disk=True)
    return blocked(run, request.source, options, store, wanted)


def make_blocks(run: Run, request: ConvertRequest, field: Blocked) -> None:
    """Make all blocks, or reuse them, and the file's plan; raise MissingBlocks if other shards' are missing."""
    from vvgt_cli.closed_form.closed_form import most_cells

    budget, size, store = request.fit.max_gaussians, request.fit.size, field.run_pass.store
    source, ply = field.source, ply_options(request, field.source)
    for line in placement_warnings(source.volume, ply):
        run.console.message(line)
    degree = degree_of(request, source)
    run.compile(for_degree(for_blocks(source.kernels((RENDER, *INIT, *DRAW))), degree), source.kernel_type())
    field.views.expect(scored_views(size))
    cells = field.cells(size, most_cells(budget, on_disk=True))
    assert cells.rays is not None
    ShardPlan(
        cells.grid, budget, size, source.volume.direction, ply, volume_record(source),
        tf_record(source, request.source), cells.rays.kind, source.labels_alone, degree, field.reader.voxel_bytes,
    ).save(store, cells.light)  # fmt: skip
    _check_disk(run, field, cells, budget, degree)
    with run.stage("integrate") as stage:
        done = field.run_pass(cells, "integrate")
        workers = field.run_pass.runner.workers
        stage.note = f"{done} of {len(cells)} blocks" + (f", {workers} workers" if workers > 1 else "")


def _check_disk(run: Run, field: Blocked, cells: CellBlocks, budget: int, degree: int) -> None:
    """Report the bytes that the blocks will take on disk; raise DataError if it is too small."""
    assert cells.rays is not None
    rays = sum(len(cast.pixels) * len(cast.offsets) for cast in cells.rays.bundles())
    store = cells.store
    need = disk_bytes(cells.grid, field.visible, budget, rays, cells.light is not None, degree) - store.bytes(CELLS)
    if need > 0 and store.missing(CELLS, range(len(cells))):
        run.console.message(f"on disk meanwhile: about {need / 1e6:.0f} MB in {store.folder}")
        check_disk_space(store.folder, need)


def write_merged(
    run: Run, run_pass: Pass, output: str, overwrite: bool, refiner: Callable[[], Refiner | None] = lambda: None
) -> None:
    """Cut the pyramid of all blocks for the plan's budget, write the file and fill in the report.

    Args:
        run: gets the stages.
        run_pass: runs passes over the complete blocks.
        output: a `.ply`, the manifest of levels, or a stream.
        overwrite: replace an existing file.
        refiner: returns what refines streamed levels, or None for the closed form.

    Raises:
        DataError: blocks are missing or damaged, or nothing is visible.
        UsageError: the output may not be written.
    """
    cut = cut_of(run, run_pass)
    plan, report = cut.plan, run.report
    report.volume, report.transfer_function = plan.volume, plan.function
    report.options = {"max_gaussians": plan.budget, "size": plan.size, "frame": plan.ply.frame, "up": plan.ply.up}
    if is_streamed(output):
        write_streamed(run, run_pass, cut, output, overwrite, refiner)
        return
    _write_ply(run, run_pass, cut, output, overwrite)


def _write_ply(run: Run, run_pass: Pass, cut: Cut, output: str, overwrite: bool) -> None:
    """Write a `.ply`, and record its Gaussians, bytes and, where memory allows drawing it, scores."""
    from vvgt_cli.closed_form.lit import directions

    plan, size, free, store = cut.plan, cut.plan.size, free_memory(), run_pass.store
    threshold, stored, removed = closed_form(run, run_pass, cut)
    over = cut.over_tiles(threshold)
    count = int(stored.field("counts").sum()) + (0 if over is None else len(over[0]))
    axes, turned = np.array(plan.axes).reshape(3, 3), np.linalg.inv(np.array(plan.axes).reshape(3, 3))
    degree = plan.written_degree
    if output != STDOUT:
        check_disk_space(output, count * (VERTEX_BYTES + HARMONIC_BYTES[degree]))
    kept: list[Gaussians] | None = [] if free is None or drawing_bytes(count, size) < free else None
    with run.stage("write") as stage, _sink(store, output, overwrite) as sink:
        written = sink.write(ply_header(count, degree, plan.ply))
        for gaussians, normals in chain(stored.regions(), [] if over is None else [over]):
            normals = None if normals is None else directions(normals @ turned)
            written += sink.write(ply_rows(transform(gaussians, axes), plan.ply, normals).data)
            if kept is not None:
                kept.append(gaussians)
        stage.note = f"{output}: {count} Gaussians, {written / 1e6:.1f} MB"
        if not removed and count < NEARLY * plan.budget:
            base = cut.pyramid.base
            stage.note += f", no more: {base} cells suffice for the screen and {plan.budget} Gaussians"
    run.report.gaussians, run.report.bytes = count, written
    if kept is None:
        need = drawing_bytes(count, size)
        run.skip("test views", f"drawing {count} Gaussians needs about {need / 2**30:.1f} GiB of memory")
    else:
        with run.stage("test views") as stage:
            found = score_gaussians(concatenate(kept), store, plan, plan.ply.rule or INRIA)
            run.report.scores, stage.note = asdict(found), score_text(found, size)


def closed_form(run: Run, run_pass: Pass, cut: Cut) -> tuple[float, StoredGaussians, int]:
    """Make the Gaussians of a plan's budget, or fewer where most are faint.

    Returns:
        The threshold of their cells; those within tiles; and how many faint ones were saved.

    Raises:
        DataError: a block is damaged.
    """

    def cut_for(budget: int) -> tuple[tuple[float, StoredGaussians], int, bool]:
        threshold = cut.pyramid.threshold(budget)
        thresholds = np.full((len(cut.pyramid), 1), threshold)
        found = make_regions(run, run_pass, cut, thresholds, least=False)
        logits = found.field("opacity_logits-0")
        return (threshold, found), len(logits), 2 * int((logits < FAINT_LOGIT).sum()) > len(logits)

    (threshold, stored), removed = thin(cut.plan.budget, cut_for)
    if removed:
        run.skip(f"{removed} Gaussians", TOO_FAINT)
    return threshold, stored, removed


@contextmanager
def _sink(store: BlockStore, output: str, overwrite: bool) -> Iterator[IO[bytes]]:
    """Yield a file to write to; once it is complete, it replaces the output or is copied to standard output."""
    if output == STDOUT:
        with tempfile.TemporaryFile(dir=store.folder) as sink:
            yield sink
            sink.seek(0)
            shutil.copyfileobj(sink, sys.stdout.buffer)
            sys.stdout.buffer.flush()
        return
    with atomic_write(output, overwrite) as temporary, open(temporary, "wb") as sink:
        yield sink


def scored_views(size: int) -> list[Picture]:
    """List the blocks of three test views of ``size`` px."""
    from vvgt_cli.dvr import RenderSettings

    cameras = default_views("test", size=size)
    settings = RenderSettings(samples=RAYS_A_PIXEL)
    return [Picture(cameras[i], settings, spread_blocks(size, size, i, BLOCKS_A_VIEW)) for i in PREVIEW_VIEWS]


def score_gaussians(gaussians: Gaussians, store: BlockStore, plan: ShardPlan, rule: str | Rule = INRIA) -> Scores:
    """Score Gaussians (box frame), drawn by a rule, on the stored views; raise DataError if a block is damaged."""
    from vvgt_cli.images.metrics import score_views
    from vvgt_cli.splat import render

    rays = RayFile(str(store.folder / f"{plan.rays}.npz"), plan.rays)
    x, y, z = plan.grid.blocks.dims
    seen = composed(rays, store, range(len(plan.grid.blocks)), (x, y, z))
    views = scored_views(plan.size)

    def picked(view: Picture) -> np.ndarray:
        drawn = render(gaussians, view.camera, rule, blocks=view.blocks)
        shown = drawn if view.blocks is None else drawn[view.blocks.mask()]
        return shown.reshape(-1, 1, 4)

    whole = [rays.mean(axis=1, keepdims=True).astype(np.float32) for rays in seen]
    return score_views(whole, map(picked, views), perceptual=False)


def score_text(scores: Scores, size: int) -> str:
    """Return the scores as a message."""
    from vvgt_cli.score.views import psnr_note

    return f"{psnr_note(scores)}, blocks of {scores.views} views of {size} px, through all voxels"


def drawing_bytes(gaussians: int, size: int) -> int:
    """Return the bytes of memory for scoring a number of Gaussians."""
    return A_GAUSSIAN * gaussians + 2 * 16 * size**2
