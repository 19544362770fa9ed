"""Gaussians against the volume on the test views: one view in memory at a time."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.cameras.blocks import Blocks, spread_blocks
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import INRIA, Rule
from vvgt_cli.progress import ProgressCallback

if TYPE_CHECKING:
    from vvgt_cli.dvr import RenderSettings, Scene
    from vvgt_cli.dvr.render import Viewed
    from vvgt_cli.images.metrics import Scores, ViewScore

WHOLE = (0, 4, 9)  # test views of which large ones are drawn whole, for what blocks cannot tell


def scored_views(
    size: int, perceptual: bool, only: Collection[int] | None = None
) -> list[tuple[int, Camera, Blocks | None]]:
    """Number and camera of each test view that is scored, with the blocks of it that are drawn, None for all of it."""
    cameras = default_views("test", size=size)
    found = []
    for i in sorted(range(len(cameras)) if only is None else only):
        blocks = spread_blocks(cameras[i].width, cameras[i].height, i)
        found.append((i, cameras[i], None if perceptual and i in WHOLE else blocks))
    return found


def score_test_views(
    scene: Scene | Viewed,
    gaussians: Gaussians,
    size: int,
    settings: RenderSettings,
    *,
    rule: str | Rule = INRIA,
    perceptual: bool = True,
    only: Collection[int] | None = None,
    progress: ProgressCallback | None = None,
) -> Scores:
    """Scores on the test views at ``size`` px (docs/conventions.md, "Units of a report").

    Args:
        scene, gaussians: what is compared.
        size: pixels along an image's edge.
        settings: of the reference.
        rule: by which Gaussians are drawn.
        perceptual: SSIM and FLIP too, of the whole of `WHOLE` views; all else of blocks where views are large.
        only: numbers of the views to score; None for all ten.
        progress: called after each view.
    """
    from vvgt_cli.dvr import render_view
    from vvgt_cli.images.metrics import mean_scores
    from vvgt_cli.splat import render

    views, wanted = [], scored_views(size, perceptual, only)
    for done, (i, camera, part) in enumerate(wanted):
        reference, ours = render_view(scene, camera, settings, part), render(gaussians, camera, rule, blocks=part)
        blocks = spread_blocks(camera.width, camera.height, i)
        views.append(score_drawn_view(reference, ours, blocks, part is None, perceptual))
        if progress:
            progress(done + 1, len(wanted))
    return mean_scores(views)


def score_drawn_view(
    reference: np.ndarray, ours: np.ndarray, blocks: Blocks | None, whole: bool = True, perceptual: bool = True
) -> ViewScore:
    """One view: errors of its blocks, where it has such; SSIM and FLIP of the whole, where it was drawn.

    Args:
        reference, ours: (h, w, 4) float32 premultiplied.
        blocks: of the view, or None for all of it.
        whole: whether more than the blocks was drawn.
        perceptual: SSIM and FLIP too.
    """
    from vvgt_cli.images.metrics import score_view

    if blocks is None:
        return score_view(reference, ours, perceptual=perceptual)
    score = score_view(blocks.pick(reference), blocks.pick(ours), perceptual=False)
    if perceptual and whole:
        seen = score_view(reference, ours)
        score = replace(score, ssim=seen.ssim, flip=seen.flip)
    return score


def psnr_note(scores: Scores) -> str:
    """PSNR as stages print it."""
    foreground = scores.psnr_foreground
    return f"PSNR {scores.psnr:.2f} dB" + ("" if foreground is None else f" (foreground {foreground:.2f} dB)")
