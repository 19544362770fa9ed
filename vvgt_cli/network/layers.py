"""Layers of both transformers: attention, MLP, pre-norm block; names as in DINOv2's checkpoints."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


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


def axial_rope(grid: int, special: int, width: int, base: float = 100.0) -> tuple[Tensor, Tensor]:
    """Return cos and sin (special + grid^2, width) of a 2D rotary embedding.

    Pairs (i, i + width / 2) turn by the row for the first quarter of i, by the column for the second. Patches count
    from 1, the special tokens stand at (0, 0): VGGT's choice, and its base.
    """
    quarter = width // 4
    rates = base ** -(torch.arange(quarter) / quarter)  # (width / 4,)
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
