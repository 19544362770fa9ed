"""3D geometry transformer (Sec. 4.2.2): Point Transformer V3 (Wu et al. 2024) on Gaussians.

Orders, windows, parents and neighbours are inputs (`vvgt_cli.network.tables`).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from vvgt_cli.network.config import STAGES, GeometryConfig
from vvgt_cli.network.epipolar import EpipolarCrossAttention
from vvgt_cli.network.layers import Attention, Mlp
from vvgt_cli.network.tables import block_curves

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
