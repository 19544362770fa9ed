"""From blocks to a file: visibility through the coarse grid, a threshold for the budget, Gaussians in batches."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import IO, TYPE_CHECKING, NamedTuple

import numpy as np

from vvgt_cli.conversion.request import HARMONIC_BYTES, VERTEX_BYTES
from vvgt_cli.conversion.shards.cut import Cut
from vvgt_cli.conversion.shards.plan import Plan, load_light
from vvgt_cli.conversion.shards.score import drawing_bytes, score_gaussians, score_text
from vvgt_cli.conversion.shards.streamed import write_streamed
from vvgt_cli.conversion.stages.closed_form import FAINT_LOGIT, FEWEST, NEARLY
from vvgt_cli.dvr.render import Box
from vvgt_cli.errors import NothingVisible
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.files import atomic_write, check_room, is_stream
from vvgt_cli.gaussians.formats.streamed import is_streamed
from vvgt_cli.gaussians.frames import transform
from vvgt_cli.gaussians.outputs import STDOUT
from vvgt_cli.gaussians.ply import ply_header, ply_rows
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.gaussians.types import concatenate
from vvgt_cli.jit.ahead import MERGE, SHADE, for_degree
from vvgt_cli.resources import free_memory
from vvgt_cli.score.record import Run

if TYPE_CHECKING:
    from vvgt_cli.closed_form.surface_offset import Opaque
    from vvgt_cli.dvr.layout import Light
    from vvgt_cli.field.tiled_tree import Coarse, TiledTree
    from vvgt_cli.gaussians import Gaussians

SCRATCH = "scores"


def write_merged(run: Run, store: BlockStore, output: str, overwrite: bool) -> None:
    """Cut the pyramid over all parts for the plan's budget and write it; fills the report in.

    Raises:
        DataError: parts are missing or damaged, or nothing is visible.
        UsageError: an output that may not be written.
    """
    plan = Plan.load(store)
    report = run.report
    report.volume, report.transfer_function = plan.volume, plan.function
    report.options = {"max_gaussians": plan.budget, "size": plan.size, "frame": plan.ply.frame, "up": plan.ply.up}
    light = load_light(store, plan)
    run.compile(for_degree((*MERGE, *(SHADE if light else ())), plan.degree))
    with run.stage("pyramid") as stage:
        tiled_tree, opaque = pyramid(store, plan, light)
        stage.note = f"{tiled_tree.base} cells in {len(tiled_tree.tiles)} tiles"
    if is_streamed(output):
        write_streamed(run, store, Cut(tiled_tree, opaque, plan, light), output, overwrite)
        return
    _write_ply(run, store, Cut(tiled_tree, opaque, plan, light), output, overwrite)


def _write_ply(run: Run, store: BlockStore, cut: Cut, output: str, overwrite: bool) -> None:
    """One file; how many Gaussians and bytes it has, and its scores where it is drawn, into the report."""
    plan, size = cut.plan, cut.plan.size
    with run.stage("write") as stage, _sink(store, output, overwrite) as sink:
        made, spared = _write(cut, sink, output)
        count, written = made.total, sink.tell()
        stage.note = f"{output}: {count} Gaussians, {written / 1e6:.1f} MB"
        if not spared and count < NEARLY * plan.budget:
            base = cut.tiled_tree.base
            stage.note += f", no more: {base} cells that the screen, or {plan.budget} Gaussians, have use for"
    if spared:
        run.leave_out(f"{spared} Gaussians", "so faint that viewers differ on what they draw of them")
    run.report.gaussians, run.report.bytes = count, written
    if made.batches is None:
        need = drawing_bytes(count, size)
        run.leave_out("test views", f"{count} Gaussians at once need about {need / 2**30:.1f} GiB of memory")
    else:
        with run.stage("test views") as stage:
            found = score_gaussians(concatenate(made.batches), store, plan, plan.ply.rule or INRIA)
            run.report.scores, stage.note = asdict(found), score_text(found, size)


def pyramid(store: BlockStore, plan: Plan, light: Light | None = None) -> tuple[TiledTree, Opaque]:
    """The pyramid over all parts, and where bodies are opaque.

    Raises:
        NothingVisible: from no view.
        DataError: parts are missing or damaged.
    """
    from vvgt_cli.cameras import default_views
    from vvgt_cli.closed_form.closed_form import MARCH_SIZE
    from vvgt_cli.closed_form.visibility import march_views
    from vvgt_cli.field.tiled_tree import TiledTree, gather

    grid, coarse = plan.grid, gather(store, plan.grid)
    wide = grid.cell * 2.0**grid.march
    box = Box(np.array(grid.half), np.array(grid.step))
    extinction = (coarse.mass / (wide * box.step).prod()).astype(np.float32)
    seen = march_views(extinction, wide, box, default_views("train", size=MARCH_SIZE))
    tiled_tree = TiledTree(store, grid, seen, coarse, store.folder / SCRATCH, light)
    if tiled_tree.top is None:
        raise NothingVisible(plan.volume["name"], plan.function["name"])
    return tiled_tree, _opaque(coarse, plan)


def _opaque(coarse: Coarse, plan: Plan) -> Opaque:
    from vvgt_cli.closed_form.surface_offset import SURFACE, nowhere, smoothed

    grid, half = plan.grid, np.array(plan.grid.half)
    edge = grid.cell_edge * 2.0**grid.field
    return nowhere(edge, half) if coarse.deepest < SURFACE else smoothed(coarse.field, edge, half)


class Made(NamedTuple):
    """What was written: how many Gaussians, and themselves in the box frame, None where the memory holds no drawing."""

    total: int
    batches: list[Gaussians] | None


def _write(cut: Cut, sink: IO[bytes], output: str) -> tuple[Made, int]:
    """Write the file; what it has, and how many Gaussians are left out since they would be too faint."""
    from vvgt_cli.closed_form.lit import directions

    plan, first, free = cut.plan, 0, free_memory()
    axes, turned = np.array(plan.axes).reshape(3, 3), np.linalg.inv(np.array(plan.axes).reshape(3, 3))
    degree = plan.degree if plan.ply.sh_degree is None else plan.ply.sh_degree
    while True:
        threshold = cut.tiled_tree.threshold(plan.budget)
        count = cut.tiled_tree.count(threshold)
        first = first or count
        if output != STDOUT:
            check_room(output, count * (VERTEX_BYTES + HARMONIC_BYTES[degree]))
        sink.seek(0)
        sink.truncate()
        sink.write(ply_header(count, degree, plan.ply))
        kept: list[Gaussians] | None = [] if free is None or drawing_bytes(count, plan.size) < free else None
        faint = 0
        for gaussians, normals in cut.gaussians(threshold):
            normals = None if normals is None else directions(normals @ turned)
            sink.write(ply_rows(transform(gaussians, axes), plan.ply, normals).data)
            faint += int((gaussians.opacity_logits < FAINT_LOGIT).sum())
            if kept is not None:
                kept.append(gaussians)
        if 2 * faint <= count or plan.budget < 2 * FEWEST:
            return Made(count, kept), first - count
        plan = replace(plan, budget=plan.budget // 2)


@contextmanager
def _sink(store: BlockStore, output: str, overwrite: bool) -> Iterator[IO[bytes]]:
    """A file to write to, which takes the output's place, or goes down its pipe, when it is whole."""
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
