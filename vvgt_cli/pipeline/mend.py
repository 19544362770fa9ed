"""What views of the volume can mend of the closed form: the stages of `convert` between it and the score."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.sets import SET_VIEWS
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.jit.ahead import BACK_PROJECT
from vvgt_cli.optimize import OptimizeOptions
from vvgt_cli.pipeline.optimize import Views, refine
from vvgt_cli.pipeline.plan import SMALLER, Limits, Plan, views_of
from vvgt_cli.pipeline.record import Run
from vvgt_cli.splat.half import QUARTER, halved
from vvgt_cli.splat.rules import INRIA
from vvgt_cli.volume.blocks import free_memory

if TYPE_CHECKING:
    from vvgt_cli.dvr import RenderSettings, Scene
    from vvgt_cli.pipeline.convert import FitOptions
    from vvgt_cli.vbm import Start

VIEW_BYTES = 2 * 16  # a pixel: float32 RGBA, and as much again while views are stacked
MARGIN = 4.0  # dB
WIDE = 0.9  # standard deviation in pixels


def check_view_memory(plan: Plan, size: int) -> None:
    """Refuse a size whose training and check views would not fit."""
    need, free = _view_memory(plan, size), free_memory()
    if free is not None and need > free:
        raise UsageError(
            f"--size {size}: views need {need / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB are free; "
            "try a smaller size, or 'vvgt init', which renders none"
        )


def whole_views_fit(plan: Plan, size: int) -> bool:
    """Whether training views of the whole size would fit in memory."""
    free = free_memory()
    return free is None or _view_memory(replace(plan, half=False), size) <= free


def _view_memory(plan: Plan, size: int) -> float:
    """Bytes of training and check views."""
    if not (plan.back_project or plan.steps or plan.network):
        return 0.0
    return (views_of(plan.steps) * (QUARTER if plan.half else 1) + SET_VIEWS["check"]) * size**2 * VIEW_BYTES


def mend(run: Run, scene: Scene, start: Start, plan: Plan, limits: Limits, fit: FitOptions) -> Gaussians:
    """The closed form after what the plan has for it, or as much of it as the target asks for."""
    target = limits.target_psnr is not None
    if not (plan.back_project or plan.steps or plan.network or (target and plan.judge)):
        _say(run, plan.left_out)
        return start.gaussians
    stage = _Mending(run, scene, plan, limits, fit)
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
    return stage.refine(gaussians) if plan.steps else gaussians


def _say(run: Run, left_out: list[tuple[str, str]]) -> None:
    for name, why in left_out:
        run.leave_out(name, why)


class _Mending:
    """Check views, and what is done with them."""

    def __init__(self, run: Run, scene: Scene, plan: Plan, limits: Limits, fit: FitOptions) -> None:
        from vvgt_cli.dvr import RenderSettings, render_views
        from vvgt_cli.dvr.render import FIT_VIEWS

        self.run, self.scene, self.plan, self.limits, self.fit = run, scene, plan, limits, fit
        cameras = default_views("check", size=fit.size)
        with run.stage("check views") as stage:
            judged = plan.steps or plan.network or limits.target_psnr is not None
            self.check = Views(cameras, render_views(scene, cameras, RenderSettings() if judged else FIT_VIEWS))
            stage.note = f"{len(cameras)} of {fit.size} px"
        self.settings: RenderSettings = FIT_VIEWS
        self.train: Views | None = None

    def psnr(self, gaussians: Gaussians) -> float:
        """On the check views."""
        from vvgt_cli.metrics import score_views
        from vvgt_cli.splat import render

        pictures = [render(gaussians, camera) for camera in self.check.cameras]
        return score_views(self.check.images, pictures, perceptual=False).psnr

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
            mended, how = backproject(start, train.cameras, train.images, progress=bar)
            after = self.psnr(mended)
            stage.kept = after > before
            stage.note = f"{how}; from {before:.2f} dB on the check views"
            stage.psnr_before, stage.psnr = before, after
        return mended if stage.kept else start.gaussians

    def network(self, gaussians: Gaussians) -> Gaussians:
        """One pass of a trained network, kept if the check views agree."""
        from vvgt_cli.pipeline.infer import improve

        assert self.plan.network is not None
        return improve(self.run, gaussians, self.views(gaussians), self.check, self.plan.network)

    def views(self, start: Gaussians) -> Views:
        """Training views, as finely integrated as ``start`` asks for."""
        if self.train is None:
            if self.plan.steps or self.plan.network:
                self.settings = fine_enough(self.scene, self.check, start, self.plan.half)
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
        rule = INRIA.at(0.5) if self.plan.half else INRIA
        options = OptimizeOptions(
            steps=self.plan.most_steps, time_budget=left, target_psnr=target, rule=rule, seed=self.fit.seed
        )
        return refine(self.run, gaussians, train, self.check, options)

    def _rendered(self, count: int) -> Views:
        """Training views."""
        from vvgt_cli.dvr import render_views

        size = self.fit.size // 2 if self.plan.half else self.fit.size
        cameras = default_views("train", count, size=size)
        with self.run.stage("views") as stage:
            images = render_views(self.scene, cameras, self.settings, progress=self.run.console.bar("views"))
            rays = "one ray" if self.settings.samples == 1 else "adaptive rays"
            stage.note = f"{count} of {size} px to fit to, {rays} a pixel, steps of {self.settings.step:g}"
        return Views(cameras, images)


def fine_enough(scene: Scene, check: Views, start: Gaussians, half: bool) -> RenderSettings:
    """One ray a pixel where its error is `MARGIN` below that of ``start``, else adaptive rays; half-voxel steps.

    The error is that of a check view, ``half``: at half its size, against the same finely rendered. Gradient descent
    follows the jags of single rays at hard edges, and those of longer steps everywhere.
    """
    from vvgt_cli.dvr import RenderSettings, render_view
    from vvgt_cli.metrics import psnr
    from vvgt_cli.splat import render

    cameras, views, rule = check.cameras[:1], check.images[:1], INRIA
    if half:
        cameras, views, rule = halved(cameras, views)
    camera, fine = cameras[0], views[0]
    wanted = psnr(fine[..., :3], render(start, camera, rule)[..., :3]) + MARGIN
    single = RenderSettings(samples=1)
    enough = psnr(fine[..., :3], render_view(scene, camera, single)[..., :3]) >= wanted
    return single if enough else RenderSettings()


def wide(gaussians: Gaussians, size: int) -> bool:
    """Whether views of half the size still show them: the median of middle standard deviations is above `WIDE` px."""
    camera = default_views("check", 1, size=size)[0]
    pixel = float(np.linalg.norm(camera.position)) / camera.fx
    middle = np.exp(np.median(gaussians.log_scales, axis=1))  # of three
    return bool(np.median(middle) > WIDE * pixel)
