"""The closed-form stage: moments, pyramid, choice of cells."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, TypeVar

import numpy as np

from vvgt_cli.conversion.resume import CELLS, CLOSED_FORM
from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.defaults import INIT
from vvgt_cli.errors import NothingVisible
from vvgt_cli.field.workload import Workload

if TYPE_CHECKING:
    from vvgt_cli.closed_form import Start

SECONDS = 0.4, 0.62, 0.03, 2.8  # fixed, per 10^6 cells, per 10^6 voxels of non-empty bricks, per 10^6 Gaussians
MEMORY = 294.0, 1240.0  # bytes per cell, and per Gaussian (with what later stages keep of it)
FAINT = 0.02  # opacity
FAINT_LOGIT = math.log(FAINT / (1 - FAINT))
FEWEST = 5000  # Gaussians that faint volumes keep at least
TOO_FAINT = "so faint that viewers differ in what they draw of them"
T = TypeVar("T")


@dataclass(frozen=True)
class ClosedFormStage(Stage):
    """The closed form of Gaussians from a volume, without fitting to pictures.

    Attributes:
        recut: write no checkpoint: a later stage may cut the pyramid again, which checkpoints lack.
        recut_by_error: a later stage cuts the pyramid by error; a checkpoint is read only where that has been done.
    """

    name: ClassVar[str] = "closed form"
    recut: bool = False
    recut_by_error: bool = False

    def cost(self, workload: Workload) -> Cost:
        """Return the cost by cells, voxels and Gaussians."""
        counts = 1e6, workload.cells, workload.voxels, workload.gaussians
        seconds = sum(each * count for each, count in zip(SECONDS, counts, strict=True)) / 1e6
        return Cost(workload.pace * seconds, MEMORY[0] * workload.cells + MEMORY[1] * workload.gaussians)

    def run(self, work: Work) -> None:
        """Make the Gaussians, or load them from the checkpoint, without the pyramid; raise NothingVisible for none."""
        from vvgt_cli.closed_form import Start, VbmOptions
        from vvgt_cli.closed_form.closed_form import NEARLY, bound

        run, fit, source = work.run, work.fit, work.field.source
        whole = self.recut or (self.recut_by_error and work.checkpoint.load(CELLS) is None)
        kept = None if whole else work.checkpoint.load(CLOSED_FORM)
        if kept:
            with run.stage(self.name) as stage:
                stage.note = f"{len(kept[0])} Gaussians, from {work.checkpoint.folder}"
            work.start, work.gaussians = Start(kept[0], None), kept[0]
            return
        options = VbmOptions(
            max_gaussians=fit.max_gaussians, size=fit.screen, method=fit.init, seed=fit.seed, degree=work.degree
        )
        with run.stage(self.name) as stage:
            start = work.field.pyramid(options, run.console.bar(self.name))
            if not len(start.gaussians):
                raise NothingVisible(source.volume.name, source.name)
            made = len(start.gaussians)
            start, removed = thinned(start)
            stage.note = f"{len(start.gaussians)} Gaussians" + f" ({fit.init})" * (fit.init != INIT)
            if start.form is not None and not removed and made + 7 < NEARLY * fit.max_gaussians:
                stage.note += f", no more: {bound(start.form)}"
        if removed:
            run.skip(f"{removed} Gaussians", TOO_FAINT)
        if not self.recut:
            work.checkpoint.save(CLOSED_FORM, start.gaussians)
        work.start, work.gaussians = start, start.gaussians


def thinned(start: Start) -> tuple[Start, int]:
    """Return a closed form with fewer Gaussians where they are faint, and the number of Gaussians removed."""

    def cut(budget: int) -> tuple[Start, int, bool]:
        shorter, form = start, start.form
        if form is not None and budget < form.budget:
            form = replace(form, budget=budget)
            shorter = replace(start, form=form, gaussians=form.gaussians())
        return shorter, len(shorter.gaussians), bool(np.median(shorter.gaussians.opacity_logits) < FAINT_LOGIT)

    return halve_budget_while_faint(0 if start.form is None else start.form.budget, cut)


def halve_budget_while_faint(budget: int, cut: Callable[[int], tuple[T, int, bool]]) -> tuple[T, int]:
    """Cut a pyramid for a budget, and for half of it again and again while most Gaussians are faint.

    Viewers discard what is below 1/255, 1/510 or 1/100 in a pixel: each shows another part of a fog of faint splats.

    Args:
        budget: number of Gaussians.
        cut: returns, for a budget, a cut, the number of its Gaussians, and whether most are fainter than `FAINT`.

    Returns:
        The last cut, and how many Gaussians fewer than the first it has.
    """
    first = 0
    while True:
        made, count, faint = cut(budget)
        first = first or count
        if not faint or budget < 2 * FEWEST:
            return made, first - count
        budget //= 2
