"""Gradient descent on the Gaussians of a part of a volume, fitted to pictures of that part alone.

Premultiplied pictures compose front to back. So if the Gaussians of every part show what the part shows, all of them
show what the volume shows, and parts can be fitted in any order, by any number of workers, without an exchange.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.sets import RADIUS, pixel_width
from vvgt_cli.conversion.stages.refinement import CHECK_EVERY, WIDER
from vvgt_cli.conversion.stages.views import ray_settings, view_count
from vvgt_cli.field.part import Part
from vvgt_cli.gaussians import Gaussians, as_stored
from vvgt_cli.gaussians.rules import Rule

PIXEL = 3.0  # width of a pixel of the training views, in median standard deviations of the middle axis
SMALLEST, LARGEST, MULTIPLE = 64, 384, 16  # pixels along the edge of a view
SPREAD = 0.5  # share of a screen pixel's width in a training pixel from which rays cover all of the latter


@dataclass(frozen=True)
class PartDescent:
    """Options of the descent on a part.

    Attributes:
        steps: number of steps.
        size: pixels along the edge of the screen that the file is made for.
        rule: rule by which viewers draw.
        seed: seed of the order of views.
        target_psnr: dB on a part's own check views at which its descent ends; None for all steps.
    """

    steps: int
    size: int
    rule: Rule
    seed: int = 0
    target_psnr: float | None = None

    def __call__(self, part: Part, gaussians: Gaussians, distance: float = RADIUS) -> Gaussians:
        """Return Gaussians of the volume's box frame, refined; the given ones where descent does not help.

        Args:
            part: voxels that the Gaussians stand for.
            gaussians: Gaussians of the closed form.
            distance: distance in the unit frame from which they are seen, which decides on the screen's pixel.
        """
        from vvgt_cli.closed_form.shape import widened
        from vvgt_cli.dvr import render_views
        from vvgt_cli.refine import OptimizeOptions, optimize
        from vvgt_cli.score.checks import render_check_views

        if not len(gaussians) or not self.steps:
            return gaussians
        start = part.moved_in(gaussians)
        screen = pixel_width(self.size) * distance / RADIUS * part.scale
        edge = view_edge(start, screen)
        footprint = min(screen / pixel_width(edge), 1.0)
        rule = self.rule.at(footprint)
        settings = ray_settings(part, start, edge, rule, 1.0 if footprint >= SPREAD else footprint)
        check = render_check_views(part, default_views("check", size=edge), settings)
        before, target = check.psnr(start, rule), self.target_psnr
        if target is not None and before >= target:
            return gaussians
        cameras = default_views("train", view_count(self.steps, small=True), size=edge)
        options = OptimizeOptions.of(
            "frame", steps=self.steps, rule=rule, judge=rule, seed=self.seed, target_psnr=target,
            check_every=max(self.steps // 2, 1) if target is None else CHECK_EVERY,
        )  # fmt: skip
        result, record = optimize(
            widened(start, WIDER, screen), cameras, render_views(part, cameras, settings), options,
            check=(check.cameras, check.images, check.blocks), weights=[part.shown(camera) for camera in cameras],
        )  # fmt: skip
        if not (record.psnr_after or 0.0) > before:
            return gaussians
        return as_stored(part.moved_out(result))


def view_edge(gaussians: Gaussians, screen: float) -> int:
    """Return the pixels along the edge of views of Gaussians, whose pixels are as wide as neighbours are apart.

    Args:
        gaussians: Gaussians in the frame of the views.
        screen: width of a screen's pixel there, the least width of a view's pixel.
    """
    middle = float(np.exp(np.median(np.sort(gaussians.log_scales, axis=1)[:, 1])))
    edge = pixel_width(1) / max(PIXEL * middle, screen)
    return int(np.clip(math.ceil(edge / MULTIPLE) * MULTIPLE, SMALLEST, LARGEST))
