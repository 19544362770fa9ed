"""Options of a descent, and the record of what it did."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

from vvgt_cli.defaults import STEPS
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.rules import INRIA, Rule

if TYPE_CHECKING:
    import numpy as np

    from vvgt_cli.cameras import Blocks, Camera

METHODS = ("axes", "adam", "3dgs")
LOSS_3DGS = {"l1": 0.8, "l2": 0.0, "ssim": 0.2, "alpha": 0.0}
TEXTURE = 6.0  # weight of the term for texture beside that of the squares (docs/log/closed-form.md)
LOSSES: dict[str, dict[str, float]] = {"axes": {"texture": TEXTURE}, "3dgs": LOSS_3DGS}
Train: TypeAlias = "tuple[Sequence[Camera], np.ndarray]"
Check: TypeAlias = "Train | tuple[Sequence[Camera], np.ndarray, Sequence[Blocks] | None, Sequence[np.ndarray] | None]"


@dataclass(frozen=True)
class OptimizeOptions:
    """Options of gradient descent: the method, and when to stop.

    Attributes:
        steps: maximum number, one view each; rates fall to zero over them. None: as many as the time budget allows.
        method: "axes" steps along each Gaussian's own axes, "adam" on the file's fields with the rates of 3DGS, "3dgs"
            as that, and the number of Gaussians grows and shrinks as in 3DGS.
        max_gaussians: the number that "3dgs" may grow to; None: as many as it begins with.
        time_budget: seconds from the first step on after which no other is begun; rates fall to zero over it if it
            ends first. Runs with one do not repeat to the byte.
        target_psnr: dB on the check views at which to stop.
        l1, l2, ssim: weights of the sums over pixels and RGB of |r|, r^2 and 1 - SSIM.
        alpha: weight of the alpha channel's |r| and r^2 beside a colour channel's.
        texture: weight of the square of the high-frequency part of r, where the view is smooth
            (`vvgt_cli.refine.loss`).
        rule: by which the training views are drawn: ``rule.at(w / W)`` where they are w px wide and the file is made
            for W.
        check_rule: by which the check views are drawn.
        check_every: fewest steps between two scores on the check views, of which a run takes eight or so.
        early: steps after which the run ends where no difference is seen any more (`UNSEEN`), which is decided halfway
            there; None: it does not.
        patience: scores in a row without a gain of 0.01 dB, in the second half, after which to stop.
        checkpoint: .npz written after scores, or 30 s, and at the end; where it is there, the run goes on from it.
        seed: of the order of views, and of what "3dgs" draws.
        device: "cpu", or "cuda" for steps of the method "axes" there (`vvgt_cli.refine.on_device`).
    """

    steps: int | None = STEPS
    method: str = "axes"
    max_gaussians: int | None = None
    time_budget: float | None = None
    target_psnr: float | None = None
    l1: float = 0.0
    l2: float = 1.0
    ssim: float = 0.0
    alpha: float = 0.5
    texture: float = 0.0
    rule: Rule = INRIA
    check_rule: Rule = INRIA
    check_every: int = 25
    early: int | None = None
    patience: int = 3
    checkpoint: str | None = None
    seed: int = 0
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Raise UsageError for an unknown method, or a number out of its range."""
        if self.method not in METHODS:
            raise UsageError(f"method {self.method!r}; expected one of {', '.join(METHODS)}")
        if self.steps is None and self.time_budget is None:
            raise UsageError("neither steps nor a time budget; expected one of them")
        if self.steps is not None and self.steps < 0:
            raise UsageError(f"{self.steps} steps; expected 0 or more")
        if not 0 <= self.rule.dilation < math.inf:
            raise UsageError(f"dilation {self.rule.dilation} px^2; expected 0 or more")
        if min(self.check_every, self.patience) < 1:
            raise UsageError(f"check every {self.check_every} steps, patience {self.patience}; expected at least 1")
        if self.time_budget is not None and not self.time_budget >= 0:
            raise UsageError(f"time budget {self.time_budget} s; expected 0 or more")
        if not min(self.l1, self.l2, self.ssim, self.alpha, self.texture) >= 0 or self.l1 + self.l2 + self.ssim <= 0:
            raise UsageError("weights of the loss: expected none below 0 and one of l1, l2, ssim above")

    @classmethod
    def of(cls, method: str, **options: Any) -> OptimizeOptions:
        """Return options with the method's loss: squares, of texture too, or 3DGS' 0.8 L1 + 0.2 (1 - SSIM)."""
        return cls(method=method, **(LOSSES.get(method, {}) | options))


@dataclass
class OptimizeRecord:
    """Record of a run.

    Attributes:
        steps: taken, and ``kept``: the step whose Gaussians were returned (0: the input).
        seconds: wall time.
        reason: why it ended: "steps", "unseen" (an early end), "time", "target", "no gain", "interrupted".
        psnr_before, psnr_after: dB on the check views; None without any.
        difference: that of the check views halfway to an early end (`visible_difference`); None without one.
        checks: (step, seconds, dB) of each score on the check views.
    """

    steps: int = 0
    kept: int = 0
    seconds: float = 0.0
    reason: str = "steps"
    psnr_before: float | None = None
    psnr_after: float | None = None
    difference: float | None = None
    checks: list[tuple[int, float, float]] = field(default_factory=list)
