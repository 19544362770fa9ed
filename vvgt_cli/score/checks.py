"""`Views`: cameras and what they see, whole or of blocks of pixels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.blocks import FEW, Blocks, spread_blocks
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import INRIA, Rule

if TYPE_CHECKING:
    from vvgt_cli.dvr import RenderSettings, Scene
    from vvgt_cli.dvr.render import Viewed

VIEW_BYTES = 2 * 16  # of memory a pixel: float32 RGBA, and as much again while views are stacked


@dataclass(frozen=True)
class Views:
    """Cameras and what they see, (n, h, w, 4) float32 premultiplied; with ``blocks``, only those of each view."""

    cameras: list[Camera]
    images: np.ndarray
    blocks: list[Blocks] | None = None

    def __len__(self) -> int:
        return len(self.cameras)

    def take(self, index: Sequence[int] | np.ndarray) -> Views:
        """Some of them."""
        blocks = None if self.blocks is None else [self.blocks[i] for i in index]
        return Views([self.cameras[i] for i in index], self.images[list(index)], blocks)

    def pictures(self, gaussians: Gaussians, rule: Rule = INRIA) -> Iterator[np.ndarray]:
        """Gaussians drawn as the views are: whole or their blocks."""
        from vvgt_cli.splat import render

        for i, camera in enumerate(self.cameras):
            blocks = None if self.blocks is None else self.blocks[i]
            image = render(gaussians, camera, rule, blocks=blocks)
            yield image if blocks is None else blocks.pick(image)

    def psnr(self, gaussians: Gaussians, rule: Rule = INRIA) -> float:
        """Mean dB of RGB over black of Gaussians drawn as the views are, of views that show something if any does.

        Raises:
            DataError: a picture that is not finite.
        """
        from vvgt_cli.images.metrics import FOREGROUND, psnr

        pairs = zip(self.images, self.pictures(gaussians, rule), strict=True)
        found = np.array([psnr(view[..., :3], image[..., :3]) for view, image in pairs])
        seen = np.array([view[..., 3].max() > FOREGROUND for view in self.images])
        return float(found[seen | ~seen.any()].mean())


def check_blocks(cameras: Sequence[Camera]) -> list[tuple[Camera, Blocks | None]]:
    """Cameras, each with the blocks of its picture that are judged by, None for all of it."""
    return [(camera, spread_blocks(camera.width, camera.height, i, FEW)) for i, camera in enumerate(cameras)]


def render_check_views(scene: Scene | Viewed, cameras: Sequence[Camera], settings: RenderSettings) -> Views:
    """Views to judge by, of `FEW` blocks where they have more."""
    from vvgt_cli.dvr import render_view

    images, known = [], []
    for camera, part in check_blocks(cameras):
        image = render_view(scene, camera, settings, part)
        images.append(image if part is None else part.pick(image))
        known += [] if part is None else [part]
    return Views(list(cameras), np.stack(images), known or None)
