"""The stages that render views of the volume: check views to measure PSNR on, and training views to fit to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from vvgt_cli.cameras import SET_VIEWS, Blocks, Camera, default_views, picked, pixel_width, spread_blocks
from vvgt_cli.conversion.request import FitOptions
from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.field.field import Picture
from vvgt_cli.field.workload import Workload, view_edge
from vvgt_cli.gaussians import Gaussians, Rule
from vvgt_cli.score.views import VIEW_BYTES, Views, check_blocks, render_check_views

if TYPE_CHECKING:
    from vvgt_cli.dvr import RenderSettings, Scene, Viewed

MAX_VIEWS = 120  # maximal number of training views of gradient descent, in whole sets
VIEWS_A_STEP = 0.65, 0.85  # small and large views per step: fewer overfit, more cost steps (docs/log/refinement.md)
MARGIN, SAMPLES = 4.0, 12.0  # dB, for views that are means over their pixels, and for samples of screen pixels
LONGER = 6.0  # extra dB for longer steps, whose errors are the same from all sides
PROBED = 72  # blocks of a view on which ray settings are tried
LARGE = 0.5  # share of the screen size from which views are means over their own pixels
WIDE = 0.9  # standard deviation in pixels
SOLID = 0.9  # median opacity of opaque bodies


def view_count(steps: int, small: bool) -> int:
    """Return the number of training views for a number of steps, in whole sets."""
    fewest, each = SET_VIEWS["train"], VIEWS_A_STEP[0] if small else VIEWS_A_STEP[1]
    return fewest * min(max(round(each * steps / fewest), 1), MAX_VIEWS // fewest)


@dataclass(frozen=True)
class CheckViews(Stage):
    """Views that decide what is kept.

    Attributes:
        fine: whether they are integrated over pixels.
        edge: number of pixels along an edge; None for the screen's.
    """

    name: ClassVar[str] = "check views"
    fine: bool = True
    edge: int | None = None

    def cost(self, workload: Workload) -> Cost:
        """Return the cost by pixels; memory includes one whole view, of which blocks are kept."""
        count = SET_VIEWS["check"]
        return Cost(
            count * workload.check_view_seconds, (count * workload.check_view_pixels + workload.size**2) * VIEW_BYTES
        )

    def views(self, fit: FitOptions) -> list[Picture]:
        """List the check views."""
        from vvgt_cli.dvr import FIT_VIEWS, RenderSettings

        settings = RenderSettings() if self.fine else FIT_VIEWS
        return [
            Picture(camera, settings, blocks)
            for camera, blocks in check_blocks(default_views("check", size=fit.screen))
        ]

    def run(self, work: Work) -> None:
        """Render the check views, unless that is done."""
        from vvgt_cli.dvr import FIT_VIEWS, RenderSettings

        if work.check is not None:
            return
        size = self.edge or work.fit.screen
        cameras = default_views("check", size=size)
        with work.run.stage(self.name) as stage:
            work.check = render_check_views(work.field.views, cameras, RenderSettings() if self.fine else FIT_VIEWS)
            stage.note = f"{len(cameras)} of {size} px" + (", blocks of them" if work.check.blocks else "")
        if work.weigh is not None:
            work.check = work.check.weighed(work.weigh)


@dataclass(frozen=True)
class TrainingViews(Stage):
    """Views to fit to.

    Attributes:
        count: number of views.
        edge: pixels along their edge.
        fitted: whether descent fits to them, which needs finer integration.
    """

    name: ClassVar[str] = "views"
    count: int = SET_VIEWS["train"]
    edge: int = 200
    fitted: bool = True

    def cost(self, workload: Workload) -> Cost:
        """Return the cost by pixels."""
        return Cost(
            self.count * workload.view * (self.edge / workload.edge) ** 2, self.count * self.edge**2 * VIEW_BYTES
        )

    def label(self) -> str:
        """Return their number and size."""
        return f"{self.count} views of {self.edge} px"

    def views(self, fit: FitOptions) -> list[Picture]:
        """List the views, with one ray per pixel, and the pictures that decide whether that is enough."""
        from vvgt_cli.dvr.render import FIT_VIEWS

        pictures = [Picture(camera, FIT_VIEWS) for camera in default_views("train", self.count, size=self.edge)]
        if self.fitted:
            camera, blocks = _probe(self.edge)
            pictures += [Picture(camera, settings, blocks) for settings in _candidates(_spread(self.edge / fit.screen))]
        return pictures

    def run(self, work: Work) -> None:
        """Render the views, as finely as the Gaussians need."""
        from vvgt_cli.dvr import FIT_VIEWS, render_views

        footprint = self.edge / work.fit.screen
        work.train_rule = work.rule.at(footprint)
        settings = FIT_VIEWS
        if self.fitted:
            settings = ray_settings(work.field.views, work.current(), self.edge, work.train_rule, _spread(footprint))
        cameras = default_views("train", self.count, size=self.edge)
        with work.run.stage(self.name) as stage:
            images = render_views(work.field.views, cameras, settings, progress=work.run.console.bar(self.name))
            rays = "one ray" if settings.samples == 1 else "adaptive rays"
            stage.note = f"{self.count} of {self.edge} px to fit to, {rays} a pixel, steps of {settings.step:g}"
        work.train, work.train_settings = Views(cameras, images), settings
        if work.weigh is not None:
            work.train = work.train.weighed(work.weigh)


def _spread(footprint: float) -> float:
    """Return the share of a pixel's edge over which rays are spread, for a view of ``footprint`` times the screen."""
    return 1.0 if footprint >= LARGE else footprint


def _probe(size: int) -> tuple[Camera, Blocks | None]:
    """Return the check view, and its blocks, on which ray settings are tried."""
    return default_views("check", size=size)[0], spread_blocks(size, size, enough=PROBED)


def _candidates(footprint: float) -> tuple[RenderSettings, RenderSettings, RenderSettings]:
    """Return settings of adaptive rays, and of one ray per pixel with longer and shorter steps."""
    from vvgt_cli.dvr import FIT_VIEWS, RenderSettings

    return RenderSettings(footprint=footprint), FIT_VIEWS, RenderSettings(samples=1)


def ray_settings(
    scene: Scene | Viewed, start: Gaussians, size: int, rule: Rule, footprint: float = 1.0
) -> RenderSettings:
    """Choose one ray per pixel where its error is `MARGIN` or `SAMPLES` dB below that of ``start``, else adaptive rays.

    The error is that of a check view of ``size`` px drawn by ``rule``, against adaptive rays. Gradient descent fits
    the aliasing of single rays at hard edges, and that of longer steps everywhere: these are taken only where their
    error is another `LONGER` dB lower. Rays are spread over ``footprint`` of a pixel's edge, so that views are samples
    of the screen's pixels.
    """
    from vvgt_cli.dvr import render_view
    from vvgt_cli.images.metrics import psnr
    from vvgt_cli.splat import render

    camera, blocks = _probe(size)

    many, longer, shorter = _candidates(footprint)
    fine = picked(render_view(scene, camera, many, blocks)[..., :3], blocks)
    wanted = psnr(fine, picked(render(start, camera, rule, blocks=blocks)[..., :3], blocks))
    wanted += MARGIN if footprint == 1 else SAMPLES
    for single, more in ((longer, LONGER), (shorter, 0.0)):
        if psnr(fine, picked(render_view(scene, camera, single, blocks)[..., :3], blocks)) >= wanted + more:
            return single
    return many


def suits_small_views(gaussians: Gaussians, size: int) -> bool:
    """Return whether the Gaussians are wide enough for small training views.

    They are where the median of the middle standard deviations is above `WIDE` px of a view twice as large, and bodies
    are not opaque, since only the edges of opaque ones are seen.
    """
    pixel = pixel_width(2 * view_edge(size, small=True))
    middle = np.exp(np.median(gaussians.log_scales, axis=1))  # of three
    solid = np.median(gaussians.opacity_logits) > np.log(SOLID / (1 - SOLID))
    return bool(np.median(middle) > WIDE * pixel and not solid)
