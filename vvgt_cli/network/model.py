"""VVGT: the dual-transformer network (Sec. 4.2, Fig. 2), Gaussians and views in, Gaussians out.

It takes one scene at a time: scenes have different numbers of points, so a batch is a loop.
"""

from __future__ import annotations

from torch import Tensor, cat, nn

from vvgt_cli.network.appearance import AppearanceTransformer, MultiScaleMaps
from vvgt_cli.network.config import NetworkConfig
from vvgt_cli.network.epipolar import EpipolarCrossAttention
from vvgt_cli.network.geometry import GeometryTransformer, Tables
from vvgt_cli.network.head import GaussianHead, PixelHead, StepHead, describe


class ImageSide(nn.Module):
    """First graph: images (n, channels, size, size) and poses (n, 9) -> S maps (n, h, w, L, map_width)."""

    def __init__(self, config: NetworkConfig) -> None:
        """Create transformer and maps."""
        super().__init__()
        self.transformer = AppearanceTransformer(config.image, config.channels)
        self.maps = MultiScaleMaps(config.image)

    def forward(self, images: Tensor, poses: Tensor) -> list[Tensor]:
        """Return the S maps."""
        result: list[Tensor] = self.maps(self.transformer(images, poses))
        return result


class GeometrySide(nn.Module):
    """Second graph: Gaussians (K, 14) with tables and maps -> Gaussians (K, 14)."""

    def __init__(self, config: NetworkConfig) -> None:
        """Create transformer and head."""
        super().__init__()
        image, geometry = config.image, config.geometry
        vgf = None
        if config.has_images:
            width = geometry.widths[geometry.epipolar_stage]
            vgf = EpipolarCrossAttention(width, image.map_width, len(image.taps), geometry.epipolar_width)
        self.transformer = GeometryTransformer(geometry, vgf)
        self.head = StepHead(geometry) if geometry.head == "step" else GaussianHead(geometry)

    def forward(
        self,
        gaussians: Tensor,
        tables: Tables,
        views: tuple[Tensor, Tensor, list[Tensor]] | None = None,
        gradients: Tensor | None = None,
    ) -> Tensor:
        """Return Gaussians (K, 14); inputs in canonical order, ``views``: matrices, eyes and S maps."""
        features = describe(gaussians)
        if gradients is not None:
            features = cat([features, gradients], dim=-1)
        return self.head(self.transformer(features, tables, views), gaussians, gradients)


class Vvgt(nn.Module):
    """Network f_theta of Eq. 3, and its ablations (`NetworkConfig.variant`)."""

    def __init__(self, config: NetworkConfig) -> None:
        """Create the sides that the variant has."""
        super().__init__()
        self.config = config
        self.image = ImageSide(config) if config.has_images else None
        self.geometry = GeometrySide(config) if config.has_geometry else None
        self.pixels = None if config.has_geometry else PixelHead(config.image.map_width, len(config.image.taps))

    def forward(self, inputs: Tables) -> Tensor:
        """Return Gaussians (K, 14) in canonical order; ``inputs``: `Prepared.arrays` as tensors."""
        views = None
        if self.image is not None:
            views = inputs["matrices"], inputs["eyes"], self.image(inputs["images"], inputs["poses"])
        if self.pixels is not None:
            assert views is not None
            return self.pixels(views[2][-1], views[0], views[1])
        assert self.geometry is not None
        return self.geometry(inputs["gaussians"], inputs, views, inputs.get("gradients"))
