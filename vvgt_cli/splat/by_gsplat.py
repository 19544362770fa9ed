"""Pictures of Gaussians on a CUDA device, drawn and differentiated by gsplat (Ye et al. 2024)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.gaussians.constants import MAX_ALPHA, NEAR, TILE
from vvgt_cli.gaussians.rules import INRIA, RULES, Rule

if TYPE_CHECKING:
    from torch import Tensor

    from vvgt_cli.cameras import Camera

DRAWN = ("inria", "compensated")  # rules that gsplat draws by, with any dilation


def draws(rule: Rule) -> bool:
    """Return whether gsplat draws by a rule."""
    return any(rule == replace(RULES[name], dilation=rule.dilation) for name in DRAWN)


def picture(
    means: Tensor, opacities: Tensor, colors: Tensor, camera: Camera, rule: Rule = INRIA, **shape: Tensor
) -> tuple[Tensor, Tensor]:
    """Return colours (height, width, 3), premultiplied, and alpha (height, width, 1), which torch differentiates.

    gsplat's alpha ends at 0.999, where that of the rules ends at `MAX_ALPHA`: hand it opacities that end there. And it
    takes the Jacobian of what lies beside the frustum at the frustum's edge: pictures differ there.

    Args:
        means: (K, 3) float32.
        opacities: (K,) float32.
        colors: (K, 3) float32.
        camera: that sees them.
        rule: one that gsplat `draws` by.
        shape: ``covars`` (K, 6): xx, xy, xz, yy, yz, zz; or ``quats`` (K, 4) and ``scales`` (K, 3).
    """
    import torch
    from gsplat.cuda import _wrapper as gsplat

    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3], pose[:3, 3] = camera.rotation, camera.translation
    lens = [[camera.fx, 0, camera.cx, 0], [0, camera.fy, camera.cy, 0], [0, 0, 1, 0], [0, 0, 0, 0]]
    view, lens = torch.from_numpy(np.stack([pose, np.array(lens, np.float32)])).to(means.device)
    size = camera.width, camera.height
    across, down = (-(-edge // TILE) for edge in size)
    radii, centres, depths, conics, factor = gsplat.fully_fused_projection(
        means, shape.get("covars"), shape.get("quats"), shape.get("scales"), view[None], lens[None, :3, :3], *size,
        eps2d=rule.dilation, near_plane=NEAR, calc_compensations=rule.compensate, opacities=opacities,
    )  # fmt: skip
    _, pairs, members = gsplat.isect_tiles(centres, radii, depths, TILE, across, down)
    begin = gsplat.isect_offset_encode(pairs, 1, across, down)
    drawn = opacities[None] if factor is None else opacities[None] * factor
    rgb, alpha = gsplat.rasterize_to_pixels(centres, conics, colors[None], drawn, *size, TILE, begin, members)
    return rgb[0], alpha[0]


def capped(opacities: Tensor) -> Tensor:
    """Return opacities that end at `MAX_ALPHA`."""
    return opacities.clamp(max=MAX_ALPHA)
