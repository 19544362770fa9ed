"""Back-projection: splitting of cells and solving of colours by views, without moving Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.conversion.stages.refinement import step_seconds
from vvgt_cli.field.workload import Workload
from vvgt_cli.jit.ahead import BACK_PROJECT

EQUIVALENT_STEPS = 105.0  # steps of gradient descent on whole views that take as long


@dataclass(frozen=True)
class BackProjection(Stage):
    """Back-projection of training views, kept if the check views agree."""

    name: ClassVar[str] = "back-projection"
    improves: ClassVar[bool] = True

    def cost(self, workload: Workload) -> Cost:
        """Return the cost of as many steps of descent."""
        return Cost(EQUIVALENT_STEPS * step_seconds(workload, small=False))

    def run(self, work: Work) -> None:
        """Split cells and solve colours."""
        from vvgt_cli.closed_form import backproject

        assert work.start is not None
        assert work.train is not None
        assert work.train_rule is not None
        run, train = work.run, work.train
        run.compile(BACK_PROJECT)
        with run.stage(self.name) as stage:
            before = work.psnr(work.start.gaussians)
            bar = run.console.bar(self.name)
            projected, how = backproject(work.start, train.cameras, train.images, progress=bar, rule=work.train_rule)
            after = work.psnr(projected)
            stage.kept = work.keep_better(before, after, projected)
            stage.note = f"{how}; from {before:.2f} dB on the check views"
            stage.psnr_before, stage.psnr = before, after
