"""Gradient descent on the training views, and what viewers would leave out of its result."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import ClassVar

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.sets import pixel_width
from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.field.workload import Workload, view_edge
from vvgt_cli.gaussians import Gaussians, as_stored
from vvgt_cli.gaussians.constants import MIN_ALPHA
from vvgt_cli.refine import OptimizeOptions, OptimizeRecord, optimize
from vvgt_cli.score.checks import Views
from vvgt_cli.score.record import Run

STEP = 0.027, 0.0275  # seconds per 400 x 400 px, per 100,000 Gaussians
HARMONICS = 1.0, 1.1, 1.25, 1.4  # times as long with harmonics of degree 0 to 3
WIDER = 1.1  # times as wide along surfaces: what that blurs is sharp again after some steps, the lattice stays away
LOOK = 25  # steps between two looks at the check views where a target ends the run; else one is taken in the middle
SMALLEST = 0.5  # standard deviation of the longest axis in pixels of the screen: viewers drop or fade less
MOST = 0.99  # of the Gaussians: as many are left where small ones are widened, as a rule
REASONS = {
    "steps": "", "time": "time is up", "target": "target reached", "no gain": "ended early: no gain any more",
    "interrupted": "interrupted",
}  # fmt: skip


def step_seconds(workload: Workload, small: bool) -> float:
    """Of a step with its share of the looks at check views."""
    one = workload.pace * (STEP[0] * (view_edge(workload.size, small) / 400) ** 2 + STEP[1] * workload.gaussians / 1e5)
    return HARMONICS[workload.degree] * one


@dataclass(frozen=True)
class Refinement(Stage):
    """Never to something worse, as the check views see it.

    Attributes:
        steps: that there should be time for.
        most: where there is more time than that.
        small: its training views are small.
        overlap: the Gaussians stand on the lattice of cells: descent begins with wider ones (`WIDER`).
    """

    name: ClassVar[str] = "refinement"
    improves: ClassVar[bool] = True
    steps: int = 0
    most: int = 0
    small: bool = False
    overlap: bool = False

    def cost(self, workload: Workload) -> Cost:
        """By steps."""
        return Cost(self.steps * step_seconds(workload, self.small))

    def label(self) -> str:
        """With the number of steps."""
        return f"{self.steps} steps"

    def run(self, work: Work) -> None:
        """Descend, and leave out what viewers do."""
        from vvgt_cli.closed_form.shape import widened

        assert work.train is not None
        assert work.check is not None
        assert work.train_rule is not None
        left = None
        if work.limits.time_budget is not None:
            left = max(work.limits.time_budget - work.run.elapsed() - work.ending, 0.0)
        target = work.limits.target_psnr
        options = OptimizeOptions.of(
            "frame", steps=self.most, time_budget=left, target_psnr=target, rule=work.train_rule, judge=work.rule,
            seed=work.fit.seed, checkpoint=work.checkpoint.descent,
            check_every=LOOK if target is not None else max(LOOK, self.most // 2),
        )  # fmt: skip
        start = work.made()
        begin = (widened(start, WIDER, pixel_width(work.fit.size)), work.psnr(start)) if self.overlap else None
        work.gaussians = _drop_undrawn(work, refine(work.run, start, work.train, work.check, options, begin))


def _drop_undrawn(work: Work, gaussians: Gaussians) -> Gaussians:
    """`without_undrawn`; where that leaves out many, the mass is counted as the check views agree."""
    kept = without_undrawn(gaussians, work.fit.size)
    if len(kept) >= MOST * len(gaussians):
        return kept
    return max(kept, without_undrawn(gaussians, work.fit.size, work.rule.dilation), key=work.psnr)


def refine(
    run: Run, start: Gaussians, train: Views, check: Views, options: OptimizeOptions,
    begin: tuple[Gaussians, float] | None = None, free: np.ndarray | None = None,
) -> Gaussians:  # fmt: skip
    """The stage: the best that the check views have seen, as a file holds it; ``start`` where nothing was better.

    Descent begins with the Gaussians of ``begin``, where they are given, with the dB of ``start`` on the check views;
    of ``free`` (K,) bool only those move.
    """
    with run.stage("refinement") as stage, run.console.interruption(run.console.message) as stop:
        result, record = optimize(
            start if begin is None else begin[0],
            train.cameras,
            train.images,
            options,
            (check.cameras, check.images, check.blocks),
            progress=run.console.bar("refinement"),
            stop=stop,
            free=free,
        )
        if begin is not None:
            record.psnr_before = begin[1]
            if (record.psnr_after or 0.0) <= record.psnr_before:
                result, record.kept, record.psnr_after = start, 0, record.psnr_before
        stage.kept = result is not start
        stage.psnr_before, stage.psnr = record.psnr_before, record.psnr_after
        stage.note = _note(record, options)
    drawn = {"rule": options.rule.name, "dilation": options.rule.dilation}
    run.report.refinement = asdict(record) | {"method": options.method, "views": len(train)} | drawn
    return as_stored(result)


def _note(record: OptimizeRecord, options: OptimizeOptions) -> str:
    parts = [f"{record.steps} steps ({options.method})"]
    if 0 < record.kept < record.steps:
        parts.append(f"best after {record.kept}")
    if REASONS[record.reason]:
        parts.append(REASONS[record.reason])
    return ", ".join(parts) + f"; from {record.psnr_before:.2f} dB on the check views"


def without_undrawn(gaussians: Gaussians, size: int, dilation: float = 0.0) -> Gaussians:
    """Without what viewers leave out: splats that never reach 1/255, and, widened with their mass kept, small ones.

    Arguments as of `widen_small`.
    """
    found, kept = widen_small(gaussians, size, dilation)
    return found.take(kept) if kept.any() else gaussians


def widen_small(gaussians: Gaussians, size: int, dilation: float = 0.0) -> tuple[Gaussians, np.ndarray]:
    """Gaussians of which small ones are widened with their mass kept, and (K,) bool whether they reach 1/255.

    Args:
        gaussians: in the unit frame.
        size: pixels along the edge of the screen that the file is made for; none stays narrower than `SMALLEST` there.
        dilation: px^2 that the mass is counted with; 0 as viewers count it that compensate theirs.
    """
    opacity = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    camera = default_views("check", 1, size=size)[0]
    pixel = float(np.linalg.norm(camera.position)) / camera.fx
    width = np.exp(gaussians.log_scales.max(axis=1).astype(np.float64))
    widening = np.maximum(SMALLEST * pixel / width, 1)
    beside = dilation * (pixel / width) ** 2
    opacity = np.clip(opacity / ((widening**2 + beside) / (1 + beside)), 1e-7, 1 - 1e-7)
    logits = np.where(widening > 1, np.log(opacity / (1 - opacity)), gaussians.opacity_logits)
    scales = gaussians.log_scales + np.log(widening)[:, None]
    return replace(gaussians, log_scales=scales, opacity_logits=logits), opacity >= MIN_ALPHA
