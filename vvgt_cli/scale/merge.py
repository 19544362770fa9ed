"""From blocks to a file: visibility through the coarse grid, a threshold for the budget, Gaussians in batches."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import IO, TYPE_CHECKING, NamedTuple

import numpy as np

from vvgt_cli.conversion.request import VERTEX_BYTES
from vvgt_cli.conversion.stages.closed_form import FAINT_LOGIT, FEWEST, NEARLY
from vvgt_cli.errors import NothingVisible
from vvgt_cli.files import atomic_write, check_room, is_stream
from vvgt_cli.gaussians.frames import transform
from vvgt_cli.gaussians.ply import as_stored, ply_header, ply_rows
from vvgt_cli.gaussians.types import together
from vvgt_cli.jit.ahead import MERGE
from vvgt_cli.resources import free_memory
from vvgt_cli.runs.outputs import STDOUT
from vvgt_cli.runs.record import Run
from vvgt_cli.scale.parts import Parts
from vvgt_cli.scale.plan import Plan
from vvgt_cli.scale.sight import Box, drawing_bytes, score_gaussians, score_text
from vvgt_cli.splat.rules import INRIA

if TYPE_CHECKING:
    from vvgt_cli.gaussians import Gaussians
    from vvgt_cli.scale.forest import Coarse, Forest
    from vvgt_cli.vbm.inset import Opaque

BATCH = 1 << 16  # Gaussians that are made at once
SCRATCH = "scores"


def write_merged(run: Run, parts: Parts, output: str, overwrite: bool) -> None:
    """Cut the pyramid over all parts for the plan's budget and write it; fills the report in.

    Raises:
        DataError: parts are missing or damaged, or nothing is visible.
        UsageError: an output that may not be written.
    """
    plan = Plan.load(parts)
    report = run.report
    report.volume, report.transfer_function = plan.volume, plan.function
    report.options = {"max_gaussians": plan.budget, "size": plan.size, "frame": plan.ply.frame, "up": plan.ply.up}
    run.compile(MERGE)
    with run.stage("pyramid") as stage:
        forest, opaque = pyramid(parts, plan)
        stage.note = f"{forest.base} cells in {len(forest.tiles)} tiles"
    with run.stage("write") as stage, _sink(parts, output, overwrite) as sink:
        made, spared = _write(forest, opaque, plan, sink, output)
        count = made.total
        report.gaussians, report.bytes = count, sink.tell()
        stage.note = f"{output}: {count} Gaussians, {report.bytes / 1e6:.1f} MB"
        if not spared and count < NEARLY * plan.budget:
            stage.note += f", no more: {forest.base} cells that the screen, or {plan.budget} Gaussians, have use for"
    if spared:
        run.leave_out(f"{spared} Gaussians", "so faint that viewers differ on what they draw of them")
    _score(run, parts, plan, made)


def _score(run: Run, parts: Parts, plan: Plan, made: Made) -> None:
    """The file against pixels of the volume itself, every voxel of it."""
    if made.batches is None:
        need = drawing_bytes(made.total, plan.size)
        run.leave_out("test views", f"{made.total} Gaussians at once need about {need / 2**30:.1f} GiB of memory")
        return
    with run.stage("test views") as stage:
        scores = score_gaussians(together(made.batches), parts, plan.grid, plan.size, plan.ply.rule or INRIA)
        run.report.scores = asdict(scores)
        stage.note = score_text(scores, plan.size)


def pyramid(parts: Parts, plan: Plan) -> tuple[Forest, Opaque]:
    """The pyramid over all parts, and where bodies are opaque.

    Raises:
        NothingVisible: from no view.
        DataError: parts are missing or damaged.
    """
    from vvgt_cli.cameras import default_views
    from vvgt_cli.scale.forest import Forest, gather
    from vvgt_cli.vbm.closed_form import MARCH_SIZE
    from vvgt_cli.vbm.visibility import seen_through

    grid, coarse = plan.grid, gather(parts, plan.grid)
    wide = grid.cell * 2.0**grid.march
    box = Box(np.array(grid.half), np.array(grid.step))
    extinction = (coarse.mass / (wide * box.step).prod()).astype(np.float32)
    seen = seen_through(extinction, wide, box, default_views("train", size=MARCH_SIZE))
    forest = Forest(parts, grid, seen, coarse, parts.folder / SCRATCH)
    if forest.top is None:
        raise NothingVisible(plan.volume["name"], plan.function["name"])
    return forest, _opaque(coarse, plan)


def _opaque(coarse: Coarse, plan: Plan) -> Opaque:
    from vvgt_cli.vbm.inset import SURFACE, nowhere, smoothed

    grid, half = plan.grid, np.array(plan.grid.half)
    edge = grid.cell_edge * 2.0**grid.field
    return nowhere(edge, half) if coarse.deepest < SURFACE else smoothed(coarse.field, edge, half)


class Made(NamedTuple):
    """What was written: how many Gaussians, and themselves in the box frame, None where the memory holds no drawing."""

    total: int
    batches: list[Gaussians] | None


def _write(forest: Forest, opaque: Opaque, plan: Plan, sink: IO[bytes], output: str) -> tuple[Made, int]:
    """Write the file; what it has, and how many Gaussians are left out since they would be too faint."""
    budget, first, free = plan.budget, 0, free_memory()
    axes = np.array(plan.axes).reshape(3, 3)
    while True:
        threshold = forest.threshold(budget)
        count = forest.count(threshold)
        first = first or count
        if output != STDOUT:
            check_room(output, count * VERTEX_BYTES)
        sink.seek(0)
        sink.truncate()
        sink.write(ply_header(count, plan.ply.sh_degree or 0, plan.ply))
        kept: list[Gaussians] | None = [] if free is None or drawing_bytes(count, plan.size) < free else None
        faint = 0
        for gaussians in gaussians_of(forest, opaque, plan, threshold):
            sink.write(ply_rows(transform(gaussians, axes), plan.ply).data)
            faint += int((gaussians.opacity_logits < FAINT_LOGIT).sum())
            if kept is not None:
                kept.append(gaussians)
        if 2 * faint <= count or budget < 2 * FEWEST:
            return Made(count, kept), first - count
        budget //= 2


def cut(forest: Forest, opaque: Opaque, plan: Plan) -> tuple[Gaussians, int]:
    """All Gaussians at once, box frame, as a file holds them; and how many are left out since they would be too faint.

    The plan's budget is halved as where they are written.
    """
    budget, first = plan.budget, 0
    while True:
        made = together(list(gaussians_of(forest, opaque, plan, forest.threshold(budget))))
        first = first or len(made)
        if 2 * int((made.opacity_logits < FAINT_LOGIT).sum()) <= len(made) or budget < 2 * FEWEST:
            return made, first - len(made)
        budget //= 2


def gaussians_of(forest: Forest, opaque: Opaque, plan: Plan, threshold: float) -> Iterator[Gaussians]:
    """Gaussians of the cells that a threshold leaves, in the box frame, as a file holds them, in batches."""
    from vvgt_cli.scale.forest import batches
    from vvgt_cli.vbm.closed_form import pixel_width
    from vvgt_cli.vbm.shape import ROUND, cell_gaussians

    voxel, pixel = min(plan.grid.step), pixel_width(plan.size)
    for leaves in batches(forest.leaves(threshold), BATCH):
        yield as_stored(cell_gaussians(leaves, voxel, pixel, opaque, ROUND))


@contextmanager
def _sink(parts: Parts, output: str, overwrite: bool) -> Iterator[IO[bytes]]:
    """A file to write to, which takes the output's place, or goes down its pipe, when it is whole."""
    if output != STDOUT and not is_stream(output):
        with atomic_write(output, overwrite) as temporary, open(temporary, "w+b") as sink:
            yield sink
        return
    with tempfile.TemporaryFile(dir=parts.folder) as sink:
        yield sink
        sink.seek(0)
        if output == STDOUT:
            shutil.copyfileobj(sink, sys.stdout.buffer)
            sys.stdout.buffer.flush()
        else:
            with open(output, "ab") as stream:
                shutil.copyfileobj(sink, stream)
