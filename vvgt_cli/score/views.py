"""Scores of Gaussians on the test views, one view in memory at a time, and the check views."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import FEW, Blocks, Camera, default_views, picked, render_in_box, spread_blocks
from vvgt_cli.gaussians import INRIA, Gaussians, Rule
from vvgt_cli.progress import ProgressCallback, counted
from vvgt_cli.score.viewing import PREVIEW_VIEWS

if TYPE_CHECKING:
    from vvgt_cli.dvr import RenderSettings, Scene, Viewed
    from vvgt_cli.images.metrics import Scores, ViewScore
    from vvgt_cli.splat.render import Shown


def scored_views(size: int, every: bool = True) -> list[tuple[int, Camera, Blocks | None]]:
    """List number and camera of each scored test view, and the blocks of it that are drawn, None for all of it.

    They are those of previews, or all ten, of which those are drawn whole, for measures that blocks do not suffice for.
    """
    cameras = default_views("test", size=size)
    views = []
    for i in range(len(cameras)) if every else PREVIEW_VIEWS:
        blocks = spread_blocks(cameras[i].width, cameras[i].height, i)
        views.append((i, cameras[i], None if every and i in PREVIEW_VIEWS else blocks))
    return views


def score_test_views(
    scene: Scene | Viewed,
    gaussians: Shown,
    size: int,
    settings: RenderSettings | None = None,
    *,
    rule: str | Rule = INRIA,
    every: bool = True,
    progress: ProgressCallback | None = None,
) -> Scores:
    """Score Gaussians on the test views at ``size`` px (docs/conventions.md, "Units of a report").

    Args:
        scene: the volume.
        gaussians: Gaussians to compare with it, or what is shown of them to a camera.
        size: pixels along an image's edge.
        settings: settings of the reference.
        rule: drawing rule of the Gaussians.
        every: all ten views, with SSIM and FLIP, of whole pictures of the `PREVIEW_VIEWS`; other scores use blocks of
            large views. False for the PSNR of the `PREVIEW_VIEWS` alone.
        progress: called after each view.
    """
    from vvgt_cli.dvr import render_view
    from vvgt_cli.images.metrics import mean_scores
    from vvgt_cli.splat import render

    views = []
    for i, camera, drawn in counted(scored_views(size, every), progress):
        reference, ours = render_view(scene, camera, settings, drawn), render(gaussians, camera, rule, blocks=drawn)
        blocks = spread_blocks(camera.width, camera.height, i)
        views.append(score_drawn_view(reference, ours, blocks, every and drawn is None))
    return mean_scores(views)


def score_drawn_view(reference: np.ndarray, ours: np.ndarray, blocks: Blocks | None, whole: bool = True) -> ViewScore:
    """Score one view: errors of its blocks, if any; SSIM and FLIP of the whole, where that was drawn for them.

    Args:
        reference: (h, w, 4) float32 premultiplied picture of the volume.
        ours: the same of the Gaussians.
        blocks: blocks of the view, or None for all of it.
        whole: whether the whole view was drawn, for SSIM and FLIP too.
    """
    from vvgt_cli.images.metrics import score_view

    if blocks is None:
        return score_view(reference, ours, perceptual=whole)
    score = score_view(blocks.pick(reference), blocks.pick(ours), perceptual=False)
    if whole:
        seen = score_view(reference, ours)
        score = replace(score, ssim=seen.ssim, flip=seen.flip)
    return score


def psnr_note(scores: Scores) -> str:
    """Return PSNR as a message."""
    foreground = scores.psnr_foreground
    return f"PSNR {scores.psnr:.2f} dB" + ("" if foreground is None else f" (foreground {foreground:.2f} dB)")


VIEW_BYTES = 2 * 16  # bytes per pixel: float32 RGBA, twice while views are stacked


@dataclass(frozen=True)
class Views:
    """Cameras and their pictures.

    Attributes:
        cameras: n cameras.
        images: (n, h, w, 4) float32 premultiplied.
        blocks: of each view, those that its image holds; None for all.
        weights: of each view, (h, w) factors of differences in its picture; None for 1.
    """

    cameras: list[Camera]
    images: np.ndarray
    blocks: list[Blocks] | None = None
    weights: list[np.ndarray] | None = None

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.cameras)

    def take(self, index: Sequence[int] | np.ndarray) -> Views:
        """Return the views at ``index``."""
        blocks = None if self.blocks is None else [self.blocks[i] for i in index]
        weights = None if self.weights is None else [self.weights[i] for i in index]
        return Views([self.cameras[i] for i in index], self.images[list(index)], blocks, weights)

    def weighed(self, weigh: Callable[[Camera], np.ndarray]) -> Views:
        """Return the views with ``weigh(camera)`` (h, w) as weights, in their blocks."""
        weights = [weigh(camera) for camera in self.cameras]
        if self.blocks is not None:
            weights = [b.pick(w[..., None])[..., 0] for b, w in zip(self.blocks, weights, strict=True)]
        return replace(self, weights=weights)

    def pictures(self, gaussians: Gaussians, rule: Rule = INRIA) -> Iterator[np.ndarray]:
        """Draw Gaussians in each view, whole or in its blocks."""
        from vvgt_cli.splat import render

        for i, camera in enumerate(self.cameras):
            blocks = None if self.blocks is None else self.blocks[i]
            yield picked(render(gaussians, camera, rule, blocks=blocks), blocks)

    def psnr(self, gaussians: Gaussians, rule: Rule = INRIA) -> float:
        """Return the mean PSNR (dB) of RGB over black, of the views that show something, or of all if none does.

        With weights, return `mean_psnr`.

        Raises:
            DataError: a picture is not finite.
        """
        from vvgt_cli.images.metrics import FOREGROUND, mean_psnr, psnr

        if self.weights is not None:
            return mean_psnr(self.images, self.pictures(gaussians, rule), self.weights)
        pairs = zip(self.images, self.pictures(gaussians, rule), strict=True)
        scores = np.array([psnr(view[..., :3], image[..., :3]) for view, image in pairs])
        seen = np.array([view[..., 3].max() > FOREGROUND for view in self.images])
        return float(scores[seen | ~seen.any()].mean())


def check_blocks(cameras: Sequence[Camera]) -> list[tuple[Camera, Blocks | None]]:
    """List cameras, each with the blocks of its picture to judge by, None for all of it."""
    return [(camera, spread_blocks(camera.width, camera.height, i, FEW)) for i, camera in enumerate(cameras)]


def render_check_views(scene: Scene | Viewed, cameras: Sequence[Camera], settings: RenderSettings) -> Views:
    """Render views to judge by, of `FEW` blocks where they have more."""
    from vvgt_cli.dvr import render_view

    images, known = [], []
    for camera, blocks in check_blocks(cameras):
        images.append(picked(render_view(scene, camera, settings, blocks), blocks))
        known += [] if blocks is None else [blocks]
    return Views(list(cameras), np.stack(images), known or None)


def preview(
    scene: Scene | Viewed, gaussians: Shown, cameras: Sequence[Camera], axes: np.ndarray, rule: str | Rule = INRIA
) -> np.ndarray:
    """Draw reference, splats and their difference, a row per camera, upright by ``axes`` (3, 3) from the box frame."""
    from vvgt_cli.dvr import RenderSettings, render_view
    from vvgt_cli.images import side_by_side
    from vvgt_cli.splat import render

    reference = render_in_box(lambda camera: render_view(scene, camera, RenderSettings()), axes)
    ours = render_in_box(lambda camera: render(gaussians, camera, rule), axes)
    return np.concatenate([side_by_side(reference(camera), ours(camera)) for camera in cameras])
