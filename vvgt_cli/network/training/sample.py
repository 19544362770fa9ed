"""One scene through the network: its loss with gradients, its gain for the record, and splatters for autograd."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from vvgt_cli.cameras import Camera, farthest_cameras
from vvgt_cli.gaussians import DILATION, MAX_ALPHA, NEAR, TILE, Gaussians
from vvgt_cli.images import metrics
from vvgt_cli.images.metrics import C1, C2, RADIUS, SIGMA
from vvgt_cli.network.checkpoint import tensors_of
from vvgt_cli.network.model import Vvgt
from vvgt_cli.network.prepare import Prepared, prepare, unpack
from vvgt_cli.network.runtime import views_of_round
from vvgt_cli.network.training.config import LossConfig, TrainConfig
from vvgt_cli.network.training.lpips import Lpips
from vvgt_cli.network.training.scenes import TrainingScene, as_float
from vvgt_cli.splat import project, render, render_backward


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
        self.give = lru_cache(config.keep)(self._made)

    def _made(self, scene: int, views: int, number: int) -> tuple[Prepared, dict[str, Tensor]]:
        """Return the input of round ``number`` of a scene, with its view set ``views``."""
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
        prepared = prepare(gaussians, cameras, as_float(source.images[shown]), self.config.network)
        return prepared, tensors_of(prepared.arrays())


def accumulate_gradients(
    network: Vvgt, feeder: Feeder, rng: np.random.Generator, device: torch.device, lpips: Lpips | None = None
) -> tuple[float, float, int]:
    """Add the gradients of a random scene's loss in a random round: mean over views, over the batch.

    Return loss, gain in dB, and 0; of a scene that fails 0, 0 and 1.
    """
    config = feeder.config
    index, views, number = (int(rng.integers(n)) for n in (len(feeder.scenes), config.view_sets, config.network.rounds))
    scene, (prepared, inputs) = feeder.scenes[index], feeder.give(index, views, number)
    chosen = [int(i) for i in rng.permutation(len(scene.targets))[: config.views]]
    rows = run_network(network, inputs, device)
    if not torch.isfinite(rows).all():
        return 0.0, 0.0, 1
    before = prepared.restore(prepared.rows)
    loss, gain = rows.new_zeros(()), 0.0
    for i in chosen:
        target = torch.from_numpy(as_float(scene.target_images[i])).to(device)
        start = torch.from_numpy(render(before, scene.targets[i])).to(device)
        picture = splat(rows, scene.targets[i])
        loss = loss + view_loss(picture, target, start, config.loss, lpips) / len(chosen)
        gain += float(decibels(picture.detach(), target, start)) / len(chosen)
    if not torch.isfinite(loss):
        return 0.0, 0.0, 1
    (loss / config.batch).backward()
    return float(loss.detach()), gain, 0


@torch.no_grad()
def score_scene(network: Vvgt, scene: TrainingScene, config: TrainConfig, device: torch.device) -> list[float]:
    """Return the PSNR on all targets of the initial Gaussians, and after every round."""
    few, gaussians = farthest_cameras(scene.cameras, config.network.total_views), scene.gaussians
    scores = [mean_psnr(gaussians, scene.targets, scene.target_images)]
    for number in range(config.network.rounds):
        shown = views_of_round(few, number, config.network.rounds)
        cameras, images = [scene.cameras[i] for i in shown], as_float(scene.images[shown])
        prepared = prepare(gaussians, cameras, images, config.network)
        rows = run_network(network, tensors_of(prepared.arrays()), device).cpu().numpy()
        gaussians = prepared.accept(rows, cameras, images)
        scores.append(mean_psnr(gaussians, scene.targets, scene.target_images))
    return scores


def mean_psnr(gaussians: Gaussians, cameras: Sequence[Camera], images: np.ndarray) -> float:
    """Return the mean PSNR over views; images uint16."""
    return metrics.mean_psnr(map(as_float, images), (render(gaussians, camera) for camera in cameras))


TINY = 1e-10  # squared error of 100 dB


def view_loss(
    picture: Tensor, target: Tensor, before: Tensor | None, config: LossConfig, lpips: Lpips | None = None
) -> Tensor:
    """Return the weighted sum of the terms for a picture (h, w, 4), premultiplied; a term of weight 0 is not computed.

    ``before`` is the picture of the network's input, for ``decibel``.
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

    On a CUDA device gsplat draws it if installed, else the numba kernels on the host.
    """
    if rows.is_cuda and importlib.util.find_spec("gsplat"):
        return gsplat_picture(rows, camera)
    return Splat.apply(rows, camera)


def gsplat_picture(rows: Tensor, camera: Camera) -> Tensor:
    """`splat` by gsplat (Ye et al. 2024), differentiable.

    gsplat's alpha ends at 0.999, where that of the rules ends at `MAX_ALPHA`: opacities are made to end there. And it
    takes the Jacobian of what lies beside the frustum at the frustum's edge: pictures differ there.
    """
    from gsplat.cuda import _wrapper as gsplat

    means, log_scales, quats, logits, colors = rows.float().split([3, 3, 4, 1, 3], dim=1)
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3], pose[:3, 3] = camera.rotation, camera.translation
    lens = [[camera.fx, 0, camera.cx, 0], [0, camera.fy, camera.cy, 0], [0, 0, 1, 0], [0, 0, 0, 0]]
    view, lens = torch.from_numpy(np.stack([pose, np.array(lens, np.float32)])).to(rows.device)
    size = camera.width, camera.height
    across, down = (-(-edge // TILE) for edge in size)
    opacities = logits[:, 0].sigmoid().clamp(max=MAX_ALPHA)
    radii, centres, depths, conics, _ = gsplat.fully_fused_projection(
        means, None, quats, log_scales.exp(), view[None], lens[None, :3, :3], *size, eps2d=DILATION, near_plane=NEAR,
        opacities=opacities,
    )  # fmt: skip
    _, pairs, members = gsplat.isect_tiles(centres, radii, depths, TILE, across, down)
    begin = gsplat.isect_offset_encode(pairs, 1, across, down)
    rgb, alpha = gsplat.rasterize_to_pixels(
        centres, conics, colors.clamp(min=0)[None], opacities[None], *size, TILE, begin, members
    )  # fmt: skip
    return torch.cat([rgb[0], alpha[0]], dim=-1)
