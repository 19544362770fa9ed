"""The closed form: moments, pyramid, choice of cells."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from vvgt_cli.conversion.resume import CELLS, CLOSED_FORM
from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.errors import NothingVisible
from vvgt_cli.field.workload import Workload

if TYPE_CHECKING:
    from vvgt_cli.closed_form import Start

SECONDS = 0.4, 0.62, 0.03, 2.8  # always, per 10^6 cells, 10^6 voxels in bricks that are not empty, 10^6 Gaussians
MEMORY = 294.0, 1240.0  # bytes: a cell, a Gaussian (with what later stages keep of it)
FAINT = 0.02  # opacity
FAINT_LOGIT = math.log(FAINT / (1 - FAINT))
NEARLY = 0.99  # of the budget: cells are split by eights, so that a few are always missing
FEWEST = 5000  # Gaussians that a fog keeps


@dataclass(frozen=True)
class ClosedFormStage(Stage):
    """Volume to Gaussians without a picture.

    Attributes:
        anew: a stage after it may cut the cells anew: nothing is kept of it, since only Gaussians are.
        cut: a stage after it cuts the cells by error: only where that has been done is no pyramid needed again.
    """

    name: ClassVar[str] = "closed form"
    anew: bool = False
    cut: bool = False

    def cost(self, workload: Workload) -> Cost:
        """By cells, voxels and Gaussians."""
        counts = 1e6, workload.cells, workload.voxels, workload.gaussians
        seconds = sum(each * count for each, count in zip(SECONDS, counts, strict=True)) / 1e6
        return Cost(workload.pace * seconds, MEMORY[0] * workload.cells + MEMORY[1] * workload.gaussians)

    def run(self, work: Work) -> None:
        """Make the Gaussians, or take what is kept of them: without the pyramid.

        Raises:
            NothingVisible: nothing is visible from any view.
        """
        from vvgt_cli.closed_form import Start, VbmOptions
        from vvgt_cli.closed_form.closed_form import bound

        run, fit, source = work.run, work.fit, work.field.source
        whole = self.anew or (self.cut and work.checkpoint.load(CELLS) is None)
        kept = None if whole else work.checkpoint.load(CLOSED_FORM)
        if kept:
            with run.stage(self.name) as stage:
                stage.note = f"{len(kept[0])} Gaussians, as kept in {work.checkpoint.folder}"
            work.start, work.gaussians = Start(kept[0], None), kept[0]
            return
        options = VbmOptions(
            max_gaussians=fit.max_gaussians, size=fit.size, method=fit.init, seed=fit.seed, degree=work.degree
        )
        with run.stage(self.name) as stage:
            start = work.field.pyramid(options, run.console.bar(self.name))
            if not len(start.gaussians):
                raise NothingVisible(source.volume.name, source.name)
            found = len(start.gaussians)
            start, spared = thinned(start)
            stage.note = f"{len(start.gaussians)} Gaussians ({fit.init})"
            if start.form is not None and not spared and found < NEARLY * fit.max_gaussians:
                stage.note += f", no more: {bound(start.form)}"
        if spared:
            run.skip(f"{spared} Gaussians", "so faint that viewers differ on what they draw of them")
        if not self.anew:
            work.checkpoint.save(CLOSED_FORM, start.gaussians)
        work.start, work.gaussians = start, start.gaussians


def thinned(start: Start) -> tuple[Start, int]:
    """Half the budget, again and again, while the median opacity is below `FAINT`; and how many Gaussians that spares.

    Programs leave out what is below 1/255, 1/510 or 1/100 in a pixel: of a fog of faint splats each shows another part.
    """
    before = len(start.gaussians)
    while start.form is not None and start.form.budget >= 2 * FEWEST:
        if np.median(start.gaussians.opacity_logits) >= FAINT_LOGIT:
            break
        form = replace(start.form, budget=start.form.budget // 2)
        start = replace(start, form=form, gaussians=form.gaussians())
    return start, before - len(start.gaussians)
