"""Loss of a rendered view: L1, SSIM and LPIPS as in the paper (Sec. 4.4), and the gain in PSNR."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from vvgt_cli.images.metrics import C1, C2, RADIUS, SIGMA
from vvgt_cli.network.training.config import LossConfig
from vvgt_cli.network.training.lpips import Lpips

TINY = 1e-10  # squared error of 100 dB


def view_loss(
    picture: Tensor, target: Tensor, before: Tensor | None, config: LossConfig, lpips: Lpips | None = None
) -> Tensor:
    """Return the weighted sum of the terms.

    Args:
        picture: (h, w, 4) premultiplied RGBA.
        target: of the same shape.
        before: picture of the Gaussians that the network was given; for ``decibel``.
        config: weights; a term of weight 0 is not computed.
        lpips: network of the ``lpips`` term.
    """
    total = picture.new_zeros(())
    if config.l1:
        total = total + config.l1 * (picture - target).abs().mean()
    if config.ssim:
        total = total + config.ssim * (1 - ssim(picture[..., :3], target[..., :3]))
    if config.decibel:
        assert before is not None
        total = total - config.decibel * decibels(picture, target, before) / 10
    if config.lpips:
        assert lpips is not None
        total = total + config.lpips * lpips(picture[..., :3], target[..., :3])
    return total


def decibels(picture: Tensor, target: Tensor, before: Tensor) -> Tensor:
    """Return the gain in PSNR over ``before``, RGB, images (h, w, 4)."""
    errors = [((image - target)[..., :3] ** 2).mean() + TINY for image in (before, picture)]
    return 10 / math.log(10) * torch.log(errors[0] / errors[1])


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean SSIM of (h, w, 3), over windows inside the image as in `vvgt_cli.images.metrics.ssim`."""
    x = torch.arange(-RADIUS, RADIUS + 1, dtype=a.dtype, device=a.device)
    kernel = torch.exp(-0.5 * (x / SIGMA) ** 2)
    kernel = kernel / kernel.sum()
    a, b = a.permute(2, 0, 1), b.permute(2, 0, 1)  # (3, h, w)
    planes = torch.cat([a, b, a * a, b * b, a * b])[:, None]  # (15, 1, h, w)
    planes = functional.conv2d(functional.conv2d(planes, kernel[None, None, :, None]), kernel[None, None, None, :])
    m, n, mm, nn, mn = planes[:, 0].chunk(5)
    light = (2 * m * n + C1) / (m * m + n * n + C1)
    shape = (2 * (mn - m * n) + C2) / (mm - m * m + nn - n * n + C2)
    return (light * shape).mean()
