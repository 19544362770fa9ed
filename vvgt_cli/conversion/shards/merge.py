"""The merge of blocks to a file: visibility by the coarse grid, a threshold for the budget, Gaussians in batches."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from itertools import chain
from typing import IO, TYPE_CHECKING

import numpy as np

from vvgt_cli.conversion.request import HARMONIC_BYTES, VERTEX_BYTES
from vvgt_cli.conversion.shards.cut import Cut, cut_of
from vvgt_cli.conversion.shards.regions import Made, Refiner, make_regions
from vvgt_cli.conversion.shards.score import drawing_bytes, score_gaussians, score_text
from vvgt_cli.conversion.shards.streamed import write_streamed
from vvgt_cli.conversion.stages.closed_form import FAINT_LOGIT, NEARLY, TOO_FAINT, thin
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.files import atomic_write, check_disk_space, is_stream
from vvgt_cli.gaussians.formats.streamed import is_streamed
from vvgt_cli.gaussians.frames import transform
from vvgt_cli.gaussians.outputs import STDOUT
from vvgt_cli.gaussians.ply import ply_header, ply_rows
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.gaussians.types import concatenate
from vvgt_cli.resources import free_memory
from vvgt_cli.score.record import Run

if TYPE_CHECKING:
    from vvgt_cli.field.blocked import Pass
    from vvgt_cli.gaussians import Gaussians


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
    threshold, made, removed = closed_form(run, run_pass, cut)
    over = cut.over_tiles(threshold)
    count = int(made.field("counts").sum()) + (0 if over is None else len(over[0]))
    axes, turned = np.array(plan.axes).reshape(3, 3), np.linalg.inv(np.array(plan.axes).reshape(3, 3))
    degree = plan.written_degree
    if output != STDOUT:
        check_disk_space(output, count * (VERTEX_BYTES + HARMONIC_BYTES[degree]))
    kept: list[Gaussians] | None = [] if free is None or drawing_bytes(count, size) < free else None
    with run.stage("write") as stage, _sink(store, output, overwrite) as sink:
        sink.write(ply_header(count, degree, plan.ply))
        for gaussians, normals in chain(made.regions(), [] if over is None else [over]):
            normals = None if normals is None else directions(normals @ turned)
            sink.write(ply_rows(transform(gaussians, axes), plan.ply, normals).data)
            if kept is not None:
                kept.append(gaussians)
        written = sink.tell()
        stage.note = f"{output}: {count} Gaussians, {written / 1e6:.1f} MB"
        if not removed and count < NEARLY * plan.budget:
            base = cut.tiled_tree.base
            stage.note += f", no more: {base} cells suffice for the screen and {plan.budget} Gaussians"
    run.report.gaussians, run.report.bytes = count, written
    if kept is None:
        need = drawing_bytes(count, size)
        run.skip("test views", f"drawing {count} Gaussians needs about {need / 2**30:.1f} GiB of memory")
    else:
        with run.stage("test views") as stage:
            found = score_gaussians(concatenate(kept), store, plan, plan.ply.rule or INRIA)
            run.report.scores, stage.note = asdict(found), score_text(found, size)


def closed_form(run: Run, run_pass: Pass, cut: Cut) -> tuple[float, Made, int]:
    """Make the Gaussians of a plan's budget, or fewer where most are faint.

    Returns:
        The threshold of their cells; those within tiles; and how many faint ones were saved.

    Raises:
        DataError: a block is damaged.
    """

    def cut_for(budget: int) -> tuple[tuple[float, Made], int, bool]:
        threshold = cut.tiled_tree.threshold(budget)
        thresholds = np.full((len(cut.tiled_tree.tiles), 1), threshold)
        found = make_regions(run, run_pass, cut, thresholds, least=False)
        logits = found.field("opacity_logits-0")
        return (threshold, found), len(logits), 2 * int((logits < FAINT_LOGIT).sum()) > len(logits)

    (threshold, made), removed = thin(cut.plan.budget, cut_for)
    if removed:
        run.skip(f"{removed} Gaussians", TOO_FAINT)
    return threshold, made, removed


@contextmanager
def _sink(store: BlockStore, output: str, overwrite: bool) -> Iterator[IO[bytes]]:
    """Yield a file to write to; once complete, it replaces the output or is copied to its pipe."""
    if output != STDOUT and not is_stream(output):
        with atomic_write(output, overwrite) as temporary, open(temporary, "w+b") as sink:
            yield sink
        return
    with tempfile.TemporaryFile(dir=store.folder) as sink:
        yield sink
        sink.seek(0)
        if output == STDOUT:
            shutil.copyfileobj(sink, sys.stdout.buffer)
            sys.stdout.buffer.flush()
        else:
            with open(output, "ab") as stream:
                shutil.copyfileobj(sink, stream)
