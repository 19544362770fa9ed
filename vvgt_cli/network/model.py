"""VVGT: the dual-transformer network (Sec. 4.2, Fig. 2), Gaussians and views in, Gaussians out.

It takes one scene at a time: scenes have different numbers of points, so a batch is a loop. The 3D geometry transformer
(Sec. 4.2.2) is Point Transformer V3 (Wu et al. 2024) on Gaussians; its orders, windows, parents and neighbours are
inputs (`vvgt_cli.network.tables`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, cat, nn
from torch.nn import functional

from vvgt_cli.gaussians.types import SH_C0
from vvgt_cli.network.config import PARAMETERS, PATCH, SCALES, STAGES, STEP, GeometryConfig, ImageConfig, NetworkConfig
from vvgt_cli.network.layers import Attention, Block, EpipolarCrossAttention, Mlp, ZeroLinear, axial_rope
from vvgt_cli.network.tables import block_curves


class ImageSide(nn.Module):
    """First graph: images (n, channels, size, size) and poses (n, 9) -> S maps (n, h, w, L, map_width)."""

    def __init__(self, config: NetworkConfig) -> None:
        """Create transformer and maps."""
        super().__init__()
        self.transformer = AppearanceTransformer(config.image, config.channels)
        self.maps = MultiScaleMaps(config.image)

    def forward(self, images: Tensor, poses: Tensor) -> list[Tensor]:
        """Return the S maps."""
        return self.maps(self.transformer(images, poses))


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


Tables = Mapping[str, Tensor]
NEIGHBOURS, SLICE = 27, 9
REACH = 4  # points along the order on either side that stage 0's convolution sees


class OrderConv(nn.Module):
    """Positional encoding of stage 0: a depthwise convolution along the points' Z-order.

    Several Gaussians may share a cell there, so that a grid has no unique neighbour.
    """

    def __init__(self, width: int) -> None:
        """Create the convolution."""
        super().__init__()
        self.conv = nn.Conv1d(width, width, 2 * REACH + 1, padding=REACH, groups=width)

    def forward(self, x: Tensor) -> Tensor:
        """Return features (n, width) of features (n, width)."""
        return self.conv(x.T[None])[0].T  # (n, width)


class NeighbourConv(nn.Module):
    """Positional encoding of later stages: PTV3's sparse 3 x 3 x 3 depthwise convolution, by gathers."""

    def __init__(self, width: int) -> None:
        """Create the weights."""
        super().__init__()
        self.weight = nn.Parameter(torch.randn(NEIGHBOURS, width) * NEIGHBOURS**-0.5)

    def forward(self, x: Tensor, neighbours: Tensor) -> Tensor:
        """Return features (n, width) of ``x`` (n, width); ``neighbours`` (n, 27) are n if there is none."""
        padded = torch.cat([x, torch.zeros_like(x[:1])])  # (n + 1, width)
        out = torch.zeros_like(x)
        for first in range(0, NEIGHBOURS, SLICE):  # by slices: (n, 27, width) would be the largest array of all
            near = neighbours[:, first : first + SLICE].reshape(-1)
            near = padded.index_select(0, near).reshape(-1, SLICE, x.shape[1])  # (n, 9, width)
            out = out + (near * self.weight[first : first + SLICE]).sum(dim=1)
        return out


class GeometryBlock(nn.Module):
    """PTV3's block: positional encoding, attention within windows of a curve, MLP."""

    def __init__(self, width: int, heads: int, stage: int, curve: str) -> None:
        """Create the layers."""
        super().__init__()
        self.stage, self.curve = stage, curve
        self.encoding: nn.Module = NeighbourConv(width) if stage else OrderConv(width)
        self.encoding_out = nn.Sequential(nn.Linear(width, width), nn.LayerNorm(width))
        self.norm1 = nn.LayerNorm(width)
        self.attn = Attention(width, heads)
        self.norm2 = nn.LayerNorm(width)
        self.mlp = Mlp(width)

    def forward(self, x: Tensor, tables: Tables) -> Tensor:
        """Return features (n, width) of ``x`` (n, width)."""
        near = (tables[f"neighbours_{self.stage}"],) if self.stage else ()
        x = x + self.encoding_out(self.encoding(x, *near))
        members = tables[f"windows_{self.stage}_{self.curve}"]  # (p, w)
        inside = self.norm1(x).index_select(0, members.reshape(-1))
        inside = self.attn(inside.reshape(members.shape[0], members.shape[1], x.shape[1]))  # (p, w, width)
        slots = tables[f"slots_{self.stage}_{self.curve}"]
        x = x + inside.reshape(-1, x.shape[1]).index_select(0, slots)
        return x + self.mlp(self.norm2(x))


class GridPool(nn.Module):
    """Grid pooling (Wu et al. 2022): projection, then the maximum of each cell."""

    def __init__(self, width: int, out: int) -> None:
        """Create the layers."""
        super().__init__()
        self.proj = nn.Linear(width, out)
        self.norm = nn.LayerNorm(out)

    def forward(self, x: Tensor, parents: Tensor, count: int) -> Tensor:
        """Return (count, out) features of cells; ``x`` (n, width), ``parents`` (n,) below count."""
        y = self.proj(x)
        start = torch.full((count, y.shape[1]), -1e4, dtype=y.dtype, device=y.device)  # every cell has a point
        index = parents[:, None].expand(-1, y.shape[1])
        return functional.gelu(self.norm(start.scatter_reduce(0, index, y, "amax")))


class GridUnpool(nn.Module):
    """Unpooling: each point adds its own projected skip to its parent's projected feature."""

    def __init__(self, coarse: int, skip: int, out: int) -> None:
        """Create the layers."""
        super().__init__()
        self.proj = nn.Sequential(nn.Linear(coarse, out), nn.LayerNorm(out), nn.GELU())
        self.skip = nn.Sequential(nn.Linear(skip, out), nn.LayerNorm(out), nn.GELU())

    def forward(self, x: Tensor, skip: Tensor, parents: Tensor) -> Tensor:
        """Return (n, out) of coarse ``x`` (m, coarse), ``skip`` (n, skip) and ``parents`` (n,)."""
        return self.proj(x).index_select(0, parents) + self.skip(skip)


class GeometryTransformer(nn.Module):
    """Five encoder stages with pooling between, four decoder stages (Sec. 4.2.2); VGF after one of them."""

    def __init__(self, config: GeometryConfig, vgf: EpipolarCrossAttention | None) -> None:
        """Create the stages."""
        super().__init__()
        self.epipolar_stage = config.epipolar_stage
        self.vgf = vgf
        curves = block_curves(config)
        widths, back = config.widths, (*config.decoder_widths, config.widths[-1])
        self.embedding = nn.Sequential(nn.Linear(config.inputs, widths[0]), nn.LayerNorm(widths[0]), nn.GELU())
        self.pools = nn.ModuleList(GridPool(widths[i], widths[i + 1]) for i in range(STAGES - 1))
        self.encoder = nn.ModuleList(
            nn.ModuleList(GeometryBlock(widths[i], config.heads[i], i, curve) for curve in curves[i])
            for i in range(STAGES)
        )
        down = list(reversed(range(STAGES - 1)))  # decoder stages 3, 2, 1, 0
        self.unpools = nn.ModuleList(GridUnpool(back[i + 1], widths[i], back[i]) for i in down)
        self.decoder = nn.ModuleList(
            nn.ModuleList(GeometryBlock(back[i], config.decoder_heads[i], i, curve) for curve in curves[STAGES + j])
            for j, i in enumerate(down)
        )

    def forward(self, features: Tensor, tables: Tables, views: tuple[Tensor, Tensor, list[Tensor]] | None) -> Tensor:
        """Return (K, decoder_widths[0]) of features (K, inputs); ``views``: matrices, eyes and maps."""
        x = self.embedding(features)
        skips = []
        for i, blocks in enumerate(self.encoder):
            if i:
                skips.append(x)
                x = self.pools[i - 1](x, tables[f"parents_{i - 1}"], tables[f"neighbours_{i}"].shape[0])
            for block in blocks:  # type: ignore[attr-defined]
                x = block(x, tables)
            if i == self.epipolar_stage and self.vgf is not None and views is not None:
                x = x + self.vgf(x, tables["positions"], *views)
        for unpool, blocks in zip(self.unpools, self.decoder, strict=True):
            i = len(skips) - 1
            x = unpool(x, skips.pop(), tables[f"parents_{i}"])
            for block in blocks:  # type: ignore[attr-defined]
                x = block(x, tables)
        return x


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
