"""The scoring stages: test views and viewing conditions."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import ClassVar

from vvgt_cli.cameras.blocks import ENOUGH, FEW, spread_blocks
from vvgt_cli.conversion.request import FitOptions
from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.field.field import Picture
from vvgt_cli.field.workload import Workload
from vvgt_cli.gaussians.rules import VIEWERS
from vvgt_cli.score.viewing import (
    PREVIEW_VIEWS,
    SIDE,
    TEXTURED,
    UPRIGHT,
    Axes,
    ConditionPicture,
    condition_pictures,
    condition_views,
    distance_pictures,
    eye_pictures,
    score_conditions,
    score_texture,
    screens,
    texture_cameras,
)
from vvgt_cli.score.views import psnr_note, score_test_views, scored_views

SCORE, SCORE_ALL = (3, 0, 0.03), (10, len(PREVIEW_VIEWS), 0.1)  # views, whole ones, extra seconds per 400 x 400 px
TEXTURE = 0.05  # extra seconds per 400 x 400 px
CONDITIONS = 0.15, 0.155  # extra seconds: fixed, per 100,000 Gaussians


@dataclass(frozen=True)
class TestViews(Stage):
    """Scores on views that nothing was fitted to.

    Attributes:
        whole: whether to score all ten views, by SSIM and FLIP too.
    """

    __test__ = False  # not pytest's
    name: ClassVar[str] = "test views"
    scores: ClassVar[bool] = True
    whole: bool = False

    def cost(self, workload: Workload) -> Cost:
        """Return the cost by pixels."""
        views, whole, beside = SCORE_ALL if self.whole else SCORE
        pixels = whole * workload.size**2 + (views - whole) * workload.test_view_pixels
        return Cost(workload.reference_seconds(pixels) + workload.pace * beside * pixels / 400**2)

    def views(self, fit: FitOptions) -> list[Picture]:
        """List the pictures that are scored."""
        from vvgt_cli.dvr import RenderSettings

        return [Picture(camera, RenderSettings(), blocks) for _, camera, blocks in scored_views(fit.screen, self.whole)]

    def run(self, work: Work) -> None:
        """Score the Gaussians."""
        fit, run = work.fit, work.run
        with run.stage(self.name) as stage:
            bar = run.console.bar(self.name)
            scores = score_test_views(
                work.field.views, work.shown, fit.screen, rule=fit.rule, every=self.whole, progress=bar
            )
            run.report.scores = asdict(scores)
            stage.note = f"{psnr_note(scores)}, {scores.views} views of {fit.screen} px"


def _places(size: int) -> list[tuple[tuple[int, float], int]]:
    """Return size and field of view of the conditions, with the blocks scored: those of the test view where it has any.

    Fields keep the pictures of blocks, so that the test view is not rendered again.
    """
    return list(zip(screens(size), (ENOUGH if spread_blocks(size, size) else FEW, FEW), strict=True))


@dataclass(frozen=True)
class ViewingConditions(Stage):
    """Scores by every rule at the target size and above, and of texture on smooth areas; skipped where time is up.

    Attributes:
        target: name of the device that the file is made for; a headset's eyes are scored, too.
        axes: those of a headset (`vvgt_cli.conversion.place.headset_axes`).
        levels: whether they are levels of detail, which are also scored from other distances.
    """

    name: ClassVar[str] = "conditions"
    scores: ClassVar[bool] = True
    target: str | None = None
    axes: Axes = UPRIGHT
    levels: bool = False

    def cost(self, workload: Workload) -> Cost:
        """Return the cost by pixels and Gaussians."""
        near = (workload.size // TEXTURED) ** 2
        splats = CONDITIONS[0] + CONDITIONS[1] * workload.gaussians / 1e5 + TEXTURE * near / 400**2
        views = sum(enough == FEW for _, enough in _places(workload.size)) + len(self._others(workload.size))
        return Cost(views * workload.check_view_seconds + workload.reference_seconds(near) + workload.pace * splats)

    def _wanted(self, size: int) -> list[ConditionPicture]:
        around = [one for place, enough in _places(size) for one in condition_pictures([place], SIDE, enough)]
        return around + self._others(size)

    def _others(self, size: int) -> list[ConditionPicture]:
        """List the pictures for eyes in a headset, and from other distances."""
        return eye_pictures(self.target, self.axes, SIDE, FEW) + self.levels * distance_pictures(size, SIDE, FEW)

    def views(self, fit: FitOptions) -> list[Picture]:
        """List the pictures that are scored."""
        from vvgt_cli.dvr import RenderSettings

        conditions = [Picture(camera, RenderSettings(), blocks) for _, camera, blocks in self._wanted(fit.screen)]
        return [*conditions, *(Picture(camera, RenderSettings()) for camera in texture_cameras(fit.screen))]

    def run(self, work: Work) -> None:
        """Score the Gaussians."""
        from vvgt_cli.dvr import RenderSettings

        run, budget, fit = work.run, work.fit.time_budget, work.fit
        if budget is not None and run.elapsed() > budget:
            run.skip(self.name, "time is up")
            return
        with run.stage(self.name) as stage:
            made, settings = work.shown, RenderSettings()
            seen = condition_views(work.field.views, self._wanted(fit.screen), settings)
            conditions = score_conditions(made, seen, dict.fromkeys((*VIEWERS, fit.rule)), fit.rule)
            run.report.conditions = [asdict(condition) for condition in conditions]
            near, views = texture_cameras(fit.screen), work.field.views
            run.report.texture = asdict(score_texture(views, made, fit.screen, fit.rule, settings, cameras=near))
            stage.note = f"worst of {len(conditions)}: {conditions[0].name()}, {conditions[0].psnr:.2f} dB"
