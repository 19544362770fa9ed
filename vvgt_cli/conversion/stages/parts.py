"""The stages of a conversion out of core: Gaussians part by part, or levels of them, from blocks of the volume."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.blocks import spread_blocks
from vvgt_cli.conversion.cut import CutPlan, FinishedParts, cut_of, disk_bytes
from vvgt_cli.conversion.parts import Refiner, choose_levels, closed_form_parts, make_parts
from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.conversion.stages.closed_form import ClosedFormStage
from vvgt_cli.conversion.stages.refinement import HARMONICS, early_end, steps_in_time
from vvgt_cli.field.block_store import CELLS
from vvgt_cli.field.blocked import Blocked
from vvgt_cli.field.digests import digest
from vvgt_cli.field.field import Picture
from vvgt_cli.field.rays import RayFile, composed
from vvgt_cli.field.settings import MANY
from vvgt_cli.field.workload import Workload, pace
from vvgt_cli.files import check_disk_space
from vvgt_cli.gaussians.outputs import write_text
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.jit.ahead import OPTIMIZE, for_degree
from vvgt_cli.resources import free_memory
from vvgt_cli.score.viewing import PREVIEW_VIEWS

if TYPE_CHECKING:
    from vvgt_cli.score.record import Run

A_STEP, A_WRITE = 5e-7, 2e-5  # seconds a Gaussian: of a step with its share of views, and of the file
BLOCKS_A_VIEW = 64  # of 16 x 16 px, by which test views are scored without the volume
RAYS_A_PIXEL = 2  # along its edge
A_GAUSSIAN = 400  # bytes to draw a Gaussian


@dataclass(frozen=True)
class OutOfCore(Stage):
    """Gaussians made part by part from blocks of the volume, with cells and results on disk.

    Attributes:
        steps: maximum number of gradient descent steps in each part.
        levels: whether they are levels of detail, for `lod-meta.json`.
        together: whether all are held in memory afterwards, for stages that follow.
        alone: whether the volume is not at hand when they are scored, so that test views are cast with the blocks.
    """

    name: ClassVar[str] = "parts"
    steps: int = 0
    levels: bool = False
    together: bool = False
    alone: bool = False

    def cost(self, workload: Workload) -> Cost:
        """Return the cost of the closed form and of the steps, on one processor."""
        formed = ClosedFormStage().cost(workload)
        steps = A_STEP * HARMONICS[workload.degree] * self.steps + A_WRITE
        seconds = formed.seconds + workload.pace * steps * workload.gaussians
        return Cost(seconds, formed.memory if self.together else 0.0)

    def label(self) -> str:
        """Return what is made, and the number of steps."""
        return f"{'levels' if self.levels else 'parts'}, {self.steps} steps"

    def run(self, work: Work) -> None:
        """Make the Gaussians; raise MissingBlocks if blocks of other shards are missing."""
        run, field = work.run, work.field
        assert isinstance(field, Blocked)
        if self.together and self.steps:
            run.console.message(f"more than {MANY:,} Gaussians: refined part by part (docs/blocks.md)")
        if self.alone:
            field.views.expect(cast_views(work.fit.screen))
        make_blocks(work, field)
        if field.run_pass.shard is not None:
            return
        cut = cut_of(run, field.run_pass)
        if self.levels:
            work.levels = choose_levels(run, field.run_pass, cut, partial(self._refiner, work, field))
            return
        made = closed_form_parts(run, field.run_pass, cut)
        if (refiner := self._refiner(work, field)) is not None:
            everywhere = cut.everywhere(made.threshold)
            made = replace(made, stored=make_parts(run, field.run_pass, cut, everywhere, refiner, least=False))
        work.parts = made
        if self.together:
            work.gaussians = made.gathered()

    def _refiner(self, work: Work, field: Blocked) -> Refiner | None:
        """Return what refines parts by as many steps as there is time for, and a network; None for neither."""
        fit, steps, run = work.fit, self.steps, work.run
        chosen = field.run_pass.store.folder / f"steps-{digest(steps, fit.time_budget)[:16]}"
        if chosen.is_file():
            steps = int(chosen.read_text("ascii"))
            run.console.message(f"{steps} steps in the time budget, as the interrupted run chose")
        elif steps and fit.time_budget is not None:
            each = A_STEP * pace() * HARMONICS[work.degree] * fit.max_gaussians / field.run_pass.runner.workers
            left = fit.time_budget - run.elapsed() - A_WRITE * fit.max_gaussians
            steps = steps_in_time(steps, left, lambda steps: steps * each)
            if not steps:
                run.skip("refinement", f"{max(left, 0.0):.1f} s remain")
            write_text(chosen, str(steps), overwrite=True)
        if not steps and fit.model is None:
            return None
        if fit.device != "cpu":
            run.console.message("steps on parts are taken on the CPU")
        run.compile(for_degree(OPTIMIZE, work.degree))
        plain = replace(fit, steps=steps, device="cpu", time_budget=None, max_megabytes=None)
        return Refiner(field.reader, field.light, plain, early_end(fit))


def make_blocks(work: Work, field: Blocked) -> None:
    """Integrate the blocks of a field, or reuse them, and save the plan of the file beside them.

    Raises:
        MissingBlocks: blocks of other shards are missing.
        DataError: the disk is too small.
    """
    from vvgt_cli.closed_form.closed_form import most_cells

    run, fit, source, store = work.run, work.fit, field.source, field.run_pass.store
    cells = field.cells(fit.screen, most_cells(fit.max_gaussians, on_disk=True))
    CutPlan(
        cells.grid, fit.max_gaussians, fit.screen, source.volume.direction, work.ply, run.report.volume,
        run.report.transfer_function, "" if cells.rays is None else cells.rays.kind, source.labels_alone, work.degree,
        field.reader.voxel_bytes,
    ).save(store, cells.light)  # fmt: skip
    rays = 0 if cells.rays is None else sum(len(cast.pixels) * len(cast.offsets) for cast in cells.rays.bundles())
    need = disk_bytes(cells.grid, field.visible, fit.max_gaussians, rays, cells.light is not None, work.degree)
    need -= store.bytes(CELLS)
    if need > 0 and store.missing(CELLS, range(len(cells))):
        run.console.message(f"on disk meanwhile: about {need / 1e6:.0f} MB in {store.folder}")
        check_disk_space(store.folder, need)
    with run.stage("integrate") as stage:
        done = field.run_pass(cells, "integrate")
        workers = field.run_pass.runner.workers
        stage.note = f"{done} of {len(cells)} blocks" + (f", {workers} workers" if workers > 1 else "")
    field.grid = cells.grid


@dataclass(frozen=True)
class StoredViews(Stage):
    """Scores on test views that were cast with the blocks; skipped where memory does not allow drawing."""

    name: ClassVar[str] = "test views"
    scores: ClassVar[bool] = True

    def cost(self, workload: Workload) -> Cost:
        """Return the cost of drawing, which is small."""
        return Cost(0.0, drawing_bytes(int(workload.gaussians), workload.size))

    def run(self, work: Work) -> None:
        """Score the parts."""
        assert work.parts is not None
        score_parts(work.run, work.parts)


def cast_views(size: int) -> list[Picture]:
    """List the blocks of three test views of ``size`` px."""
    from vvgt_cli.dvr import RenderSettings

    cameras = default_views("test", size=size)
    settings = RenderSettings(samples=RAYS_A_PIXEL)
    return [Picture(cameras[i], settings, spread_blocks(size, size, i, BLOCKS_A_VIEW)) for i in PREVIEW_VIEWS]


def score_parts(run: Run, parts: FinishedParts) -> None:
    """Score parts on the views that were cast with their blocks; raise DataError if a block is damaged."""
    from vvgt_cli.images.metrics import score_views
    from vvgt_cli.score.views import psnr_note
    from vvgt_cli.splat import render

    plan, store, free = parts.cut.plan, parts.cut.store, free_memory()
    if free is not None and (need := drawing_bytes(len(parts), plan.size)) >= free:
        run.skip("test views", f"drawing {len(parts)} Gaussians needs about {need / 2**30:.1f} GiB of memory")
        return
    with run.stage("test views") as stage:
        rays = RayFile(str(store.folder / f"{plan.rays}.npz"), plan.rays)
        x, y, z = plan.grid.blocks.dims
        seen = composed(rays, store, range(len(plan.grid.blocks)), (x, y, z))
        gaussians, views = parts.gathered(), cast_views(plan.size)

        def picked(view: Picture) -> np.ndarray:
            drawn = render(gaussians, view.camera, plan.ply.rule or INRIA, blocks=view.blocks)
            shown = drawn if view.blocks is None else drawn[view.blocks.mask()]
            return shown.reshape(-1, 1, 4)

        whole = [rays.mean(axis=1, keepdims=True).astype(np.float32) for rays in seen]
        scores = score_views(whole, map(picked, views), perceptual=False)
        run.report.scores = asdict(scores)
        stage.note = f"{psnr_note(scores)}, blocks of {scores.views} views of {plan.size} px, through all voxels"


def drawing_bytes(gaussians: int, size: int) -> int:
    """Return the bytes of memory for scoring a number of Gaussians."""
    return A_GAUSSIAN * gaussians + 2 * 16 * size**2
