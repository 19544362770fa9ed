"""LPIPS (Zhang et al. 2018) with the VGG-16 backbone; weights come from two files, nothing is downloaded."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from vvgt_cli.errors import DataError
from vvgt_cli.network.checkpoint import load_weights, read_tensors
from vvgt_cli.network.training.config import LossConfig

# channels of VGG-16's convolutions (Simonyan and Zisserman 2015) between its poolings: torchvision's `features`
STAGES = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of colours in [-1, 1], before the backbone
TINY = 1e-10
LINEAR = "lin{}.model.1.weight"  # of the v0.1 weights that come with the authors' program


class Lpips(nn.Module):
    """Distance of two pictures, 0 for equal ones: squared differences of normalised features, weighted and averaged."""

    def __init__(self) -> None:
        """Create the layers, without gradients."""
        super().__init__()
        widths = [3, *(width for stage in STAGES for width in stage)]
        self.convolutions = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in pairwise(widths))
        self.linear = nn.ParameterList(nn.Parameter(torch.zeros(1, stage[-1], 1, 1)) for stage in STAGES)
        self.requires_grad_(False)

    def features(self, picture: Tensor) -> list[Tensor]:
        """Return the last features (1, c, h', w') before each pooling and at the end, of (h, w, 3) in [0, 1]."""
        shift, scale = picture.new_tensor(SHIFT), picture.new_tensor(SCALE)
        x = ((2 * picture - 1 - shift) / scale).permute(2, 0, 1)[None]
        layers, features = iter(self.convolutions), []
        for number, stage in enumerate(STAGES):
            x = functional.max_pool2d(x, 2) if number else x
            for _ in stage:
                x = functional.relu(next(layers)(x))
            features.append(x)
        return features

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the distance of pictures (h, w, 3), at least 16 pixels a side."""
        total = a.new_zeros(())
        for x, y, weight in zip(self.features(a), self.features(b), self.linear, strict=True):
            gap = (_unit(x) - _unit(y)) ** 2
            total = total + (weight * gap).sum(dim=1).mean()
        return total


def _unit(x: Tensor) -> Tensor:
    """Return features scaled to length 1 at every place."""
    return x / (x.square().sum(dim=1, keepdim=True).sqrt() + TINY)


def load_lpips(config: LossConfig) -> Lpips | None:
    """Return LPIPS with the weights that ``config`` names, names and shapes checked; None if the loss has no LPIPS.

    Raises:
        DataError: files that are not torchvision's VGG-16 (``vgg16-397923af.pth``) or not LPIPS' linear weights of it
            (``vgg.pth`` of the authors' version 0.1).
    """
    if not config.lpips:
        return None
    network = Lpips()
    state = _backbone(config.lpips_backbone) | _linear(config.lpips_linear)
    load_weights(network, state, f"{config.lpips_backbone}, {config.lpips_linear}")
    return network.eval()


def _backbone(path: str | Path) -> dict[str, Tensor]:
    """Read VGG-16's convolutions, numbered consecutively; torchvision counts poolings and rectifiers too."""
    names, place = [], 0
    for stage in STAGES:
        for _ in stage:
            names.append(f"features.{place}")
            place += 2
        place += 1
    return _taken(path, {f"convolutions.{i}.{part}": f"{name}.{part}" for i, name in enumerate(names)
                         for part in ("weight", "bias")}, "VGG-16's weights as torchvision has them")  # fmt: skip


def _linear(path: str | Path) -> dict[str, Tensor]:
    names = {f"linear.{i}": LINEAR.format(i) for i in range(len(STAGES))}
    return _taken(path, names, "LPIPS' linear weights for VGG-16")


def _taken(path: str | Path, names: dict[str, str], what: str) -> dict[str, Tensor]:
    """Read tensors of a file under our names."""
    state = read_tensors(path)
    missing = [theirs for theirs in names.values() if not isinstance(state.get(theirs), Tensor)]
    if missing:
        raise DataError(f"{path}: no {missing[0]}; expected {what}")
    return {ours: state[theirs] for ours, theirs in names.items()}
