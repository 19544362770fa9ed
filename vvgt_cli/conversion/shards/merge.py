"""The merge of blocks to a file: visibility by the coarse grid, a threshold for the budget, Gaussians in batches."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import IO, TYPE_CHECKING, NamedTuple

import numpy as np

from vvgt_cli.conversion.request import HARMONIC_BYTES, VERTEX_BYTES
from vvgt_cli.conversion.shards.cut import Cut
from vvgt_cli.conversion.shards.plan import Plan, load_light
from vvgt_cli.conversion.shards.score import drawing_bytes, score_gaussians, score_text
from vvgt_cli.conversion.shards.streamed import write_streamed
from vvgt_cli.conversion.stages.closed_form import FAINT_LOGIT, NEARLY, TOO_FAINT, thin
from vvgt_cli.dvr.render import Box
from vvgt_cli.errors import NothingVisible
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.files import atomic_write, check_disk_space, is_stream
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
    from vvgt_cli.conversion.shards.regions import Refiner
    from vvgt_cli.dvr.layout import Light
    from vvgt_cli.field.tiled_tree import Coarse, TiledTree
    from vvgt_cli.gaussians import Gaussians

SCRATCH = "scores"


def write_merged(
    run: Run, store: BlockStore, output: str, overwrite: bool, refiner: Callable[[], Refiner | None] = lambda: None
) -> None:
    """Cut the pyramid of all blocks for the plan's budget, write the file and fill in the report.

    Args:
        run: gets the stages.
        store: complete blocks.
        output: a `.ply`, the manifest of levels, or a stream.
        overwrite: replace an existing file.
        refiner: returns what refines streamed levels, or None for the closed form.

    Raises:
        DataError: blocks are missing or damaged, or nothing is visible.
        UsageError: the output may not be written.
    """
    cut = cut_of(run, store)
    plan, report = cut.plan, run.report
    report.volume, report.transfer_function = plan.volume, plan.function
    report.options = {"max_gaussians": plan.budget, "size": plan.size, "frame": plan.ply.frame, "up": plan.ply.up}
    if is_streamed(output):
        write_streamed(run, store, cut, output, overwrite, refiner)
        return
    _write_ply(run, store, cut, output, overwrite)


def cut_of(run: Run, store: BlockStore) -> Cut:
    """Return the pyramid of all blocks, ready to be cut.

    Raises:
        NothingVisible, DataError: see `pyramid`.
    """
    plan = Plan.load(store)
    light = load_light(store, plan)
    run.compile(for_degree((*MERGE, *(SHADE if light else ())), plan.degree))
    with run.stage("pyramid") as stage:
        tiled_tree, opaque = pyramid(store, plan, light)
        stage.note = f"{tiled_tree.base} cells in {len(tiled_tree.tiles)} tiles"
    return Cut(tiled_tree, opaque, plan, light)


def _write_ply(run: Run, store: BlockStore, cut: Cut, output: str, overwrite: bool) -> None:
    """Write a `.ply`, and record its Gaussians, bytes and, where memory allows drawing it, scores."""
    plan, size = cut.plan, cut.plan.size
    with run.stage("write") as stage, _sink(store, output, overwrite) as sink:
        made, removed = thin(plan.budget, lambda budget: _write(cut, budget, sink, output))
        count, written = made.total, sink.tell()
        stage.note = f"{output}: {count} Gaussians, {written / 1e6:.1f} MB"
        if not removed and count < NEARLY * plan.budget:
            base = cut.tiled_tree.base
            stage.note += f", no more: {base} cells suffice for the screen and {plan.budget} Gaussians"
    if removed:
        run.skip(f"{removed} Gaussians", TOO_FAINT)
    run.report.gaussians, run.report.bytes = count, written
    if made.batches is None:
        need = drawing_bytes(count, size)
        run.skip("test views", f"drawing {count} Gaussians needs about {need / 2**30:.1f} GiB of memory")
    else:
        with run.stage("test views") as stage:
            found = score_gaussians(concatenate(made.batches), store, plan, plan.ply.rule or INRIA)
            run.report.scores, stage.note = asdict(found), score_text(found, size)


def pyramid(store: BlockStore, plan: Plan, light: Light | None = None) -> tuple[TiledTree, Opaque]:
    """Return the pyramid of all blocks, and the regions where bodies are opaque.

    Raises:
        NothingVisible: nothing is visible from any view.
        DataError: blocks are missing or damaged.
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
    """A written cut: number of Gaussians, and the Gaussians, box frame; None where memory is too small to draw them."""

    total: int
    batches: list[Gaussians] | None


def _write(cut: Cut, budget: int, sink: IO[bytes], output: str) -> tuple[Made, int, bool]:
    """Write the cut for a budget; return it, the number of its Gaussians, and whether most are faint (see `thin`)."""
    from vvgt_cli.closed_form.lit import directions

    plan, free, threshold = cut.plan, free_memory(), cut.tiled_tree.threshold(budget)
    axes, turned = np.array(plan.axes).reshape(3, 3), np.linalg.inv(np.array(plan.axes).reshape(3, 3))
    degree = plan.written_degree
    count = cut.tiled_tree.count(threshold)
    if output != STDOUT:
        check_disk_space(output, count * (VERTEX_BYTES + HARMONIC_BYTES[degree]))
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
    return Made(count, kept), count, 2 * faint > count


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
