"""Layers of both transformers, named as in DINOv2's checkpoints, and attention of tokens to views (Eq. 7)."""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor, nn
from torch.nn import functional

from vvgt_cli.network.config import SCALES


class ZeroLinear(nn.Linear):
    """A linear layer that starts at zero, so that its output fades in (Eq. 4's ZeroConv, on one token)."""

    def reset_parameters(self) -> None:
        """Set weights and bias to zero."""
        nn.init.zeros_(self.weight)
        if self.bias is not None:
            nn.init.zeros_(self.bias)


class LayerScale(nn.Module):
    """A learned factor per channel (Touvron et al. 2021)."""

    def __init__(self, width: int, start: float = 0.01) -> None:
        """Start all factors at ``start``."""
        super().__init__()
        self.gamma = nn.Parameter(torch.full((width,), start))

    def forward(self, x: Tensor) -> Tensor:
        """Return x times the factors."""
        return x * self.gamma


class Mlp(nn.Module):
    """Two linear layers, four times as wide in between."""

    def __init__(self, width: int) -> None:
        """Create the layers."""
        super().__init__()
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Return features of the same shape (..., width)."""
        return self.fc2(functional.gelu(self.fc1(x)))


def apply_rope(x: Tensor, rope: tuple[Tensor, Tensor]) -> Tensor:
    """Apply a rotary embedding (Su et al. 2021) with tables cos, sin (t, d) of `axial_rope` to x (..., t, d)."""
    cos, sin = rope
    first, second = x.chunk(2, dim=-1)  # (..., t, d / 2) each
    return x * cos + torch.cat([-second, first], dim=-1) * sin


def axial_rope(grid: int, special: int, width: int) -> tuple[Tensor, Tensor]:
    """Return cos and sin (special + grid^2, width) of a 2D rotary embedding.

    Pairs (i, i + width / 2) turn by the row for the first quarter of i, by the column for the second. Patches count
    from 1, the special tokens stand at (0, 0): VGGT's choice, and its base.
    """
    quarter = width // 4
    rates = 100.0 ** -(torch.arange(quarter) / quarter)  # (width / 4,)
    place = torch.arange(1, grid + 1, dtype=torch.float32)
    angle = place[:, None] * rates  # (grid, width / 4)
    rows = angle[:, None, :].expand(grid, grid, quarter)
    columns = angle[None, :, :].expand(grid, grid, quarter)
    angles = torch.cat([rows, columns], dim=-1).reshape(grid * grid, 2 * quarter)
    angles = torch.cat([torch.zeros(special, 2 * quarter), angles]).repeat(1, 2)  # (t, width)
    return angles.cos(), angles.sin()


class Attention(nn.Module):
    """Self-attention over the second-last axis, with optional QK-norm (Henry et al. 2020) and RoPE."""

    def __init__(self, width: int, heads: int, qk_norm: bool = False) -> None:
        """Create the projections."""
        super().__init__()
        self.heads, self.head_width = heads, width // heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)
        self.q_norm = nn.LayerNorm(self.head_width) if qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(self.head_width) if qk_norm else nn.Identity()

    def forward(self, x: Tensor, rope: tuple[Tensor, Tensor] | None = None) -> Tensor:
        """Return features of the same shape (batch, tokens, width)."""
        batch, tokens, width = x.shape
        qkv = self.qkv(x).reshape(batch, tokens, 3, self.heads, self.head_width).permute(2, 0, 3, 1, 4)
        q, k, v = qkv[0], qkv[1], qkv[2]  # (batch, heads, tokens, head_width)
        q, k = self.q_norm(q), self.k_norm(k)
        if rope is not None:
            q, k = apply_rope(q, rope), apply_rope(k, rope)
        out = functional.scaled_dot_product_attention(q, k, v)
        return self.proj(out.transpose(1, 2).reshape(batch, tokens, width))


class Block(nn.Module):
    """Pre-norm transformer block with LayerScale."""

    def __init__(self, width: int, heads: int, qk_norm: bool = False) -> None:
        """Create the layers."""
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=1e-6)  # DINOv2's
        self.attn = Attention(width, heads, qk_norm)
        self.ls1 = LayerScale(width)
        self.norm2 = nn.LayerNorm(width, eps=1e-6)
        self.mlp = Mlp(width)
        self.ls2 = LayerScale(width)

    def forward(self, x: Tensor, rope: tuple[Tensor, Tensor] | None = None) -> Tensor:
        """Return features of the same shape (batch, tokens, width)."""
        x = x + self.ls1(self.attn(self.norm1(x), rope))
        return x + self.ls2(self.mlp(self.norm2(x)))


NEAR = 0.01  # unit frame, as the splatter's near plane
OUTSIDE = -1e4  # bias of a view that does not see the point: exp of it is 0 in float32, and float16 holds it


def project(points: Tensor, matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Project points (m, 3) by matrices (n, 3, 4) to (u w, v w, w), u and v in [0, 1] across the image, w the depth.

    Return (n, m, 2) u and v, clamped to the image, and (n, m) bool: in front of the camera and within the image.
    """
    p = points @ matrices[:, :, :3].transpose(1, 2) + matrices[:, None, :, 3]  # (n, m, 3)
    depth = p[..., 2:]
    uv = p[..., :2] / depth.clamp(min=NEAR)  # (n, m, 2)
    seen = (depth[..., 0] > NEAR) & (uv >= 0).all(dim=-1) & (uv <= 1).all(dim=-1)
    return uv.clamp(0, 1), seen


def corners(uv: Tensor, height: int, width: int) -> list[tuple[Tensor, Tensor]]:
    """Return row and bilinear weight of the four pixels around each point, for (n * height * width, ...) maps.

    ``uv`` is (n, m, 2) in [0, 1], pixel centres at integer + 0.5 (clamped to the edge's). The four pairs are
    (n * m,) int64 and (n * m, 1).
    """
    views = uv.shape[0]
    x = (uv[..., 0] * width - 0.5).clamp(0, width - 1)  # (n, m)
    y = (uv[..., 1] * height - 0.5).clamp(0, height - 1)
    left, top = x.floor(), y.floor()
    fx, fy = x - left, y - top
    x0, y0 = left.long(), top.long()
    x1, y1 = (x0 + 1).clamp(max=width - 1), (y0 + 1).clamp(max=height - 1)
    first = (torch.arange(views, device=uv.device) * (height * width))[:, None]  # (n, 1)
    near = []
    for yy, wy in ((y0, 1 - fy), (y1, fy)):
        for xx, wx in ((x0, 1 - fx), (x1, fx)):
            near.append(((first + yy * width + xx).reshape(-1), (wy * wx).reshape(-1, 1)))
    return near


class EpipolarCrossAttention(nn.Module):
    """Eq. 7: attention of each 3D token to all views, layers and scales at its projections, weighted by nearness.

    Keys and values are projected on the maps, before sampling: a 1 x 1 projection commutes with bilinear
    interpolation, and there are fewer pixels than samples. The softmax runs over one map after another (Milakov and
    Gimelshein 2018), so that the samples of only one map exist at a time.
    """

    def __init__(self, width: int, map_width: int, layers: int, inner: int) -> None:
        """Create the projections."""
        super().__init__()
        self.inner, self.layers = inner, layers
        self.norm = nn.LayerNorm(width)
        self.query = nn.Linear(width, inner)
        self.map_norms = nn.ModuleList(nn.LayerNorm(map_width) for _ in range(SCALES * layers))
        self.key_values = nn.ModuleList(nn.Linear(map_width, 2 * inner) for _ in range(SCALES * layers))
        self.out = nn.Linear(inner, width)
        self.raw_beta = nn.Parameter(torch.zeros(()))  # beta = softplus of it: a nearer view never counts less

    def bias(self, points: Tensor, eyes: Tensor, seen: Tensor) -> Tensor:
        """Return b = -beta d (n, m), d in half-diagonals of the unit cube; `OUTSIDE` if a view does not see the point.

        ``points`` is (m, 3), ``eyes`` (n, 3), ``seen`` (n, m).
        """
        gap = points[None] - eyes[:, None]  # (n, m, 3)
        distance = (gap * gap).sum(dim=-1).sqrt() / 3**0.5
        return torch.where(seen, -functional.softplus(self.raw_beta) * distance, OUTSIDE)

    def rows(self, of_scale: Tensor, scale: int, layer: int) -> Tensor:
        """Return keys and values (n * h * w, 2 D) of one layer of the maps (n, h, w, L, c) at one scale."""
        number = scale * self.layers + layer
        pixels = of_scale[:, :, :, layer].reshape(-1, of_scale.shape[-1])  # (n * h * w, c)
        return self.key_values[number](self.map_norms[number](pixels))

    def forward(self, x: Tensor, points: Tensor, matrices: Tensor, eyes: Tensor, maps: list[Tensor]) -> Tensor:
        """Return what is added to the tokens, (m, width); 0 for tokens that no view sees.

        ``x`` (m, width) are tokens at ``points`` (m, 3), ``matrices`` (n, 3, 4), ``eyes`` (n, 3), ``maps`` S maps.
        """
        query = self.query(self.norm(x)) * self.inner**-0.5  # (m, D)
        uv, seen = project(points, matrices)
        bias = self.bias(points, eyes, seen)  # (n, m)
        views, count = uv.shape[0], x.shape[0]
        top = torch.full_like(query[:, :1], OUTSIDE)  # (m, 1): largest logit so far
        total = torch.zeros_like(top)
        value = torch.zeros_like(query)
        places = [corners(uv, of_scale.shape[1], of_scale.shape[2]) for of_scale in maps]
        for scale, layer in product(range(SCALES), range(self.layers)):
            rows = self.rows(maps[scale], scale, layer)
            sampled = torch.zeros_like(rows[:1])
            for index, weight in places[scale]:  # summed as they come: two of the four exist at a time
                sampled = sampled + rows.index_select(0, index) * weight
            sampled = sampled.reshape(views, count, 2 * self.inner)
            keys, values = sampled[..., : self.inner], sampled[..., self.inner :]
            logits = (keys * query).sum(dim=-1) + bias  # (n, m)
            now = torch.maximum(top[:, 0], logits.amax(dim=0))[:, None]  # (m, 1)
            shrink = torch.exp(top - now)
            weights = torch.exp(logits - now[:, 0]) * seen  # (n, m)
            total = total * shrink + weights.sum(dim=0)[:, None]
            value = value * shrink + (weights[..., None] * values).sum(dim=0)
            top = now
        return self.out(value / total.clamp(min=1e-20)) * seen.any(dim=0)[:, None]
