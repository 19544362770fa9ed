"""Pictures of Gaussians on a CUDA device, drawn and differentiated by gsplat (Ye et al. 2024)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from vvgt_cli.gaussians.constants import MAX_ALPHA, NEAR
from vvgt_cli.gaussians.rules import INRIA, RULES, Rule

if TYPE_CHECKING:
    from vvgt_cli.cameras import Camera

DRAWN = ("inria", "compensated")  # rules that gsplat draws by, with any dilation


def draws(rule: Rule) -> bool:
    """Return whether gsplat draws by a rule."""
    return any(rule == replace(RULES[name], dilation=rule.dilation) for name in DRAWN)


def picture(means: Any, logits: Any, colors: Any, camera: Camera, rule: Rule = INRIA, **shape: Any) -> Any:
    """Return the picture (height, width, 4) of Gaussians, premultiplied RGBA: torch differentiates it.

    gsplat's alpha ends at 0.999 where that of the rules ends at 0.99, so opacities do here; and it takes the Jacobian
    of what lies beside the frustum at the frustum's edge. Pictures differ there.

    Args:
        means, logits, colors: (K, 3), (K,), (K, 3) float32 tensors; negative colours are 0.
        camera: that sees them.
        rule: one that gsplat `draws` by.
        shape: ``covars`` (K, 3, 3), or ``quats`` (K, 4) and ``scales`` (K, 3).
    """
    import torch
    from gsplat import rasterization

    view = torch.eye(4)
    view[:3, :3], view[:3, 3] = torch.as_tensor(camera.rotation), torch.as_tensor(camera.translation)
    lens = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    opacity = logits.sigmoid()
    capped = opacity + (opacity.detach().clamp(max=MAX_ALPHA) - opacity.detach())  # slopes as without the cap
    rgb, alpha, _ = rasterization(
        means, shape.get("quats"), shape.get("scales"), capped, colors.clamp(min=0), view[None].to(means.device),
        lens[None].to(means.device), camera.width, camera.height, near_plane=NEAR, eps2d=rule.dilation, packed=False,
        covars=shape.get("covars"), rasterize_mode="antialiased" if rule.compensate else "classic",
    )  # fmt: skip
    return torch.cat([rgb[0], alpha[0]], dim=-1)
