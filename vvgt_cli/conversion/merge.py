"""The blocks of a volume by shards, and `vvgt merge`: a file of Gaussians from them, without the volume."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

from vvgt_cli.conversion.cut import CutPlan, cut_of
from vvgt_cli.conversion.fitting import fit, work_of
from vvgt_cli.conversion.gaussian_files import write_parts
from vvgt_cli.conversion.levels import write_levels
from vvgt_cli.conversion.opened import open_field
from vvgt_cli.conversion.parts import choose_levels, closed_form_parts
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.conversion.stages.parts import score_parts
from vvgt_cli.errors import UsageError
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.field.blocked import MissingBlocks, Pass
from vvgt_cli.field.open import runner_of, thread_count
from vvgt_cli.field.settings import BlockOptions, worker_count
from vvgt_cli.gaussians.formats import format_of
from vvgt_cli.gaussians.formats.streamed import MANIFEST, folder_of, is_streamed
from vvgt_cli.gaussians.outputs import STDOUT, Output, claimed
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run

DERIVED = ("coarse", "trees", "closed-", "errors-", "written-")  # what a merge adds to a folder of blocks


def write_shard(request: ConvertRequest, console: Console | None = None) -> ConversionReport:
    """Process the blocks of a shard that can be processed now, for `vvgt merge`, and report what remains.

    Raises:
        UsageError, DataError: see `convert`; a shard with a scheduler, a report or levels.
    """
    options, run = request.blocks, Run(console or Console(), ConversionReport("init"))
    if options is None or options.scheduler is not None:
        raise UsageError("--shard and --scheduler both distribute the blocks; give one of them")
    levels = is_streamed(request.output)
    if request.output in (None, STDOUT) or request.report or levels or not request.out_of_core:
        raise UsageError(
            "--shard: expected a folder of blocks as -o, no --report and no --init; 'vvgt merge' makes the .ply or "
            "lod-meta.json (docs/cluster.md)"
        )
    try:
        with open_field(run, request) as field:
            work = work_of(run, request, field)
            fit(work, request)
    except MissingBlocks as later:
        run.console.message(
            f"{later.what}: this shard is done, {later.missing} blocks of other shards are missing; run the same array "
            "again once they are complete"
        )
    else:
        run.console.message(f"all blocks are complete; next: vvgt merge {request.output} -o OUT.ply")
    return run.finish()


def merge(folder: str, output: str, overwrite: bool = False, console: Console | None = None) -> ConversionReport:
    """Make a `.ply`, or streamed SOG, of the blocks that shards have written into a folder, and return the report.

    Raises:
        UsageError: the folder has no blocks, or the output may not be written.
        DataError: blocks are missing or damaged.
    """
    run = Run(console or Console(), ConversionReport("merge"))
    store = BlockStore(Path(folder).absolute())
    store.settings()
    plan, threads = CutPlan.load(store), thread_count()
    workers = worker_count(BlockOptions(), math.prod(plan.grid.blocks.dims), plan.budget, threads)
    endings = (MANIFEST,) if is_streamed(output) else (".ply",)
    if not is_streamed(output) and format_of(output) is not None:
        raise UsageError(f"-o {output}: expected a .ply, or lod-meta.json; 'vvgt view OUT.ply -o {output}' encodes it")
    with (
        folder_of(output),
        claimed([Output("-o", output, endings, splats=True)], [], overwrite),
        runner_of(BlockOptions(workers=workers), threads) as runner,
    ):
        run_pass = Pass(runner, store, run.console.bar)
        cut = cut_of(run, run_pass)
        run.report.volume, run.report.transfer_function = plan.volume, plan.function
        run.report.options = {
            "max_gaussians": plan.budget, "screen": plan.size, "frame": plan.ply.frame, "up": plan.ply.up
        }  # fmt: skip
        if is_streamed(output):
            write_levels(run, run_pass, choose_levels(run, run_pass, cut), output, overwrite, plan.ply)
        else:
            parts = closed_form_parts(run, run_pass, cut)
            write_parts(run, output, parts, overwrite)
            score_parts(run, parts)
    for kind in store.folder.iterdir():
        if kind.name.startswith(DERIVED):
            shutil.rmtree(kind)
    return run.finish()
