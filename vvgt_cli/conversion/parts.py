"""The Gaussians of a cut part by part, of the closed form or refined; a part is a task for any worker.

The Gaussians of a `vvgt_cli.field.part.VolumePart` are fitted to pictures of it alone. Premultiplied pictures compose
front to back. So if the Gaussians of every part show what the part shows, all of them show what the volume shows, and
parts can be fitted in any order, by any number of workers, without an exchange.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from vvgt_cli.cameras.sets import RADIUS, pixel_width
from vvgt_cli.conversion.cut import Cut, FinishedParts, Levels, Parts, StoredGaussians, TileGaussians, save
from vvgt_cli.conversion.level_selection import CUTS, STEP, CutErrors, errors_of
from vvgt_cli.conversion.levels import NEAREST
from vvgt_cli.conversion.request import FitOptions
from vvgt_cli.conversion.stage import Work
from vvgt_cli.conversion.stages.cells import Network
from vvgt_cli.conversion.stages.closed_form import FAINT_LOGIT, TOO_FAINT, halve_budget_while_faint
from vvgt_cli.conversion.stages.refinement import Refinement
from vvgt_cli.conversion.stages.views import CheckViews, TrainingViews, view_count
from vvgt_cli.dvr.layout import Light
from vvgt_cli.dvr.render import BoxFrame
from vvgt_cli.field.digests import digest
from vvgt_cli.field.part import VolumePart
from vvgt_cli.field.reader import Layers, Scalars
from vvgt_cli.gaussians import INRIA, Gaussians, as_stored, concatenate
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run

if TYPE_CHECKING:
    from vvgt_cli.field.blocked import Pass
    from vvgt_cli.field.field import Field


@dataclass(frozen=True)
class Refiner:
    """A volume and options for the refinement of its parts.

    Attributes:
        reader, light: see `vvgt_cli.field.cells.CellBlocks`.
        fit: options of the descent, which ends at the target PSNR on a part's own weighted check views.
        early: steps after which a part's descent may end (`early_end`).
        distances: distance from which each level is seen, unit frame.
    """

    reader: Scalars | Layers
    light: Light | None
    fit: FitOptions
    early: int | None = None
    distances: tuple[float, ...] = (RADIUS,)

    def text(self) -> str:
        """Return what happens in a part, for a message: a network, and the most steps where descent may end earlier."""
        most = "at most " if self.early is not None or self.fit.target_psnr is not None else ""
        steps = [f"{most}{self.fit.steps} steps"] if self.fit.steps else []
        return " and ".join([*([] if self.fit.model is None else ["the network"]), *steps])


@dataclass(frozen=True)
class PartTask:
    """The task of making the Gaussians of each part.

    Attributes:
        cut: cut to make.
        parts: division of its tiles.
        thresholds, least: see `Cut.nodes`.
        kind: kind of the results.
        refiner: refiner of the Gaussians, None for the closed form.
        compared: whether only errors of levels are saved, and how many Gaussians of the first are faint.
    """

    cut: Cut
    parts: Parts
    thresholds: np.ndarray
    least: bool
    kind: str
    refiner: Refiner | None = None
    compared: bool = False

    def __len__(self) -> int:
        """Return the number of parts."""
        return len(self.parts.ends)

    def __call__(self, number: int) -> None:
        """Save the nodes of part ``number``, and the errors of their levels if these are refined or compared."""
        nodes = self.cut.nodes(*self.parts.rows(number), self.thresholds, self.least)
        if self.refiner is not None:
            nodes = self._refined(nodes, number, self.refiner)
        errors: dict[str, np.ndarray] = {}
        if self.least and (self.refiner is not None or self.compared):
            errors = errors_of([node.levels for node in nodes], self.cut.plan.ply.rule or INRIA)
        if not self.compared:
            save(self.cut.store, self.kind, number, nodes, errors)
            return
        faint = [sum(int((node.levels[0].opacity_logits < FAINT_LOGIT).sum()) for node in nodes)]
        self.cut.store.save(self.kind, number, faint=np.array(faint), **errors)

    def _refined(self, nodes: list[TileGaussians], number: int, refiner: Refiner) -> list[TileGaussians]:
        """Return the nodes of a part, each level refined as a whole."""
        grid = self.cut.plan.grid
        frame = BoxFrame(np.array(grid.half), np.array(grid.step))
        part = VolumePart(refiner.reader, frame, grid.blocks.dims, *self.cut.box(self.parts, number), refiner.light)
        levels = []
        for k, distance in enumerate(refiner.distances):
            own = [node.levels[k] for node in nodes]
            refined = refine_part(part, concatenate(own), refiner, distance)
            ends = np.cumsum([len(each) for each in own])
            levels.append([refined.take(np.arange(e - len(each), e)) for each, e in zip(own, ends, strict=True)])
        return [
            TileGaussians(list(made), node.spreads, node.normals)
            for made, node in zip(zip(*levels, strict=True), nodes, strict=True)
        ]


def make_parts(
    run: Run, run_pass: Pass, cut: Cut, thresholds: np.ndarray, refiner: Refiner | None = None, least: bool = True
) -> StoredGaussians:
    """Make the Gaussians of a cut part by part; results of an interrupted run are reused.

    Args:
        run: gets a stage.
        run_pass: runs the pass over the parts.
        cut: cut to make.
        thresholds: see `Cut.nodes`.
        refiner: refiner of the Gaussians, None for the closed form.
        least: see `Cut.nodes`.

    Raises:
        DataError: a block is damaged.
    """
    parts = cut.parts(float(thresholds[0, 0]))
    steps: Any = None if refiner is None else (refiner.fit, refiner.distances, refiner.early)
    key = digest(cut.key, thresholds, steps, parts, least)[:16]
    kind = f"{'closed' if refiner is None else 'refined'}-{key}"
    task = PartTask(cut, parts, thresholds, least, kind, refiner)
    name = "closed form" if refiner is None else "refinement"
    with run.stage(name) as stage:
        run_pass(task, name)
        workers, edge = run_pass.runner.workers, int((parts.width * cut.plan.grid.tile).max())
        made = "" if refiner is None else f"{refiner.text()} in each of "
        stage.note = f"{made}{len(task)} parts of {edge} voxels" + (f", {workers} workers" if workers > 1 else "")
    return StoredGaussians(cut.store, kind, parts.ends)


def measured_cuts(run_pass: Pass, cut: Cut, budget: int) -> tuple[CutErrors, int]:
    """Make and draw `CUTS` cuts of every node, or reuse an interrupted run's.

    Args:
        run_pass: runs the pass over the parts.
        cut: pyramid to cut.
        budget: largest number of Gaussians of the finest cut.

    Returns:
        The errors; and how many Gaussians of the finest cut are faint (`FAINT_LOGIT`).

    Raises:
        DataError: a block is damaged.
    """
    tree, most = cut.pyramid, np.finfo(float).max
    finest = tree.threshold(budget)
    second = max(tree.threshold(max(int(tree.counts(finest).sum()) // 2, 1)), np.finfo(float).tiny)
    values = np.minimum(np.array([finest, *(second * STEP ** np.arange(CUTS - 1))]), most)
    parts, thresholds = cut.parts(finest), np.broadcast_to(values, (len(tree), CUTS))
    kind = f"errors-{digest(cut.key, values)[:16]}"
    run_pass(PartTask(cut, parts, thresholds, True, kind, compared=True), "errors")
    stored = StoredGaussians(cut.store, kind, parts.ends)
    return replace(stored.errors(), thresholds=values), int(stored.field("faint").sum())


def closed_form_parts(run: Run, run_pass: Pass, cut: Cut) -> FinishedParts:
    """Make the Gaussians of a cut's budget, or fewer where most are faint; raise DataError for damaged blocks."""

    def cut_for(budget: int) -> tuple[tuple[float, StoredGaussians], int, bool]:
        threshold = cut.pyramid.threshold(budget)
        stored = make_parts(run, run_pass, cut, cut.everywhere(threshold), least=False)
        logits = stored.field("opacity_logits-0")
        return (threshold, stored), len(logits), 2 * int((logits < FAINT_LOGIT).sum()) > len(logits)

    (threshold, stored), removed = halve_budget_while_faint(cut.plan.budget, cut_for)
    if removed:
        run.skip(f"{removed} Gaussians", TOO_FAINT)
    return FinishedParts(cut, threshold, stored, cut.over_tiles(threshold), removed)


def choose_levels(run: Run, run_pass: Pass, cut: Cut, refiner: Callable[[], Refiner | None] = lambda: None) -> Levels:
    """Choose levels by measured errors, and make them; results of an interrupted run are reused.

    Args:
        run: gets the stages.
        run_pass: runs passes over the blocks of the cut.
        cut: pyramid to take the levels from.
        refiner: returns what refines the levels, each at the distance at which it is shown, or None.

    Raises:
        DataError: a block is damaged.
    """

    def cut_for(budget: int) -> tuple[CutErrors, int, bool]:
        errors, faint = measured_cuts(run_pass, cut, budget)
        count = int(errors.counts[:, 0].sum())
        return errors, count, 2 * faint > count

    with run.stage("errors") as stage:
        errors, removed = halve_budget_while_faint(cut.plan.budget, cut_for)
        choices = np.stack(errors.levels(removed), axis=1)
        stage.note = f"{choices.shape[1]} levels of {len(cut.pyramid)} nodes"
    if removed:
        run.skip(f"{removed} Gaussians", TOO_FAINT)
    if (refine := refiner()) is not None:
        refine = replace(refine, distances=tuple(NEAREST * 3 ** (k - 0.5) for k in range(choices.shape[1])))
    stored = make_parts(run, run_pass, cut, errors.thresholds[choices], refine)
    if refine is not None:
        errors, choices = stored.errors(), np.tile(np.arange(choices.shape[1]), (len(choices), 1))
    return Levels(cut, stored, errors, choices, removed)


PIXEL = 2.0  # width of a pixel of the training views, in median standard deviations of the middle axis
SMALLEST, LARGEST, MULTIPLE = 64, 384, 16  # pixels along the edge of a view
FACES = 3.0  # median standard deviations of the middle axis by which Gaussians reach over a face


def refine_part(part: VolumePart, gaussians: Gaussians, refiner: Refiner, distance: float = RADIUS) -> Gaussians:
    """Return Gaussians of the volume's box frame, refined; the given ones where descent does not help.

    Args:
        part: voxels that the Gaussians stand for.
        gaussians: Gaussians of the closed form.
        refiner: options of the descent.
        distance: distance in the unit frame from which they are seen, which decides on the screen's pixel.
    """
    start, steps = part.moved_in(gaussians), refiner.fit.steps or 0
    if not len(gaussians):
        return gaussians
    screen = pixel_width(refiner.fit.screen) * distance / RADIUS * part.scale
    width = float(np.exp(np.median(np.sort(start.log_scales, axis=1)[:, 1])))
    edge = _edge_of_views(width, screen)
    fit = replace(refiner.fit, screen=max(round(pixel_width(1) / screen), edge))
    field = cast("Field", part)  # only its pictures are drawn
    run = Run(Console(quiet=True), ConversionReport("convert"))
    work = Work(run, field, fit, gaussians=start, weigh=lambda at: part.weights(at, FACES * width))
    CheckViews(edge=edge).run(work)
    if work.target_reached():
        return gaussians
    early = None if refiner.early is None or refiner.early >= steps else refiner.early
    TrainingViews(view_count(steps, small=True), edge).run(work)
    if fit.model is not None:
        Network(fit.model).run(work)
    better = work.gaussians is not start
    if steps:
        Refinement(steps, steps, small=True, early=early, overlap=True).run(work)
        assert run.report.refinement is not None
        better |= bool(run.report.refinement["kept"])
    return as_stored(part.moved_out(work.current())) if better else gaussians


def _edge_of_views(width: float, screen: float) -> int:
    """Return the pixels along the edge of views of Gaussians, whose pixels are as wide as neighbours are apart.

    Args:
        width: median standard deviation of the middle axis, in the frame of the views.
        screen: width of a screen's pixel there, the least width of a view's pixel.
    """
    edge = pixel_width(1) / max(PIXEL * width, screen)
    return int(np.clip(math.ceil(edge / MULTIPLE) * MULTIPLE, SMALLEST, LARGEST))
