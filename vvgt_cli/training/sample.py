"""One scene through the network: its loss with gradients, and its gain for the record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.metrics import psnr
from vvgt_cli.network.model import Vvgt
from vvgt_cli.network.prepare import Prepared, prepare, unpack
from vvgt_cli.network.runtime import in_turn, spread
from vvgt_cli.splat import render
from vvgt_cli.training.config import TrainConfig
from vvgt_cli.training.losses import decibels, view_loss
from vvgt_cli.training.scenes import TrainingScene, as_float
from vvgt_cli.training.splatter import splat


@dataclass
class Tally:
    """What a scene adds to a step's record; a scene that fails counts as ``bad`` and adds nothing."""

    loss: float = 0.0
    gain: float = 0.0
    bad: int = 0


def tensors(scene: Prepared, device: torch.device) -> dict[str, Tensor]:
    """The network's input on its device."""
    return {name: torch.from_numpy(np.array(array)).to(device) for name, array in scene.arrays().items()}


def run_network(network: Vvgt, prepared: Prepared, device: torch.device) -> Tensor:
    """Rows (K, 14) float32; bfloat16 within on CUDA."""
    with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
        rows: Tensor = network(tensors(prepared, device))
    return rows.float()


def learn(
    network: Vvgt, scene: TrainingScene, config: TrainConfig, rng: np.random.Generator, device: torch.device
) -> Tally:
    """Add the gradients of a scene's loss, mean over rounds and views, divided by the batch.

    Every round is an example of its own: its input is what the round before has made, without gradients through it.
    """
    tally, rounds = Tally(), config.network.rounds
    views = [int(i) for i in rng.permutation(len(scene.cameras))[: config.network.reads]]
    chosen = [int(i) for i in rng.permutation(len(scene.targets))[: config.views]]
    targets = [torch.from_numpy(as_float(scene.target_images[i])).to(device) for i in chosen]
    gaussians = scene.gaussians
    for number in range(rounds):
        shown = in_turn(views, number, rounds)
        prepared = prepare(gaussians, [scene.cameras[i] for i in shown], as_float(scene.images[shown]), config.network)
        rows = run_network(network, prepared, device)
        if not torch.isfinite(rows).all():
            return Tally(bad=1)
        loss = rows.new_zeros(())
        for i, target in zip(chosen, targets, strict=True):
            before = torch.from_numpy(render(gaussians, scene.targets[i])).to(device)
            picture = splat(rows, scene.targets[i])
            loss = loss + view_loss(picture, target, before, config.loss) / (len(chosen) * rounds)
            with torch.no_grad():
                tally.gain += float(decibels(picture, target, before)) / len(chosen)
        if not torch.isfinite(loss):
            return Tally(bad=1)
        (loss / config.batch).backward()
        tally.loss += float(loss.detach())
        if number + 1 < rounds:
            gaussians = unpack(rows.detach().cpu().numpy())
    return tally


@torch.no_grad()
def judge(network: Vvgt, scene: TrainingScene, config: TrainConfig, device: torch.device) -> list[float]:
    """PSNR on all targets of what the network is given, and after every round."""
    few, gaussians = spread(scene.cameras, config.network.reads), scene.gaussians
    found = [mean_psnr(gaussians, scene.targets, scene.target_images)]
    for number in range(config.network.rounds):
        shown = in_turn(few, number, config.network.rounds)
        prepared = prepare(gaussians, [scene.cameras[i] for i in shown], as_float(scene.images[shown]), config.network)
        gaussians = unpack(run_network(network, prepared, device).cpu().numpy())
        found.append(mean_psnr(gaussians, scene.targets, scene.target_images))
    return found


def mean_psnr(gaussians: Gaussians, cameras: Sequence[Camera], images: np.ndarray) -> float:
    """Over views; images uint16."""
    pairs = zip(cameras, images, strict=True)
    return float(np.mean([psnr(as_float(view)[..., :3], render(gaussians, c)[..., :3]) for c, view in pairs]))
