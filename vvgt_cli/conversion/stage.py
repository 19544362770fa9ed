"""`Stage`, of which a plan is a list, and `Work`, what stages hand on."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from vvgt_cli.conversion.request import FitOptions, Limits
from vvgt_cli.conversion.resume import Checkpoint
from vvgt_cli.field.workload import Workload
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import Rule, rule_of
from vvgt_cli.score.checks import Views
from vvgt_cli.score.record import Run

if TYPE_CHECKING:
    from vvgt_cli.closed_form import Start
    from vvgt_cli.dvr import RenderSettings
    from vvgt_cli.field.field import Field, Picture


class Cost(NamedTuple):
    """What a stage should cost: wall seconds, and bytes of memory that it takes for the rest of the run."""

    seconds: float
    memory: float = 0.0


@dataclass
class Work:
    """What the stages of one conversion read and leave.

    Attributes:
        run: times stages and tells the console.
        field: the volume under its function, labels, layers and light.
        fit, limits: what is asked for.
        degree: of the harmonics that colours have where the light depends on the view.
        checkpoint: where stages keep what they made; `Checkpoint` of no folder for nowhere.
        ending: seconds that the stages after the present one should take.
        start: the closed form, once it is there, with the pyramid that it was cut from.
        gaussians: so far, in the box frame.
        check: views to judge by, once they are there; ``train``: views to fit to.
        train_rule: by which training views are drawn; ``train_settings``: what the volume's were rendered with.
        judged: of which Gaussians the PSNR on which check views is known, and it.
    """

    run: Run
    field: Field
    fit: FitOptions
    limits: Limits = dataclasses.field(default_factory=Limits)
    degree: int = 0
    checkpoint: Checkpoint = dataclasses.field(default_factory=Checkpoint)
    ending: float = 0.0
    start: Start | None = None
    gaussians: Gaussians | None = None
    check: Views | None = None
    train: Views | None = None
    train_rule: Rule | None = None
    train_settings: RenderSettings | None = None
    judged: tuple[Gaussians, Views, float] | None = None

    @property
    def rule(self) -> Rule:
        """By which the file will be drawn."""
        return rule_of(self.fit.rule)

    def made(self) -> Gaussians:
        """The Gaussians that a stage before has made."""
        assert self.gaussians is not None, "a stage that needs Gaussians stands before the one that makes them"
        return self.gaussians

    def psnr(self, gaussians: Gaussians) -> float:
        """On the check views; of the Gaussians that were asked for last it is known."""
        assert self.check is not None, "a stage that judges stands before the check views"
        if self.judged is None or self.judged[0] is not gaussians or self.judged[1] is not self.check:
            self.judged = gaussians, self.check, self.check.psnr(gaussians, self.rule)
        return self.judged[2]

    def reset(self) -> None:
        """Forget all that stages have made."""
        self.gaussians = self.check = self.train = self.train_rule = self.train_settings = self.judged = None
        self.run.report.refinement = None

    def target_reached(self) -> bool:
        """Whether the target is reached."""
        target = self.limits.target_psnr
        return target is not None and self.check is not None and self.psnr(self.made()) >= target

    def keep_better(self, before: float, after: float, gaussians: Gaussians) -> bool:
        """Take ``gaussians`` where the check views agree; whether they did."""
        if after > before:
            self.gaussians = gaussians
        return after > before


@dataclass(frozen=True)
class Stage(ABC):
    """One step of a conversion: what it is called, what it costs, what it does.

    Attributes:
        name: as the console and reports show it.
        improves: makes better Gaussians of those that are there, as the check views see them.
        scores: changes nothing, and is done whatever target is reached before.
    """

    name: ClassVar[str]
    improves: ClassVar[bool] = False
    scores: ClassVar[bool] = False

    @abstractmethod
    def cost(self, workload: Workload) -> Cost:
        """What it should cost."""

    @abstractmethod
    def run(self, work: Work) -> None:
        """Do it."""

    def views(self, fit: FitOptions) -> list[Picture]:
        """Pictures of the volume that it will ask for, as far as they are known before there are Gaussians."""
        return []

    def label(self) -> str:
        """The name with what the plan chose, for `--dry-run`."""
        return self.name
