"""One pass of a trained network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from vvgt_cli.conversion.case import Case
from vvgt_cli.conversion.stage import Cost, Stage, Work

SECONDS = 0.2, 2.1  # always, per 100,000 Gaussians (docs/network.md)


@dataclass(frozen=True)
class Network(Stage):
    """Kept if the check views agree.

    Attributes:
        model: folder, or name of a shipped one.
    """

    name: ClassVar[str] = "network"
    improves: ClassVar[bool] = True
    model: str = ""

    def cost(self, case: Case) -> Cost:
        """By Gaussians."""
        return Cost(case.pace * (SECONDS[0] + SECONDS[1] * case.gaussians / 1e5))

    def run(self, work: Work) -> None:
        """Let it improve the Gaussians.

        Raises:
            UsageError: no such model.
            DataError: a model that is not what it must be.
        """
        import numba

        from vvgt_cli.network.card import find_model
        from vvgt_cli.network.runtime import Model

        assert work.train is not None
        assert work.train_rule is not None
        run, given = work.run, work.made()
        with run.stage(self.name) as stage:
            model = Model.open(find_model(self.model), numba.get_num_threads())
            better = model.improve(
                given, work.train.cameras, work.train.images, progress=run.console.bar(self.name), rule=work.train_rule
            )
            before, after = work.psnr(given), work.psnr(better)
            stage.kept = work.keep_better(before, after, better)
            stage.psnr_before, stage.psnr = before, after
            stage.note = f"{model.card.name}; from {before:.2f} dB on the check views"
