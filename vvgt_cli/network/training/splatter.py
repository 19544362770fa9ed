"""The splatter as a function that torch differentiates: gsplat for rows on a GPU, else numba on the host."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vvgt_cli.cameras import Camera
from vvgt_cli.network.prepare import unpack
from vvgt_cli.splat import project, render, render_backward
from vvgt_cli.splat.by_gsplat import capped, picture


class Splat(torch.autograd.Function):
    """Autograd of `vvgt_cli.splat.render` and `render_backward`; rows as in `vvgt_cli.network.prepare.pack`."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, camera: Camera) -> Tensor:
        """Return the picture (height, width, 4) of ``rows`` (K, 14)."""
        gaussians = unpack(rows.detach().float().cpu().numpy())
        projection = project(gaussians, camera)
        image = render(gaussians, camera, projection=projection)
        ctx.kept = gaussians, camera, projection, image
        return torch.from_numpy(image).to(rows.device)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        """Return the gradient by the rows."""
        gaussians, camera, projection, image = ctx.kept
        g = render_backward(gaussians, camera, projection, image, grads[0].float().cpu().numpy())
        fields = g.means, g.log_scales, g.quaternions, g.opacity_logits[:, None], g.colors
        return torch.from_numpy(np.concatenate(fields, axis=1)).to(grads[0].device), None


def splat(rows: Tensor, camera: Camera) -> Tensor:
    """Return the picture (height, width, 4) float32 of Gaussians (K, 14), premultiplied; rows must be finite.

    On a CUDA device gsplat (extra ``cuda``) draws it if installed, else the numba kernels on the host.
    """
    if rows.is_cuda and importlib.util.find_spec("gsplat"):
        return gsplat_picture(rows, camera)
    picture: Tensor = Splat.apply(rows, camera)
    return picture


def gsplat_picture(rows: Tensor, camera: Camera) -> Tensor:
    """`splat` by gsplat, differentiable; see `vvgt_cli.splat.by_gsplat.picture` for where pictures differ."""
    means, log_scales, quaternions, logits, colors = rows.float().split([3, 3, 4, 1, 3], dim=1)
    opacity = capped(logits[:, 0].sigmoid())
    drawn = picture(means, opacity, colors.clamp(min=0), camera, quats=quaternions, scales=log_scales.exp())
    return torch.cat(drawn, dim=-1)
