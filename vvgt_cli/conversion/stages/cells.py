"""Cells by error: a second cut of the closed form's pyramid, finer where pictures of the first have errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from vvgt_cli.cameras import farthest_cameras
from vvgt_cli.conversion.resume import CELLS
from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.conversion.stages.refinement import step_seconds
from vvgt_cli.field.workload import Workload

VIEWS = 24  # training views: half as many lose 0.1 to 0.3 dB (docs/log/closed-form.md)
A_VIEW, ALWAYS = 1.1, 12.0  # in steps of gradient descent: a view, and the second cut with a look at the check views


@dataclass(frozen=True)
class CellsByError(Stage):
    """A second cut with as many Gaussians, kept if the check views agree.

    Attributes:
        small: whether the training views are small.
        keep: whether the result goes to the checkpoint.
    """

    name: ClassVar[str] = "cells by error"
    improves: ClassVar[bool] = True
    small: bool = False
    keep: bool = True

    def cost(self, workload: Workload) -> Cost:
        """Return the cost of as many steps of descent."""
        return Cost((VIEWS * A_VIEW + ALWAYS) * step_seconds(workload, self.small))

    def run(self, work: Work) -> None:
        """Cut the pyramid, or load the result from the checkpoint."""
        from vvgt_cli.closed_form import cut_by_error

        assert work.train is not None
        assert work.train_rule is not None
        assert work.start is not None
        run, train = work.run, work.train
        kept = work.checkpoint.load(CELLS) if self.keep else None
        if kept:
            with run.stage(self.name) as stage:
                stage.note = f"{len(kept[0])} Gaussians, from {work.checkpoint.folder}"
            work.gaussians = kept[0]
            return
        with run.stage(self.name) as stage:
            chosen = farthest_cameras(train.cameras, VIEWS)  # every fourth or fifth view would lie in bands
            cameras = [train.cameras[i] for i in chosen]
            before = work.psnr(work.current())
            recut = cut_by_error(work.start, cameras, train.images[chosen], work.train_rule)
            after = work.psnr(recut)
            stage.kept = work.keep_better(before, after, recut)
            stage.note = f"{len(recut)} Gaussians, by {len(chosen)} views; from {before:.2f} dB on the check views"
            stage.psnr_before, stage.psnr = before, after
        if self.keep:
            work.checkpoint.save(CELLS, work.current())
