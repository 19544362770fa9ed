"""Views to judge by: cameras and their pictures, whole or in blocks of pixels."""

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

VIEW_BYTES = 2 * 16  # bytes per pixel: float32 RGBA, twice while views are stacked


@dataclass(frozen=True)
class Views:
    """Cameras and their pictures, (n, h, w, 4) float32 premultiplied; with ``blocks``, only those of each view."""

    cameras: list[Camera]
    images: np.ndarray
    blocks: list[Blocks] | None = None

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.cameras)

    def take(self, index: Sequence[int] | np.ndarray) -> Views:
        """Return the views at ``index``."""
        blocks = None if self.blocks is None else [self.blocks[i] for i in index]
        return Views([self.cameras[i] for i in index], self.images[list(index)], blocks)

    def pictures(self, gaussians: Gaussians, rule: Rule = INRIA) -> Iterator[np.ndarray]:
        """Draw Gaussians in each view, whole or in its blocks."""
        from vvgt_cli.splat import render

        for i, camera in enumerate(self.cameras):
            blocks = None if self.blocks is None else self.blocks[i]
            image = render(gaussians, camera, rule, blocks=blocks)
            yield image if blocks is None else blocks.pick(image)

    def psnr(self, gaussians: Gaussians, rule: Rule = INRIA) -> float:
        """Return the mean PSNR (dB) of RGB over black, of the views that show something, or of all if none does.

        Raises:
            DataError: a picture is not finite.
        """
        from vvgt_cli.images.metrics import FOREGROUND, psnr

        pairs = zip(self.images, self.pictures(gaussians, rule), strict=True)
        found = np.array([psnr(view[..., :3], image[..., :3]) for view, image in pairs])
        seen = np.array([view[..., 3].max() > FOREGROUND for view in self.images])
        return float(found[seen | ~seen.any()].mean())


def check_blocks(cameras: Sequence[Camera]) -> list[tuple[Camera, Blocks | None]]:
    """List cameras, each with the blocks of its picture to judge by, None for all of it."""
    return [(camera, spread_blocks(camera.width, camera.height, i, FEW)) for i, camera in enumerate(cameras)]


def render_check_views(scene: Scene | Viewed, cameras: Sequence[Camera], settings: RenderSettings) -> Views:
    """Render views to judge by, of `FEW` blocks where they have more."""
    from vvgt_cli.dvr import render_view

    images, known = [], []
    for camera, blocks in check_blocks(cameras):
        image = render_view(scene, camera, settings, blocks)
        images.append(image if blocks is None else blocks.pick(image))
        known += [] if blocks is None else [blocks]
    return Views(list(cameras), np.stack(images), known or None)
