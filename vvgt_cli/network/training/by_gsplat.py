"""Pictures of Gaussians on a CUDA device, drawn and differentiated by gsplat (Ye et al. 2024)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.gaussians.constants import DILATION, MAX_ALPHA, NEAR, TILE

if TYPE_CHECKING:
    from torch import Tensor

    from vvgt_cli.cameras import Camera


def picture(
    means: Tensor, opacities: Tensor, colors: Tensor, quats: Tensor, scales: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """Return colours (height, width, 3), premultiplied, and alpha (height, width, 1), which torch differentiates.

    gsplat's alpha ends at 0.999, where that of the rules ends at `MAX_ALPHA`: opacities are made to end there. And it
    takes the Jacobian of what lies beside the frustum at the frustum's edge: pictures differ there.

    Args:
        means: (K, 3) float32.
        opacities: (K,) float32.
        colors: (K, 3) float32.
        quats: (K, 4) float32.
        scales: (K, 3) float32.
        camera: that sees them.
    """
    import torch
    from gsplat.cuda import _wrapper as gsplat

    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3], pose[:3, 3] = camera.rotation, camera.translation
    lens = [[camera.fx, 0, camera.cx, 0], [0, camera.fy, camera.cy, 0], [0, 0, 1, 0], [0, 0, 0, 0]]
    view, lens = torch.from_numpy(np.stack([pose, np.array(lens, np.float32)])).to(means.device)
    size = camera.width, camera.height
    across, down = (-(-edge // TILE) for edge in size)
    opacities = opacities.clamp(max=MAX_ALPHA)
    radii, centres, depths, conics, _ = gsplat.fully_fused_projection(
        means, None, quats, scales, view[None], lens[None, :3, :3], *size, eps2d=DILATION, near_plane=NEAR,
        opacities=opacities,
    )  # fmt: skip
    _, pairs, members = gsplat.isect_tiles(centres, radii, depths, TILE, across, down)
    begin = gsplat.isect_offset_encode(pairs, 1, across, down)
    rgb, alpha = gsplat.rasterize_to_pixels(
        centres, conics, colors[None], opacities[None], *size, TILE, begin, members
    )  # fmt: skip
    return rgb[0], alpha[0]
