"""The splatter as a function that torch differentiates: numba on the host, whatever device the network is on."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from vvgt_cli.cameras import Camera
from vvgt_cli.network.prepare import unpack
from vvgt_cli.splat import project, render, render_backward


class Splat(torch.autograd.Function):
    """`vvgt_cli.splat.render` and `render_backward`; rows as `vvgt_cli.network.prepare.pack` has them."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, camera: Camera) -> Tensor:
        gaussians = unpack(rows.detach().float().cpu().numpy())
        projection = project(gaussians, camera)
        image = render(gaussians, camera, projection)
        ctx.kept = gaussians, camera, projection, image
        return torch.from_numpy(image).to(rows.device)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        gaussians, camera, projection, image = ctx.kept
        g = render_backward(gaussians, camera, projection, image, grads[0].float().cpu().numpy())
        fields = g.means, g.log_scales, g.quaternions, g.opacity_logits[:, None], g.colors
        return torch.from_numpy(np.concatenate(fields, axis=1)).to(grads[0].device), None


def splat(rows: Tensor, camera: Camera) -> Tensor:
    """Picture (height, width, 4) float32 of Gaussians (K, 14), premultiplied; rows must be finite."""
    picture: Tensor = Splat.apply(rows, camera)
    return picture
