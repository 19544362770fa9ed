"""What views of the volume can mend of the closed form: the stages of `convert` between it and the score."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.cameras.blocks import spread_blocks
from vvgt_cli.cameras.sets import SET_VIEWS
from vvgt_cli.descent import OptimizeOptions
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.jit.ahead import BACK_PROJECT
from vvgt_cli.pipeline.optimize import Views, refine
from vvgt_cli.pipeline.plan import SMALLER, Limits, Plan, view_edge, views_of
from vvgt_cli.pipeline.record import Run
from vvgt_cli.resources import free_memory
from vvgt_cli.splat.constants import MIN_ALPHA
from vvgt_cli.splat.rules import Rule, rule_of

if TYPE_CHECKING:
    from vvgt_cli.dvr import RenderSettings, Scene
    from vvgt_cli.pipeline.convert import FitOptions
    from vvgt_cli.vbm import Start

VIEW_BYTES = 2 * 16  # a pixel: float32 RGBA, and as much again while views are stacked
MARGIN, SAMPLES = 4.0, 12.0  # dB, where views are means over their pixels, and where they are samples of a screen's
SMALLEST = 0.5  # standard deviation of the longest axis in pixels of the screen: viewers drop or fade less
MOST = 0.99  # of the Gaussians: as many are left where small ones are widened, as a rule
LARGE = 0.5  # of the screen: views as large are means over their own pixels
WIDE = 0.9  # standard deviation in pixels of whole training views
LOOK = 25  # steps between two looks at the check views where a target ends the run; else one is taken in the middle
SOLID = 0.9  # median opacity of opaque bodies


def check_view_memory(plan: Plan, size: int) -> None:
    """Refuse a size whose training and check views would not fit."""
    need, free = _view_memory(plan, size), free_memory()
    if free is not None and need > free:
        raise UsageError(
            f"--size {size}: views need {need / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB are free; "
            f"--size {max(math.floor(size * math.sqrt(free / need)), 1)} would fit, or 'vvgt init', which renders none"
        )


def _view_memory(plan: Plan, size: int) -> float:
    """Bytes of training and check views; one of these is drawn whole, of which blocks are kept."""
    if not (plan.back_project or plan.steps or plan.network):
        return 0.0
    return (views_of(plan.steps) * plan.view_size**2 + (1 + SET_VIEWS["check"]) * size**2) * VIEW_BYTES


def judging_views(scene: Scene, cameras: Sequence[Camera], settings: RenderSettings) -> Views:
    """Views to score by, of blocks where they are large."""
    from vvgt_cli.dvr import render_view

    blocks = [spread_blocks(camera.width, camera.height, i) for i, camera in enumerate(cameras)]
    images = []
    for camera, part in zip(cameras, blocks, strict=True):
        image = render_view(scene, camera, settings, part)
        images.append(image if part is None else part.pick(image))
    known = [part for part in blocks if part is not None]
    return Views(list(cameras), np.stack(images), known or None)


def mend(
    run: Run, scene: Scene, start: Start, plan: Plan, limits: Limits, fit: FitOptions, checkpoint: str | None = None
) -> Gaussians:
    """The closed form after what the plan has for it, or as much of it as the target asks for.

    ``checkpoint``: file by which gradient descent goes on where it ended.
    """
    target = limits.target_psnr is not None
    if not (plan.back_project or plan.steps or plan.network or (target and plan.judge)):
        _say(run, plan.left_out)
        return start.gaussians
    stage = _Mending(run, scene, plan, limits, fit, checkpoint)
    if stage.enough(start.gaussians):
        unneeded = {"network": plan.network, "back-projection": plan.back_project, "refinement": plan.steps}
        _say(run, [(name, stage.reached()) for name, planned in unneeded.items() if planned])
        return stage.smaller(start)
    _say(run, plan.left_out)
    gaussians = stage.back_project(start) if plan.back_project else start.gaussians
    if plan.network:
        gaussians = stage.network(gaussians)
    if plan.steps and stage.enough(gaussians):
        _say(run, [("refinement", stage.reached())])
        return gaussians
    return stage.shown(stage.refine(gaussians)) if plan.steps else gaussians


def _say(run: Run, left_out: list[tuple[str, str]]) -> None:
    for name, why in left_out:
        run.leave_out(name, why)


class _Mending:
    """Check views, and what is done with them."""

    def __init__(
        self, run: Run, scene: Scene, plan: Plan, limits: Limits, fit: FitOptions, checkpoint: str | None
    ) -> None:
        from vvgt_cli.dvr import RenderSettings
        from vvgt_cli.dvr.render import FIT_VIEWS

        self.checkpoint = checkpoint
        self.run, self.scene, self.plan, self.limits, self.fit = run, scene, plan, limits, fit
        cameras = default_views("check", size=fit.size)
        with run.stage("check views") as stage:
            judged = plan.steps or plan.network or limits.target_psnr is not None
            self.check = judging_views(scene, cameras, RenderSettings() if judged else FIT_VIEWS)
            stage.note = f"{len(cameras)} of {fit.size} px" + (", blocks of them" if self.check.blocks else "")
        self.settings: RenderSettings = FIT_VIEWS
        self.rule = rule_of(fit.rule)
        self.footprint = plan.view_size / fit.size
        self.train_rule = self.rule.at(self.footprint)
        if self.footprint >= LARGE:
            self.footprint = 1.0
        self.train: Views | None = None

    def psnr(self, gaussians: Gaussians) -> float:
        """On the check views."""
        from vvgt_cli.metrics import score_views

        return score_views(self.check.images, self.check.pictures(gaussians, self.rule), perceptual=False).psnr

    def enough(self, gaussians: Gaussians) -> bool:
        """Whether the target is reached."""
        return self.limits.target_psnr is not None and self.psnr(gaussians) >= self.limits.target_psnr

    def reached(self) -> str:
        """Why the rest is left out."""
        return f"the check views have {self.limits.target_psnr:g} dB without it"

    def smaller(self, start: Start) -> Gaussians:
        """The fewest Gaussians that reach the target: a part of the budget, or all."""
        count = len(start.gaussians)
        for part in SMALLER if start.form is not None else ():
            assert start.form is not None
            fewer = replace(start.form, budget=max(count // part, 1)).gaussians()
            if len(fewer) < count and self.enough(fewer):
                self.run.leave_out(f"{count - len(fewer)} Gaussians", "the target is reached without")
                return fewer
        return start.gaussians

    def back_project(self, start: Start) -> Gaussians:
        """Cells split and colours solved, kept if the check views agree."""
        from vvgt_cli.vbm import backproject

        run, train = self.run, self.views(start.gaussians)
        run.compile(BACK_PROJECT)
        with run.stage("back-projection") as stage:
            before = self.psnr(start.gaussians)
            bar = run.console.bar("back-projection")
            mended, how = backproject(start, train.cameras, train.images, progress=bar, rule=self.train_rule)
            after = self.psnr(mended)
            stage.kept = after > before
            stage.note = f"{how}; from {before:.2f} dB on the check views"
            stage.psnr_before, stage.psnr = before, after
        return mended if stage.kept else start.gaussians

    def network(self, gaussians: Gaussians) -> Gaussians:
        """One pass of a trained network, kept if the check views agree."""
        from vvgt_cli.pipeline.infer import improve

        assert self.plan.network is not None
        return improve(
            self.run, gaussians, self.views(gaussians), self.check, self.plan.network, (self.train_rule, self.rule)
        )

    def views(self, start: Gaussians) -> Views:
        """Training views, as finely integrated as ``start`` asks for."""
        if self.train is None:
            if self.plan.steps or self.plan.network:
                self.settings = fine_enough(self.scene, start, self.plan.view_size, self.train_rule, self.footprint)
            self.train = self._rendered(views_of(self.plan.steps))
        return self.train

    def refine(self, gaussians: Gaussians) -> Gaussians:
        """Gradient descent on the training views."""
        train = self.views(gaussians)
        left = None
        if self.limits.time_budget is not None:
            ending = sum(seconds for name, seconds in self.plan.stages if name in ("test views", "write"))
            left = max(self.limits.time_budget - self.run.elapsed() - ending, 0.0)
        target = self.limits.target_psnr
        options = OptimizeOptions(
            steps=self.plan.most_steps, time_budget=left, target_psnr=target, rule=self.train_rule, judge=self.rule,
            seed=self.fit.seed, checkpoint=self.checkpoint,
            check_every=LOOK if target is not None else max(LOOK, self.plan.most_steps // 2),
        )  # fmt: skip
        return refine(self.run, gaussians, train, self.check, options)

    def shown(self, gaussians: Gaussians) -> Gaussians:
        """`drawn_by_all`; where that leaves out many, the mass is counted as the check views agree."""
        kept = drawn_by_all(gaussians, self.fit.size)
        if len(kept) >= MOST * len(gaussians):
            return kept
        return max(kept, drawn_by_all(gaussians, self.fit.size, self.rule.dilation), key=self.psnr)

    def _rendered(self, count: int) -> Views:
        """Training views."""
        from vvgt_cli.dvr import render_views

        size = self.plan.view_size
        cameras = default_views("train", count, size=size)
        with self.run.stage("views") as stage:
            images = render_views(self.scene, cameras, self.settings, progress=self.run.console.bar("views"))
            rays = "one ray" if self.settings.samples == 1 else "adaptive rays"
            stage.note = f"{count} of {size} px to fit to, {rays} a pixel, steps of {self.settings.step:g}"
        return Views(cameras, images)


def fine_enough(scene: Scene, start: Gaussians, size: int, rule: Rule, footprint: float = 1.0) -> RenderSettings:
    """One ray a pixel where its error is `MARGIN` or `SAMPLES` below that of ``start``, else adaptive rays.

    The error is that of a check view of ``size`` px drawn by ``rule``, against the same finely rendered. Gradient
    descent follows the jags of single rays at hard edges, and those of longer steps everywhere. Rays are spread over
    ``footprint`` of a pixel's edge: views are samples of the screen's pixels, not means over their own.
    """
    from vvgt_cli.dvr import RenderSettings, render_view
    from vvgt_cli.metrics import psnr
    from vvgt_cli.splat import render

    camera = default_views("check", size=size)[0]
    many, one = RenderSettings(footprint=footprint), RenderSettings(samples=1)
    fine, single = (render_view(scene, camera, settings) for settings in (many, one))
    wanted = psnr(fine[..., :3], render(start, camera, rule)[..., :3])
    wanted += MARGIN if footprint == 1 else SAMPLES
    enough = psnr(fine[..., :3], single[..., :3]) >= wanted
    return one if enough else many


def drawn_by_all(gaussians: Gaussians, size: int, dilation: float = 0.0) -> Gaussians:
    """Without what viewers leave out: splats that never reach 1/255, and, widened with their mass kept, small ones.

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
    kept = opacity >= MIN_ALPHA
    if not kept.any():
        return gaussians
    logits = np.where(widening > 1, np.log(opacity / (1 - opacity)), gaussians.opacity_logits)
    scales = gaussians.log_scales + np.log(widening)[:, None]
    fields = (gaussians.means, scales, gaussians.quaternions, logits, gaussians.colors)
    return Gaussians(*(field[kept] for field in fields))


def wide(gaussians: Gaussians, size: int) -> bool:
    """Whether training views half as large as they may be still show Gaussians.

    That is so where the median of middle standard deviations is above `WIDE` px of whole ones, and bodies are not
    opaque: of these the edges are all there is.
    """
    camera = default_views("check", 1, size=view_edge(size, half=False))[0]
    pixel = float(np.linalg.norm(camera.position)) / camera.fx
    middle = np.exp(np.median(gaussians.log_scales, axis=1))  # of three
    solid = np.median(gaussians.opacity_logits) > np.log(SOLID / (1 - SOLID))
    return bool(np.median(middle) > WIDE * pixel and not solid)
