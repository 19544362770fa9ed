"""`vvgt merge`: a file of Gaussians from the blocks that shards have written, without the volume."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

from vvgt_cli.conversion.cut import CutPlan, cut_of
from vvgt_cli.conversion.gaussian_files import write_parts
from vvgt_cli.conversion.levels import write_levels
from vvgt_cli.conversion.parts import FinishedParts, Levels
from vvgt_cli.conversion.stages.parts import score_parts
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.field.blocked import Pass
from vvgt_cli.field.open import runner_of, thread_count
from vvgt_cli.field.settings import BlockOptions, worker_count
from vvgt_cli.gaussians.formats.streamed import MANIFEST, folder_of, is_streamed
from vvgt_cli.gaussians.outputs import Output, claimed
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run

DERIVED = ("coarse", "trees", "closed-", "errors-", "written-")  # what a merge adds to a folder of blocks


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
    with (
        folder_of(output),
        claimed([Output("-o", output, endings, splats=True)], [], overwrite),
        runner_of(BlockOptions(workers=workers), threads) as runner,
    ):
        run_pass = Pass(runner, store, run.console.bar)
        cut = cut_of(run, run_pass)
        run.report.volume, run.report.transfer_function = plan.volume, plan.function
        run.report.options = {
            "max_gaussians": plan.budget, "size": plan.size, "frame": plan.ply.frame, "up": plan.ply.up
        }  # fmt: skip
        if is_streamed(output):
            write_levels(run, run_pass, Levels.chosen(run, run_pass, cut), output, overwrite, plan.ply)
        else:
            parts = FinishedParts.closed_form(run, run_pass, cut)
            write_parts(run, output, parts, overwrite)
            score_parts(run, parts)
    for kind in store.folder.iterdir():
        if kind.name.startswith(DERIVED):
            shutil.rmtree(kind)
    return run.finish()
