"""3DGS from random points for 30,000 steps on a GPU, beside a conversion's seconds and dB.

    PYTHONPATH=. python benchmarks/gsplat_trainer.py SCENES.tsv DATA_DIR TF_DIR bonsai-tree -o trained.ply

Uses gsplat 1.5.3's kernels and MCMC strategy with the settings of its `simple_trainer.py mcmc` (rates, 0.8 L1 + 0.2
D-SSIM, random starts, weights on opacity and size), without harmonics, for at most K Gaussians. It is trained on 120
views of 512 px over
black, and scored as conversions are: 1080 px, over black, with the default drawing rule.
"""

from __future__ import annotations

import time
from typing import Any

import click
import numpy as np
import torch
import torch.nn.functional as functional
from dvr_scenes import read_scenes
from gsplat import MCMCStrategy, rasterization

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.sets import RADIUS
from vvgt_cli.dvr import render_view
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.ply import write_ply
from vvgt_cli.gaussians.types import SH_C0
from vvgt_cli.score.viewing import VIEWS
from vvgt_cli.splat import render

COUNT, SIZE, SCORED = 100_000, 512, 1080
REPORTED = (1_000, 7_000, 30_000)  # steps
RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "colors": 2.5e-3}
D_SSIM, SMALL, FAINT = 0.2, 0.01, 0.01  # weights: of D-SSIM, of size, of opacity


def starts(half: np.ndarray, device: str) -> dict[str, torch.nn.Parameter]:
    """Return the parameters of random Gaussians in a box of half extents ``half``."""
    rng = np.random.default_rng(0)
    means = rng.uniform(-1, 1, (COUNT, 3)) * half
    there = torch.tensor(means, device=device)
    near = torch.cat([torch.cdist(some, there).topk(4, largest=False).values for some in there.split(1000)])[:, 1:]
    scale = np.log(0.1 * (near**2).mean(dim=1).sqrt().cpu().numpy())
    made = {
        "means": means,
        "scales": np.repeat(scale[:, None], 3, axis=1),
        "quats": rng.uniform(size=(COUNT, 4)),
        "opacities": np.zeros(COUNT),  # logit of 0.5
        "colors": (rng.uniform(size=(COUNT, 3)) - 0.5) / SH_C0,
    }
    sent = {key: torch.tensor(value, dtype=torch.float32, device=device) for key, value in made.items()}
    return {key: torch.nn.Parameter(value) for key, value in sent.items()}


def ssim(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the mean SSIM of pictures (3, h, w), 11 x 11 Gaussian windows, without padding."""
    row = torch.exp(-((torch.arange(11, device=a.device) - 5.0) ** 2) / 4.5)
    window = (row[:, None] * row[None]) / row.sum() ** 2
    mean = functional.conv2d(torch.stack([a, b, a * a, b * b, a * b], 1), window.expand(5, 1, 11, 11), groups=5)
    ma, mb, aa, bb, ab = mean.unbind(1)
    found = (2 * ma * mb + 1e-4) * (2 * (ab - ma * mb) + 9e-4)
    return (found / ((ma**2 + mb**2 + 1e-4) * (aa - ma**2 + bb - mb**2 + 9e-4))).mean()


def gaussians(splats: dict[str, torch.nn.Parameter]) -> Gaussians:
    """Return what was trained, on the host."""
    found = {key: value.detach().cpu().numpy() for key, value in splats.items()}
    return Gaussians(found["means"], found["scales"], found["quats"], found["opacities"], 0.5 + SH_C0 * found["colors"])


@click.command()
@click.argument("listing")
@click.argument("data")
@click.argument("functions")
@click.argument("name")
@click.option("-o", "--output", required=True)
@click.option("--steps", default=REPORTED[-1], show_default=True)
@click.option("--views", default=120, show_default=True)
@click.option("--device", default="cuda", show_default=True)
def main(listing: str, data: str, functions: str, name: str, output: str, steps: int, views: int, device: str) -> None:
    """Train on a scene, print seconds and dB at some steps, and write the last Gaussians."""
    scene = next(read_scenes(listing, data, functions, (name,)))[1].scene()
    cameras = [default_views("test", size=SCORED)[n] for n in VIEWS]
    tests = [(camera, np.clip(render_view(scene, camera)[..., :3], 0, 1)) for camera in cameras]
    begun = time.perf_counter()
    cameras = default_views("train", views, size=SIZE)
    pictures = [torch.tensor(np.clip(render_view(scene, c)[..., :3], 0, 1), device=device).float() for c in cameras]
    poses, lenses = np.tile(np.eye(4, dtype=np.float32), (views, 1, 1)), np.zeros((views, 3, 3), np.float32)
    for n, camera in enumerate(cameras):
        poses[n, :3, :3], poses[n, :3, 3] = camera.rotation, camera.translation
        lenses[n] = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    sent = torch.tensor(poses, device=device), torch.tensor(lenses, device=device)
    print(f"views {time.perf_counter() - begun:.1f} s", flush=True)
    splats = starts(scene.half, device)
    rates = {key: rate * (1.1 * RADIUS if key == "means" else 1) for key, rate in RATES.items()}
    adams: dict[str, Any] = {
        key: torch.optim.Adam([{"params": splats[key], "lr": rates[key]}], eps=1e-15) for key in splats
    }
    slower = torch.optim.lr_scheduler.ExponentialLR(adams["means"], 0.01 ** (1 / steps))
    strategy = MCMCStrategy(cap_max=COUNT)
    state, spent = strategy.initialize_state(), 0.0
    for step in range(steps):
        begun = time.perf_counter()
        n = int(torch.randint(views, ()))
        drawn, _, info = rasterization(
            splats["means"],
            splats["quats"],
            torch.exp(splats["scales"]),
            torch.sigmoid(splats["opacities"]),
            0.5 + SH_C0 * splats["colors"],
            sent[0][n : n + 1],
            sent[1][n : n + 1],
            SIZE,
            SIZE,
            packed=False,
        )
        image, target = drawn[0].permute(2, 0, 1), pictures[n].permute(2, 0, 1)
        loss = (1 - D_SSIM) * (image - target).abs().mean() + D_SSIM * (1 - ssim(image, target))
        loss = loss + FAINT * torch.sigmoid(splats["opacities"]).mean() + SMALL * torch.exp(splats["scales"]).mean()
        loss.backward()
        for adam in adams.values():
            adam.step()
            adam.zero_grad(set_to_none=True)
        slower.step()
        strategy.step_post_backward(splats, adams, state, step, info, lr=slower.get_last_lr()[0])
        if step + 1 in (*REPORTED, steps):
            if device == "cuda":
                torch.cuda.synchronize()
            spent += time.perf_counter() - begun
            found = gaussians(splats)
            db = [-10 * np.log10(np.mean((np.clip(render(found, c)[..., :3], 0, 1) - r) ** 2)) for c, r in tests]
            print(f"step {step + 1}: {spent:.1f} s, {len(found)} Gaussians, {np.mean(db):.2f} dB", flush=True)
            continue
        spent += time.perf_counter() - begun
    write_ply(output, found)


if __name__ == "__main__":
    main()
