"""Stages, of which a plan is a list, and the state that they share."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from vvgt_cli.conversion.request import FitOptions
from vvgt_cli.conversion.resume import Checkpoint
from vvgt_cli.field.workload import Workload
from vvgt_cli.gaussians import Gaussians, PlyOptions, Rule, rule_of
from vvgt_cli.score.record import Run, StageRecord
from vvgt_cli.score.views import Views

if TYPE_CHECKING:
    import numpy as np

    from vvgt_cli.cameras import Camera
    from vvgt_cli.closed_form import Start
    from vvgt_cli.conversion.cut import FinishedParts, Levels
    from vvgt_cli.dvr import RenderSettings
    from vvgt_cli.field.field import Field, Picture


class Cost(NamedTuple):
    """The expected cost of a stage: wall seconds, and bytes of memory that it holds for the rest of the run."""

    seconds: float
    memory: float = 0.0


@dataclass
class Work:
    """The state that the stages of one conversion share.

    Attributes:
        run: times stages and prints messages.
        field: the volume under its function, labels, layers and light.
        fit: options and limits of the conversion.
        degree: degree of the harmonics of colours where the light depends on the view.
        checkpoint: where stages save their results; without a folder nowhere.
        ending: expected seconds of the stages after the current one.
        start: the closed form, once made, with its pyramid.
        gaussians: current Gaussians, box frame.
        check, train: views to measure PSNR on, and to fit to, once rendered.
        train_rule, train_settings: drawing rule of the training views, and settings of their references.
        compared: the Gaussians and check views last compared, and their PSNR (dB).
        ply: layout of the file.
        parts, levels: Gaussians made out of core, on disk.
        live_psnr: dB of a live file as `vvgt recolor` shows it, once scored.
        seen: returns what a camera is shown of levels; None where all Gaussians are.
        weigh: returns factors (h, w) of errors in a camera's picture, where the field is a part of the volume whose
            Gaussians keep their number and order.
    """

    run: Run
    field: Field
    fit: FitOptions
    degree: int = 0
    checkpoint: Checkpoint = dataclasses.field(default_factory=Checkpoint)
    ending: float = 0.0
    start: Start | None = None
    gaussians: Gaussians | None = None
    check: Views | None = None
    train: Views | None = None
    train_rule: Rule | None = None
    train_settings: RenderSettings | None = None
    compared: tuple[Gaussians, Views, float] | None = None
    weigh: Callable[[Camera], np.ndarray] | None = None
    ply: PlyOptions = dataclasses.field(default_factory=PlyOptions)
    parts: FinishedParts | None = None
    levels: Levels | None = None
    live_psnr: float | None = None
    seen: Callable[[Camera], Gaussians] | None = None

    @property
    def rule(self) -> Rule:
        """Return the drawing rule that the file is made for."""
        return rule_of(self.fit.rule)

    @property
    def check_rule(self) -> Rule:
        """Return the drawing rule of the check views, which may have fewer pixels than the screen."""
        assert self.check is not None
        return self.rule.at(self.check.cameras[0].width / self.fit.screen)

    def current(self) -> Gaussians:
        """Return the Gaussians of the latest stage."""
        assert self.gaussians is not None, "a stage that needs Gaussians stands before the one that makes them"
        return self.gaussians

    @property
    def shown(self) -> Gaussians | Callable[[Camera], Gaussians]:
        """Return what viewers show: the current Gaussians, or those of the levels that a camera selects."""
        return self.seen or self.current()

    def psnr(self, gaussians: Gaussians) -> float:
        """Return the PSNR (dB) on the check views; the last one is cached."""
        assert self.check is not None, "a stage that measures PSNR stands before the check views"
        if self.compared is None or self.compared[0] is not gaussians or self.compared[1] is not self.check:
            self.compared = gaussians, self.check, self.check.psnr(gaussians, self.check_rule)
        return self.compared[2]

    def reset(self) -> None:
        """Discard the results of all stages."""
        self.gaussians = self.check = self.train = self.train_rule = self.train_settings = self.compared = None
        self.run.report.refinement = None

    def target_reached(self) -> bool:
        """Return whether the target PSNR is reached."""
        target = self.fit.target_psnr
        return target is not None and self.check is not None and self.psnr(self.current()) >= target

    def keep_better(self, record: StageRecord, gaussians: Gaussians, how: str) -> None:
        """Take ``gaussians`` if their PSNR is better than that of the current ones, and record both, and ``how``."""
        before = self.psnr(self.current())
        record.psnr_before, record.psnr = before, self.psnr(gaussians)
        record.kept, record.note = record.psnr > before, f"{how}; from {before:.2f} dB on the check views"
        self.gaussians = gaussians if record.kept else self.gaussians


@dataclass(frozen=True)
class Stage(ABC):
    """One step of a conversion, with its name and cost.

    Attributes:
        name: name in messages and reports.
        improves: whether it improves existing Gaussians, by the check views.
        scores: whether it only scores, and so runs even if a target is reached before.
    """

    name: ClassVar[str]
    improves: ClassVar[bool] = False
    scores: ClassVar[bool] = False

    @abstractmethod
    def cost(self, workload: Workload) -> Cost:
        """Return the expected cost."""

    @abstractmethod
    def run(self, work: Work) -> None:
        """Run the stage."""

    def views(self, fit: FitOptions) -> list[Picture]:
        """List the pictures of the volume that it will request, as far as they are known beforehand."""
        return []

    def label(self) -> str:
        """Return the name with the choices of the plan, for `--dry-run`."""
        return self.name
