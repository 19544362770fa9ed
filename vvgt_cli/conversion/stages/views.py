"""Views of the volume: those that judge, and those that are fitted to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.cameras.blocks import Blocks, spread_blocks
from vvgt_cli.cameras.sets import SET_VIEWS
from vvgt_cli.conversion.request import FitOptions
from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.field.field import Picture
from vvgt_cli.field.workload import Workload, view_edge
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import Rule
from vvgt_cli.score.checks import VIEW_BYTES, Views, judged, judging_views

if TYPE_CHECKING:
    from vvgt_cli.dvr import RenderSettings, Scene
    from vvgt_cli.dvr.render import Viewed

MOST_VIEWS = 120  # training views of gradient descent at most, in whole sets
VIEWS_A_STEP = (
    0.65,
    0.85,
)  # views a step, small and large: fewer overfit, more cost steps (docs/log/refinement.md)
MARGIN, SAMPLES = 4.0, 12.0  # dB, where views are means over their pixels, and where they are samples of a screen's
LONGER = 6.0  # dB more, for longer steps: their errors are the same from all sides
PROBED = 72  # blocks of a view that rays are tried on
LARGE = 0.5  # of the screen: views as large are means over their own pixels
WIDE = 0.9  # standard deviation in pixels
SOLID = 0.9  # median opacity of opaque bodies


def views_of(steps: int, small: bool) -> int:
    """Training views of so many steps, in whole sets."""
    fewest, each = SET_VIEWS["train"], VIEWS_A_STEP[0] if small else VIEWS_A_STEP[1]
    return fewest * min(max(round(each * steps / fewest), 1), MOST_VIEWS // fewest)


@dataclass(frozen=True)
class CheckViews(Stage):
    """Views that decide what is kept.

    Attributes:
        fine: integrated over pixels, as what is judged by them is worth it.
    """

    name: ClassVar[str] = "check views"
    fine: bool = True

    def cost(self, case: Workload) -> Cost:
        """One of them is drawn whole, of which blocks are kept."""
        count = SET_VIEWS["check"]
        return Cost(count * case.check_view_seconds, (count * case.check_view_pixels + case.size**2) * VIEW_BYTES)

    def views(self, fit: FitOptions) -> list[Picture]:
        """They."""
        from vvgt_cli.dvr import RenderSettings
        from vvgt_cli.dvr.render import FIT_VIEWS

        settings = RenderSettings() if self.fine else FIT_VIEWS
        return [Picture(camera, settings, part) for camera, part in judged(default_views("check", size=fit.size))]

    def run(self, work: Work) -> None:
        """Render them, unless they are there."""
        from vvgt_cli.dvr import RenderSettings
        from vvgt_cli.dvr.render import FIT_VIEWS

        if work.check is not None:
            return
        size = work.fit.size
        cameras = default_views("check", size=size)
        with work.run.stage(self.name) as stage:
            work.check = judging_views(work.field.views, cameras, RenderSettings() if self.fine else FIT_VIEWS)
            stage.note = f"{len(cameras)} of {size} px" + (", blocks of them" if work.check.blocks else "")


@dataclass(frozen=True)
class TrainingViews(Stage):
    """Views to fit to.

    Attributes:
        count: how many.
        edge: pixels along their edge.
        fitted: they are fitted to by descent, and as finely integrated as that asks for.
    """

    name: ClassVar[str] = "views"
    count: int = SET_VIEWS["train"]
    edge: int = 200
    fitted: bool = True

    def cost(self, case: Workload) -> Cost:
        """By pixels."""
        return Cost(self.count * case.view * (self.edge / case.edge) ** 2, self.count * self.edge**2 * VIEW_BYTES)

    def label(self) -> str:
        """With their number and size."""
        return f"{self.count} views of {self.edge} px"

    def views(self, fit: FitOptions) -> list[Picture]:
        """They, with one ray a pixel, and what says whether that is enough."""
        from vvgt_cli.dvr.render import FIT_VIEWS

        found = [Picture(camera, FIT_VIEWS) for camera in default_views("train", self.count, size=self.edge)]
        if self.fitted:
            camera, blocks = _probe(self.edge)
            found += [Picture(camera, settings, blocks) for settings in _tried(_spread(self.edge / fit.size))]
        return found

    def run(self, work: Work) -> None:
        """Render them, as finely as the Gaussians ask for."""
        from vvgt_cli.dvr import render_views
        from vvgt_cli.dvr.render import FIT_VIEWS

        footprint = self.edge / work.fit.size
        work.train_rule = work.rule.at(footprint)
        settings = FIT_VIEWS
        if self.fitted:
            settings = fine_enough(work.field.views, work.made(), self.edge, work.train_rule, _spread(footprint))
        cameras = default_views("train", self.count, size=self.edge)
        with work.run.stage(self.name) as stage:
            images = render_views(work.field.views, cameras, settings, progress=work.run.console.bar(self.name))
            rays = "one ray" if settings.samples == 1 else "adaptive rays"
            stage.note = f"{self.count} of {self.edge} px to fit to, {rays} a pixel, steps of {settings.step:g}"
        work.train, work.train_settings = Views(cameras, images), settings


def _spread(footprint: float) -> float:
    """Part of a pixel's edge that the rays of a training view cover, which is ``footprint`` of the screen's size."""
    return 1.0 if footprint >= LARGE else footprint


def _probe(size: int) -> tuple[Camera, Blocks | None]:
    """The check view, and the blocks of it, that settings are tried on."""
    return default_views("check", size=size)[0], spread_blocks(size, size, enough=PROBED)


def _tried(footprint: float) -> tuple[RenderSettings, RenderSettings, RenderSettings]:
    """Adaptive rays, and one a pixel with longer and shorter steps."""
    from vvgt_cli.dvr import RenderSettings
    from vvgt_cli.dvr.render import FIT_VIEWS

    return RenderSettings(footprint=footprint), FIT_VIEWS, RenderSettings(samples=1)


def fine_enough(
    scene: Scene | Viewed, start: Gaussians, size: int, rule: Rule, footprint: float = 1.0
) -> RenderSettings:
    """One ray a pixel where its error is `MARGIN` or `SAMPLES` below that of ``start``, else adaptive rays.

    The error is that of a check view of ``size`` px drawn by ``rule``, against the same finely rendered. Gradient
    descent follows the jags of single rays at hard edges, and those of longer steps everywhere: where the error is
    `LONGER` below that too with steps of a voxel, these are taken. Rays are spread over ``footprint`` of a pixel's
    edge: views are samples of the screen's pixels, not means over their own.
    """
    from vvgt_cli.dvr import render_view
    from vvgt_cli.images.metrics import psnr
    from vvgt_cli.splat import render

    camera, blocks = _probe(size)

    def picked(image: np.ndarray) -> np.ndarray:
        return (image if blocks is None else blocks.pick(image))[..., :3]

    many, longer, shorter = _tried(footprint)
    fine = picked(render_view(scene, camera, many, blocks))
    wanted = psnr(fine, picked(render(start, camera, rule, blocks=blocks)))
    wanted += MARGIN if footprint == 1 else SAMPLES
    for single, more in ((longer, LONGER), (shorter, 0.0)):
        if psnr(fine, picked(render_view(scene, camera, single, blocks))) >= wanted + more:
            return single
    return many


def wide(gaussians: Gaussians, size: int) -> bool:
    """Whether small training views still show Gaussians.

    That is so where the median of middle standard deviations is above `WIDE` px of a view twice as large, and bodies
    are not opaque: of these the edges are all there is.
    """
    camera = default_views("check", 1, size=2 * view_edge(size, small=True))[0]
    pixel = float(np.linalg.norm(camera.position)) / camera.fx
    middle = np.exp(np.median(gaussians.log_scales, axis=1))  # of three
    solid = np.median(gaussians.opacity_logits) > np.log(SOLID / (1 - SOLID))
    return bool(np.median(middle) > WIDE * pixel and not solid)
