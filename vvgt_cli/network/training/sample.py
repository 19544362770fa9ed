"""One scene through the network: its loss with gradients, and its gain for the record."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from vvgt_cli.cameras import Camera, farthest_cameras
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.images.metrics import psnr
from vvgt_cli.network.model import Vvgt
from vvgt_cli.network.prepare import Prepared, prepare
from vvgt_cli.network.runtime import views_of_round
from vvgt_cli.network.training.config import TrainConfig
from vvgt_cli.network.training.losses import decibels, view_loss
from vvgt_cli.network.training.lpips import Lpips
from vvgt_cli.network.training.scenes import TrainingScene, as_float
from vvgt_cli.network.training.splatter import splat
from vvgt_cli.splat import render


@dataclass
class Tally:
    """Contribution of a scene to a step's record; a scene that fails counts as ``bad`` and adds nothing else."""

    loss: float = 0.0
    gain: float = 0.0
    bad: int = 0


def tensors(prepared: Prepared) -> dict[str, Tensor]:
    """Return the network's input as tensors."""
    return {name: torch.from_numpy(np.array(array)) for name, array in prepared.arrays().items()}


def run_network(network: Vvgt, inputs: dict[str, Tensor], device: torch.device) -> Tensor:
    """Return rows (K, 14) float32, computed in bfloat16 on CUDA."""
    with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
        rows: Tensor = network({name: tensor.to(device) for name, tensor in inputs.items()})
    return rows.float()


class Feeder:
    """Network inputs of the training scenes, made on first use and kept.

    Slopes cost more than the rest of a step. They depend on Gaussians and views alone, so a scene's first round has
    ``view_sets`` inputs in all. Those of round r start from the output of r rounds of the untrained network: plain
    gradient steps for the head "step", no change for the others.
    """

    def __init__(self, scenes: Sequence[TrainingScene], config: TrainConfig) -> None:
        """Keep up to ``config.keep`` inputs of ``scenes``."""
        self.scenes, self.config = scenes, config
        self.plain = Vvgt(config.network).eval()  # on the host
        self.kept: OrderedDict[tuple[int, int, int], tuple[Prepared, dict[str, Tensor]]] = OrderedDict()

    def give(self, scene: int, views: int, number: int) -> tuple[Prepared, dict[str, Tensor]]:
        """Return the input of round ``number`` of a scene, with its view set ``views``."""
        key = (scene, views, number)
        if key not in self.kept:
            prepared = self._make(*key)
            self.kept[key] = prepared, tensors(prepared)
            if len(self.kept) > self.config.keep:
                self.kept.popitem(last=False)
        self.kept.move_to_end(key)
        return self.kept[key]

    def _make(self, scene: int, views: int, number: int) -> Prepared:
        rounds, source = self.config.network.rounds, self.scenes[scene]
        rng = np.random.default_rng([self.config.seed, scene, views])
        chosen = [int(i) for i in rng.permutation(len(source.cameras))[: self.config.network.total_views]]
        gaussians = source.gaussians
        if number:
            before, inputs = self.give(scene, views, number - 1)
            with torch.no_grad():
                gaussians = before.restore(run_network(self.plain, inputs, torch.device("cpu")).numpy())
        shown = views_of_round(chosen, number, rounds)
        cameras = [source.cameras[i] for i in shown]
        return prepare(gaussians, cameras, as_float(source.images[shown]), self.config.network)


def accumulate_gradients(
    network: Vvgt, feeder: Feeder, rng: np.random.Generator, device: torch.device, lpips: Lpips | None = None
) -> Tally:
    """Add the gradients of a random scene's loss in a random round: mean over views, over the batch."""
    config = feeder.config
    index, views, number = (int(rng.integers(n)) for n in (len(feeder.scenes), config.view_sets, config.network.rounds))
    scene, (prepared, inputs) = feeder.scenes[index], feeder.give(index, views, number)
    chosen = [int(i) for i in rng.permutation(len(scene.targets))[: config.views]]
    rows = run_network(network, inputs, device)
    if not torch.isfinite(rows).all():
        return Tally(bad=1)
    before = prepared.restore(prepared.rows)
    loss, gain = rows.new_zeros(()), 0.0
    for i in chosen:
        target = torch.from_numpy(as_float(scene.target_images[i])).to(device)
        start = torch.from_numpy(render(before, scene.targets[i])).to(device)
        picture = splat(rows, scene.targets[i])
        loss = loss + view_loss(picture, target, start, config.loss, lpips) / len(chosen)
        gain += float(decibels(picture.detach(), target, start)) / len(chosen)
    if not torch.isfinite(loss):
        return Tally(bad=1)
    (loss / config.batch).backward()
    return Tally(float(loss.detach()), gain)


@torch.no_grad()
def score_scene(network: Vvgt, scene: TrainingScene, config: TrainConfig, device: torch.device) -> list[float]:
    """Return the PSNR on all targets of the initial Gaussians, and after every round."""
    few, gaussians = farthest_cameras(scene.cameras, config.network.total_views), scene.gaussians
    found = [mean_psnr(gaussians, scene.targets, scene.target_images)]
    for number in range(config.network.rounds):
        shown = views_of_round(few, number, config.network.rounds)
        cameras, images = [scene.cameras[i] for i in shown], as_float(scene.images[shown])
        prepared = prepare(gaussians, cameras, images, config.network)
        rows = run_network(network, tensors(prepared), device).cpu().numpy()
        gaussians = prepared.accept(rows, cameras, images)
        found.append(mean_psnr(gaussians, scene.targets, scene.target_images))
    return found


def mean_psnr(gaussians: Gaussians, cameras: Sequence[Camera], images: np.ndarray) -> float:
    """Return the mean PSNR over views; images uint16."""
    pairs = zip(cameras, images, strict=True)
    return float(np.mean([psnr(as_float(view)[..., :3], render(gaussians, c)[..., :3]) for c, view in pairs]))
