"""The refinement stage: gradient descent on the training views, without Gaussians that viewers would discard."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np

from vvgt_cli.cameras.sets import pixel_width
from vvgt_cli.conversion.request import FitOptions
from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.defaults import EARLY, FEWEST_STEPS, MAX_STEPS, METHOD, STEPS
from vvgt_cli.errors import DeviceFailed
from vvgt_cli.field.workload import Workload, view_edge
from vvgt_cli.gaussians import MIN_ALPHA, Gaussians, as_stored
from vvgt_cli.refine import OptimizeOptions, OptimizeRecord, optimize
from vvgt_cli.score.record import Run
from vvgt_cli.score.views import Views

STEP = 0.027, 0.0275  # seconds per 400 x 400 px, per 100,000 Gaussians
HARMONICS = 1.0, 1.1, 1.25, 1.4  # factors of the time with harmonics of degree 0 to 3
WIDER = 1.1  # factor of widths along surfaces: some steps undo the blur, while the lattice of cells stays hidden
CHECK_EVERY = 25  # steps between checks where a target ends the run; else one check is in the middle
SMALLEST = 0.5  # standard deviation of the longest axis, in screen pixels, below which viewers drop or fade splats
MIN_KEPT = 0.99  # share of the Gaussians that usually remain where small ones are widened
REASONS = {
    "steps": "", "unseen": "more would hardly be seen", "time": "time is up", "target": "target reached",
    "no gain": "ended early: no more gain", "interrupted": "interrupted",
}  # fmt: skip


def step_seconds(workload: Workload, small: bool) -> float:
    """Return the seconds of a step, with its share of the checks."""
    one = workload.pace * (STEP[0] * (view_edge(workload.size, small) / 400) ** 2 + STEP[1] * workload.gaussians / 1e5)
    return HARMONICS[workload.degree] * one


def most_steps(fit: FitOptions) -> int:
    """Return the requested number of steps, else `STEPS`, or `MAX_STEPS` if a target or a time budget ends them."""
    if fit.steps is not None:
        return fit.steps
    return MAX_STEPS if fit.ended else STEPS


def early_end(fit: FitOptions, steps: float = float("inf")) -> int | None:
    """Return after which of ``steps`` descent may end since nobody sees a difference; None where the user decides.

    A network uses all views, so that it ends none early.
    """
    return None if fit.steps is not None or fit.model is not None or fit.ended or steps <= EARLY else EARLY


def steps_in_time(steps: int, left: float | None, seconds: Callable[[int], float]) -> int:
    """Return the number of steps, at most ``steps``, that take the seconds ``left``; 0 if too few (`FEWEST_STEPS`)."""
    affordable = steps if left is None else bisect_right(range(steps + 1), left, key=seconds) - 1
    return affordable if affordable >= min(FEWEST_STEPS, steps) else 0


@dataclass(frozen=True)
class Refinement(Stage):
    """Gradient descent that never returns worse Gaussians, by the check views.

    Attributes:
        steps: number of steps that the plan has time for.
        most: number of steps where there is more time.
        small: whether the training views are small.
        early: number of steps where no difference is seen after these; None: it does not end early.
        overlap: whether descent begins with wider Gaussians (`WIDER`), since they lie on the lattice of cells.
    """

    name: ClassVar[str] = "refinement"
    improves: ClassVar[bool] = True
    steps: int = 0
    most: int = 0
    small: bool = False
    early: int | None = None
    overlap: bool = False

    def cost(self, workload: Workload) -> Cost:
        """Return the cost by steps."""
        return Cost(self.steps * step_seconds(workload, self.small))

    def label(self) -> str:
        """Return the number of steps."""
        return f"{self.steps} steps" + ("" if self.early is None else f", or {self.early}")

    def run(self, work: Work) -> None:
        """Descend, and remove Gaussians that viewers would discard."""
        from vvgt_cli.closed_form.shape import widened

        assert work.train is not None
        assert work.check is not None
        assert work.train_rule is not None
        remaining = None
        if work.fit.time_budget is not None:
            remaining = max(work.fit.time_budget - work.run.elapsed() - work.ending, 0.0)
        target = work.fit.target_psnr
        options = OptimizeOptions.of(
            "axes", steps=self.most, time_budget=remaining, target_psnr=target, rule=work.train_rule,
            check_rule=work.check_rule, seed=work.fit.seed, checkpoint=work.checkpoint.descent, device=work.fit.device,
            early=self.early, check_every=CHECK_EVERY if target is not None else max(CHECK_EVERY, self.most // 2),
        )  # fmt: skip
        start = work.current()
        begin = (widened(start, WIDER, pixel_width(work.fit.screen)), work.psnr(start)) if self.overlap else None
        work.gaussians = refine(work.run, start, work.train, work.check, options, begin)
        if work.weigh is None:
            work.gaussians = _drop_undrawn(work, work.gaussians)


def _drop_undrawn(work: Work, gaussians: Gaussians) -> Gaussians:
    """Apply `without_undrawn`; where that removes many, count the mass in the way that the check views prefer."""
    kept = without_undrawn(gaussians, work.fit.screen)
    if len(kept) >= MIN_KEPT * len(gaussians):
        return kept
    return max(kept, without_undrawn(gaussians, work.fit.screen, work.rule.dilation), key=work.psnr)


def refine(
    run: Run, start: Gaussians, train: Views, check: Views, options: OptimizeOptions,
    begin: tuple[Gaussians, float] | None = None, free: np.ndarray | None = None,
) -> Gaussians:  # fmt: skip
    """Run the stage and return the best Gaussians by the check views, as a file holds them.

    Args:
        run: gets the stage.
        start: Gaussians to improve, returned where nothing was better.
        train: views to fit to.
        check: views to measure PSNR on.
        options: options of descent.
        begin: wider Gaussians that descent begins with, and the dB of ``start`` on the check views.
        free: (K,) bool, the Gaussians that may move; None for all.
    """
    with run.stage("refinement") as stage, run.console.interruption(run.console.message) as stop:
        descend = partial(
            optimize,
            start if begin is None else begin[0],
            train.cameras,
            train.images,
            check=(check.cameras, check.images, check.blocks, check.weights),
            progress=run.console.bar("refinement"),
            stop=stop,
            free=free,
            weights=train.weights,
        )
        result, record = _on_its_device(run, options, descend)
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


def _on_its_device(
    run: Run, options: OptimizeOptions, descend: partial[tuple[Gaussians, OptimizeRecord]]
) -> tuple[Gaussians, OptimizeRecord]:
    """Descend on the device of the options, or on the CPU where that does not or fails, which is said."""
    if options.device != "cpu":
        from vvgt_cli.refine.on_device import unfit

        try:
            if (reason := unfit(descend.args[0], options)) is None:
                return descend(options=options)
            run.console.message(f"{reason}: steps are taken on the CPU")
        except DeviceFailed as failed:
            run.console.message(f"the GPU failed ({failed}); steps are taken on the CPU")
    return descend(options=replace(options, device="cpu"))


def _note(record: OptimizeRecord, options: OptimizeOptions) -> str:
    notes = [f"{record.steps} steps" + f" ({options.method})" * (options.method != METHOD)]
    if 0 < record.kept < record.steps:
        notes.append(f"best after {record.kept}")
    if REASONS[record.reason]:
        notes.append(REASONS[record.reason])
    return ", ".join(notes) + f"; from {record.psnr_before:.2f} dB on the check views"


def without_undrawn(gaussians: Gaussians, size: int, dilation: float = 0.0) -> Gaussians:
    """Remove splats that viewers discard, which never reach 1/255; small ones are widened first, keeping their mass.

    Arguments are those of `widen_small`.
    """
    widened, kept = widen_small(gaussians, size, dilation)
    return widened.take(kept) if kept.any() else gaussians


def widen_small(gaussians: Gaussians, size: int, dilation: float = 0.0) -> tuple[Gaussians, np.ndarray]:
    """Widen small Gaussians, keeping their mass, and return them with (K,) bool whether each reaches 1/255.

    Args:
        gaussians: in the unit frame.
        size: pixels along the edge of the screen that the file is made for; `SMALLEST` is the least width there.
        dilation: px^2 of dilation that the mass includes; 0 for viewers that compensate theirs.
    """
    pixel = pixel_width(size)
    width = np.exp(gaussians.log_scales.max(axis=1).astype(np.float64))
    widening = np.maximum(SMALLEST * pixel / width, 1)
    beside = dilation * (pixel / width) ** 2
    opacity = np.clip(gaussians.opacity / ((widening**2 + beside) / (1 + beside)), 1e-7, 1 - 1e-7)
    logits = np.where(widening > 1, np.log(opacity / (1 - opacity)), gaussians.opacity_logits)
    scales = gaussians.log_scales + np.log(widening)[:, None]
    return replace(gaussians, log_scales=scales, opacity_logits=logits), opacity >= MIN_ALPHA
