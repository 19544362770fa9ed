"""Heads: features to the parameters of Gaussians (Eq. 6), and the ablation that predicts them per pixel."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from vvgt_cli.gaussians.types import SH_C0
from vvgt_cli.network.config import PARAMETERS, STEP, GeometryConfig
from vvgt_cli.network.layers import ZeroLinear

SPLIT = (3, 3, 4, 1, 3)  # mean, log-scale, quaternion, opacity logit, colour
TYPICAL_LOG_SCALE = -4.0  # 1/50 of half the longest edge


def rotation(quaternions: Tensor) -> Tensor:
    """Return matrices (n, 3, 3) of unit quaternions (n, 4), (w, x, y, z)."""
    w, x, y, z = quaternions.unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def describe(gaussians: Tensor) -> Tensor:
    """Return input features (K, 14) of Gaussians (K, 14), each of magnitude near 1.

    They include the level of the closed form's cell: the mean log-scale up to a constant.
    """
    mean, log_scale, quaternion, logit, color = gaussians.split(SPLIT, dim=-1)
    scale = (log_scale - TYPICAL_LOG_SCALE) / 2
    return torch.cat([mean, scale, quaternion, logit / 4, 2 * color - 1], dim=-1)


class GaussianHead(nn.Module):
    """Features (K, width) and their Gaussians (K, 14) to Gaussians (K, 14).

    The last layer is zero: an untrained network returns its input ("residual"). "direct" is Eq. 6 as printed: an offset
    of the centre, and all else predicted.
    """

    def __init__(self, config: GeometryConfig) -> None:
        """Create the layers."""
        super().__init__()
        width = config.decoder_widths[0]
        self.direct, self.reach = config.head == "direct", config.reach
        self.norm = nn.LayerNorm(width)
        self.hidden = nn.Linear(width, width)
        self.last = ZeroLinear(width, PARAMETERS)

    def forward(self, x: Tensor, gaussians: Tensor, slopes: Tensor | None = None) -> Tensor:
        """Return Gaussians (K, 14) of features (K, width) and Gaussians (K, 14)."""
        step = self.last(functional.gelu(self.hidden(self.norm(x)))).split(SPLIT, dim=-1)
        mean, log_scale, quaternion, logit, color = gaussians.split(SPLIT, dim=-1)
        own = self.reach * log_scale.exp() * torch.tanh(step[0])  # (K, 3) along the Gaussian's axes
        moved = mean + (rotation(quaternion) @ own[..., None])[..., 0]
        if self.direct:
            unit = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=x.dtype, device=x.device)
            turned = functional.normalize(unit + step[2], dim=-1)
            return torch.cat([moved, TYPICAL_LOG_SCALE + step[1], turned, step[3], 0.5 + SH_C0 * step[4]], dim=-1)
        grown = log_scale + 2 * torch.tanh(step[1])  # at most a factor e^2 either way
        turned = functional.normalize(quaternion + step[2], dim=-1)
        return torch.cat([moved, grown, turned, logit + step[3], color + SH_C0 * step[4]], dim=-1)


class StepHead(nn.Module):
    """A step in each Gaussian's own axes: a factor for every gradient, and an addition.

    ``mu + R S d``, ``log s + e``, ``q (1, w / 2)``, ``logit + .``, ``colour + .``. Untrained, every factor is 1: a
    plain gradient step of `SIZES`, which were chosen by trial (docs/train.md).
    """

    SIZES = (0.1,) * 3 + (0.05,) * 6 + (0.06,) + (0.016,) * 3
    LARGEST = (2.0,) * 3 + (1.0,) * 6 + (2.0,) + (0.3,) * 3

    def __init__(self, config: GeometryConfig) -> None:
        """Create the layers."""
        super().__init__()
        width = config.decoder_widths[0]
        self.norm = nn.LayerNorm(width)
        self.hidden = nn.Linear(width, width)
        self.last = ZeroLinear(width, 2 * STEP)
        nn.init.ones_(self.last.bias[:STEP])

    def forward(self, x: Tensor, gaussians: Tensor, slopes: Tensor | None = None) -> Tensor:
        """Return Gaussians (K, 14) of features (K, width), Gaussians (K, 14) and slopes (K, SLOPES)."""
        assert slopes is not None
        factor, more = self.last(functional.gelu(self.hidden(self.norm(x)))).chunk(2, dim=-1)  # (K, 13) each
        sizes, largest = x.new_tensor(self.SIZES), x.new_tensor(self.LARGEST)
        step = largest * torch.tanh((more - factor * slopes[:, :STEP]) * sizes / largest)
        along, grown, spin, harder, tint = step.split((3, 3, 3, 1, 3), dim=-1)
        mean, log_scale, quaternion, logit, color = gaussians.split(SPLIT, dim=-1)
        moved = mean + (rotation(quaternion) @ (log_scale.exp() * along)[..., None])[..., 0]
        turned = functional.normalize(quaternion + turned_by(quaternion, spin / 2), dim=-1)
        return torch.cat([moved, log_scale + grown, turned, logit + harder, color + tint], dim=-1)


def turned_by(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Return the products (n, 4) of quaternions (n, 4) with (0, vector (n, 3))."""
    w, x, y, z = quaternion.unbind(-1)
    a, b, c = vector.unbind(-1)
    return torch.stack(
        [-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a], -1
    )


class PixelHead(nn.Module):
    """Gaussians per pixel of the finest map (the ablation "w/o 3DT", after AnySplat): one on each pixel's ray.

    Depths run from `CLOSE` to the far side of the unit cube's ball; a scale of 1 covers its pixel.
    """

    CLOSE = 0.01

    def __init__(self, map_width: int, layers: int) -> None:
        """Create the layers."""
        super().__init__()
        self.norm = nn.LayerNorm(layers * map_width)
        self.hidden = nn.Linear(layers * map_width, map_width)
        self.last = nn.Linear(map_width, 12)  # depth 1, log-scale 3, quaternion 4, logit 1, colour 3

    def forward(self, finest: Tensor, matrices: Tensor, eyes: Tensor) -> Tensor:
        """Return (n * h * w, 14) of finest maps (n, h, w, L, c), matrices (n, 3, 4) and eyes (n, 3)."""
        count, height, width = finest.shape[:3]
        out = self.last(functional.gelu(self.hidden(self.norm(finest.flatten(3)))))  # (n, h, w, 12)
        v, u = torch.meshgrid((torch.arange(height) + 0.5) / height, (torch.arange(width) + 0.5) / width, indexing="ij")
        pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1).reshape(1, -1, 3).to(out)  # (1, h * w, 3)
        rays = pixels @ torch.linalg.inv(matrices[:, :, :3]).transpose(1, 2)  # (n, h * w, 3), depth 1
        far = eyes.norm(dim=-1)[:, None, None] + math.sqrt(3)  # (n, 1, 1)
        out = out.reshape(count, -1, 12)  # (n, h * w, 12)
        depth = self.CLOSE + (far - self.CLOSE) * torch.sigmoid(out[..., :1])
        mean = eyes[:, None] + depth * rays
        footprint = depth * rays.norm(dim=-1, keepdim=True) / width
        unit = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=out.dtype, device=out.device)
        turned = functional.normalize(unit + out[..., 4:8], dim=-1)
        parts = [mean, footprint.log() + out[..., 1:4], turned, out[..., 8:9], 0.5 + SH_C0 * out[..., 9:]]
        return torch.cat(parts, dim=-1).reshape(-1, 14)
