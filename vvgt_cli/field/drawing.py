"""A picture of a volume in blocks while it is being rendered."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.blocks import Blocks
from vvgt_cli.dvr.render import Rays, RenderSettings, first_rays, more_rays


@dataclass
class Drawing:
    """A partially rendered picture, which stores only the pixels of its blocks.

    Attributes:
        key: digest of the picture.
        camera, settings, blocks: the fields of `Picture`.
    """

    key: str
    camera: Camera
    settings: RenderSettings
    blocks: Blocks | None

    @cached_property
    def colors(self) -> np.ndarray:
        """Colours (n, 4) float32 of the pixels of `pixel_mask`, row by row."""
        return np.zeros((int(self.pixel_mask().sum()), 4), np.float32)

    def pixel_mask(self) -> np.ndarray:
        """Return the mask (h, w) of the pixels to render."""
        shape = self.camera.height, self.camera.width
        return np.ones(shape, bool) if self.blocks is None else self.blocks.mask()

    def image(self) -> np.ndarray:
        """Return the picture (h, w, 4), zero outside the blocks."""
        whole = np.zeros((self.camera.height, self.camera.width, 4), np.float32)
        whole[self.pixel_mask()] = self.colors
        return whole

    def first_pass(self) -> list[Rays]:
        """Return the rays of the first pass."""
        return first_rays(self.settings, self.pixel_mask())

    def second_pass(self) -> list[Rays]:
        """Return the rays of the second pass."""
        return more_rays(self.settings, self.image(), self.pixel_mask())

    def add(self, rays: Rays, shown: np.ndarray) -> None:
        """Average in the colours that ``rays`` see, (pixels, rays, 4) float64."""
        offsets, mask, known = rays
        at = mask[self.pixel_mask()]
        self.colors[at] = (known * self.colors[at] + shown.sum(axis=1)) / (known + len(offsets))
