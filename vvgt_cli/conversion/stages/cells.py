"""What views mend before descent: a second cut of the pyramid by errors, back-projection, a network."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from vvgt_cli.cameras import farthest_cameras
from vvgt_cli.conversion.resume import CELLS
from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.conversion.stages.refinement import step_seconds
from vvgt_cli.field.workload import Workload
from vvgt_cli.jit.ahead import BACK_PROJECT

VIEWS = 24  # training views: half as many lose 0.1 to 0.3 dB (docs/log/closed-form.md)
A_VIEW, ALWAYS = 1.1, 12.0  # in steps of gradient descent: a view, and the second cut with a look at the check views
EQUIVALENT_STEPS = 105.0  # steps on whole views that take as long as back-projection
SECONDS = 0.2, 2.1  # of the network: fixed, per 100,000 Gaussians (docs/network.md)


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
        assert work.train is not None
        assert work.train_rule is not None
        run, train = work.run, work.train
        kept = work.checkpoint.load(CELLS) if self.keep else None
        if kept:
            with run.stage(self.name) as stage:
                stage.note = f"{len(kept[0])} Gaussians, from {work.checkpoint.folder}"
            work.gaussians = kept[0]
            return
        assert work.start is not None
        assert work.start.form is not None
        with run.stage(self.name) as stage:
            chosen = farthest_cameras(train.cameras, VIEWS)  # every fourth or fifth view would lie in bands
            cameras = [train.cameras[i] for i in chosen]
            recut = work.start.form.cut_by_error(work.start.gaussians, cameras, train.images[chosen], work.train_rule)
            work.keep_better(stage, recut, f"{len(recut)} Gaussians, by {len(chosen)} views")
        if self.keep:
            work.checkpoint.save(CELLS, work.current())


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
            bar = run.console.bar(self.name)
            projected, how = backproject(work.start, train.cameras, train.images, progress=bar, rule=work.train_rule)
            work.keep_better(stage, projected, how)


@dataclass(frozen=True)
class Network(Stage):
    """One pass of a trained network, kept if the check views agree.

    Attributes:
        model: folder of the model, or name of a shipped one.
    """

    name: ClassVar[str] = "network"
    improves: ClassVar[bool] = True
    model: str = ""

    def cost(self, workload: Workload) -> Cost:
        """Return the cost by the number of Gaussians."""
        return Cost(workload.pace * (SECONDS[0] + SECONDS[1] * workload.gaussians / 1e5))

    def run(self, work: Work) -> None:
        """Improve the Gaussians by the network.

        Raises:
            UsageError: no such model.
            DataError: an invalid model.
        """
        import numba

        from vvgt_cli.network.card import find_model
        from vvgt_cli.network.runtime import Model

        assert work.train is not None
        assert work.train_rule is not None
        run, given, train = work.run, work.current(), work.train
        with run.stage(self.name) as stage:
            model = Model.open(find_model(self.model), numba.get_num_threads())
            bar, plain = run.console.bar(self.name), given.of_degree(0)  # the network takes no harmonics
            better = model.improve(plain, train.cameras, train.images, progress=bar, rule=work.train_rule)
            work.keep_better(stage, replace(better, harmonics=given.harmonics), model.card.name)
