"""2D appearance transformer (Sec. 4.2.1) and its multi-scale maps (Sec. 4.3.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from vvgt_cli.network.config import PATCH, SCALES, ImageConfig
from vvgt_cli.network.layers import Block, ZeroLinear, axial_rope

POSE = 9  # translation 3, quaternion 4, field of view (h, w) 2


class CameraEncoder(nn.Module):
    """Encoder of Eq. 4: camera poses (n, 9) to tokens (n, width)."""

    def __init__(self, width: int) -> None:
        """Create the layers."""
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(POSE, width), nn.GELU(), nn.Linear(width, width))

    def forward(self, poses: Tensor) -> Tensor:
        """Return tokens (n, width) of poses (n, 9)."""
        return self.layers(poses)


class PatchEmbed(nn.Module):
    """Embedding of non-overlapping patches as tokens."""

    def __init__(self, channels: int, width: int) -> None:
        """Create the convolution."""
        super().__init__()
        self.proj = nn.Conv2d(channels, width, PATCH, stride=PATCH)

    def forward(self, images: Tensor) -> Tensor:
        """Return tokens (n, patches, width) of images (n, channels, h, w)."""
        return self.proj(images).flatten(2).transpose(1, 2)


class ImageEncoder(nn.Module):
    """ViT encoder with DINOv2's names and shapes; its class token is the auxiliary camera token e_i.

    Registers have no position, as in DINOv2.
    """

    def __init__(self, config: ImageConfig, channels: int) -> None:
        """Create the encoder."""
        super().__init__()
        width = config.width
        self.patch_embed = PatchEmbed(channels, width)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.register_tokens = nn.Parameter(torch.zeros(1, config.registers, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + config.grid**2, width))
        self.blocks = nn.ModuleList(Block(width, config.heads) for _ in range(config.encoder))
        self.norm = nn.LayerNorm(width, eps=1e-6)
        for parameter in (self.cls_token, self.register_tokens, self.pos_embed):
            nn.init.trunc_normal_(parameter, std=0.02)

    def forward(self, images: Tensor, camera: Tensor) -> Tensor:
        """Return tokens (n, t, width) of images (n, channels, h, w); ``camera`` (n, width) as Eq. 4 adds it."""
        count = images.shape[0]
        patches = self.patch_embed(images) + self.pos_embed[:, 1:]  # (n, grid^2, width)
        token = (self.cls_token + self.pos_embed[:, :1]) + camera[:, None]  # (n, 1, width): Eq. 4
        x = torch.cat([token, self.register_tokens.expand(count, -1, -1), patches], dim=1)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)


class AlternatingAttention(nn.Module):
    """One layer of VGGT's decoder: attention within each view, then over the tokens of all views."""

    def __init__(self, config: ImageConfig) -> None:
        """Create the two blocks."""
        super().__init__()
        self.frame = Block(config.width, config.heads, qk_norm=True)
        self.whole = Block(config.width, config.heads, qk_norm=True)

    def forward(self, x: Tensor, rope: tuple[Tensor, Tensor]) -> Tensor:
        """Return tokens of the same shape (views, tokens, width)."""
        views, tokens, width = x.shape
        x = self.frame(x, rope)
        flat = x.reshape(1, views * tokens, width)
        everywhere = (rope[0].repeat(views, 1), rope[1].repeat(views, 1))  # (views * tokens, head_width)
        return self.whole(flat, everywhere).reshape(views, tokens, width)


class AppearanceTransformer(nn.Module):
    """Images and poses to the tokens of L layers (Sec. 4.2.1).

    Views differ only by image and pose: VGGT marks the first view, whose frame its points are in; here all views share
    the volume's frame.
    """

    def __init__(self, config: ImageConfig, channels: int) -> None:
        """Create encoder and layers."""
        super().__init__()
        self.taps = config.taps
        self.special = 1 + config.registers
        self.camera_encoder = CameraEncoder(config.width)
        self.zero = ZeroLinear(config.width, config.width)
        self.encoder = ImageEncoder(config, channels)
        self.layers = nn.ModuleList(AlternatingAttention(config) for _ in range(config.alternating))
        cos, sin = axial_rope(config.grid, self.special, config.width // config.heads)
        self.register_buffer("cos", cos, persistent=False)
        self.register_buffer("sin", sin, persistent=False)

    def forward(self, images: Tensor, poses: Tensor) -> list[Tensor]:
        """Return L tensors (n, grid^2, width) of images (n, channels, size, size) and poses (n, 9)."""
        x = self.encoder(images, self.zero(self.camera_encoder(poses)))
        tapped = []
        for number, layer in enumerate(self.layers):
            x = layer(x, (self.cos, self.sin))
            if number in self.taps:
                tapped.append(x[:, self.special :])
        return tapped


class ResidualConv(nn.Module):
    """DPT's residual unit (Ranftl et al. 2021): two 3 x 3 convolutions."""

    def __init__(self, width: int) -> None:
        """Create the convolutions."""
        super().__init__()
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Return maps of the same shape (n, width, h, w)."""
        return x + self.conv2(functional.relu(self.conv1(functional.relu(x))))


class MultiScaleMaps(nn.Module):
    """Maps F_i^{s,l} (Sec. 4.3.1): a DPT-style decoder with an output at each of S = 3 scales for each of L layers.

    As in DPT, layers are fused from the deepest up; each then grows by transposed convolutions.
    """

    def __init__(self, config: ImageConfig) -> None:
        """Create the decoder."""
        super().__init__()
        width, layers = config.map_width, len(config.taps)
        self.grid = config.grid
        self.norms = nn.ModuleList(nn.LayerNorm(config.width) for _ in range(layers))
        self.reassemble = nn.ModuleList(nn.Linear(config.width, width) for _ in range(layers))
        self.refine = nn.ModuleList(ResidualConv(width) for _ in range(layers))
        self.grow = nn.ModuleList(
            nn.ModuleList(nn.ConvTranspose2d(width, width, 2, stride=2) for _ in range(SCALES - 1))
            for _ in range(layers)
        )

    def forward(self, tokens: list[Tensor]) -> list[Tensor]:
        """Return S maps (n, 2^s grid, 2^s grid, L, map_width), channels last, of L tensors (n, grid^2, width)."""
        scales: list[list[Tensor]] = [[] for _ in range(SCALES)]
        deeper: Tensor | None = None
        for number in reversed(range(len(tokens))):
            x = self.reassemble[number](self.norms[number](tokens[number]))  # (n, grid^2, map_width)
            x = x.transpose(1, 2).reshape(x.shape[0], -1, self.grid, self.grid)  # (n, map_width, grid, grid)
            deeper = self.refine[number](x if deeper is None else x + deeper)
            fine = deeper
            scales[0].append(fine)
            for scale, grow in enumerate(self.grow[number], 1):  # type: ignore[arg-type]
                fine = grow(functional.gelu(fine))
                scales[scale].append(fine)
        return [torch.stack(maps[::-1], dim=1).permute(0, 3, 4, 1, 2).contiguous() for maps in scales]
