"""The stage of one pass of a trained network."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.field.workload import Workload

SECONDS = 0.2, 2.1  # fixed, per 100,000 Gaussians (docs/network.md)


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
            better = replace(better, harmonics=given.harmonics)
            before, after = work.psnr(given), work.psnr(better)
            stage.kept = work.keep_better(before, after, better)
            stage.psnr_before, stage.psnr = before, after
            stage.note = f"{model.card.name}; from {before:.2f} dB on the check views"
