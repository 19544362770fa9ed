"""Cases of the optimiser: rates far off, scenes far out, against Adam in float64; never worse than its input."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from typing import Any

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.clouds import FIELDS, cloud, extremes, shaped
from vvgt_cli.checks.scenes import build, smooth, step
from vvgt_cli.closed_form import VbmOptions, initialise
from vvgt_cli.dvr import RenderSettings, render_views
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.images.metrics import psnr
from vvgt_cli.refine import METHODS, OptimizeOptions, optimize
from vvgt_cli.splat import render

STAGE = "optimiser"
SIZE, STEPS = 32, 40


@cache
def _stiff() -> tuple[Gaussians, list[Camera], np.ndarray]:
    """A step function of opacity 1 over an optical depth of 1e6 a voxel: start, cameras, views."""
    scene = build(smooth(), step(1.0), 11.5e-6)
    cameras = default_views("train", 6, size=SIZE)
    views = render_views(scene, cameras, RenderSettings())
    return initialise(scene, VbmOptions(150, SIZE)).gaussians, cameras, views


def sound(gaussians: Gaussians, cameras: list[Camera]) -> float:
    """Largest value of the pictures; raises where a field or a picture is not finite."""
    for field in FIELDS:
        require(np.isfinite(getattr(gaussians, field)).all(), f"{field} that are not finite")
    images = [render(gaussians, camera) for camera in cameras]
    require(all(np.isfinite(image).all() for image in images), "a picture that is not finite")
    return max(float(image[..., 3].max(initial=0)) for image in images)


def _run(method: str, factor: float, start: Gaussians | None) -> Figure:
    """`STEPS` steps with all rates ``factor`` times what they are."""
    from vvgt_cli.refine import loop

    own, cameras, views = _stiff()
    options = OptimizeOptions.of(method, steps=STEPS, max_gaussians=300)
    state = loop.begin(own if start is None else start, cameras, options)
    kind: Any = type(state)
    state.RATES = np.asarray(kind.RATES) * factor  # of this one object
    error = None
    for n in range(STEPS):
        error = loop.step(state, cameras[n % 6], views[n % 6], options, error, n / STEPS, 1.0)
    require(error is not None and np.isfinite(error), f"an error of {error}")
    return Figure("largest alpha", sound(state.gaussians(), cameras), 1.0)


def _never_worse(method: str) -> Figure:
    """Rates as they are, views of something else: what is returned is no farther from the check views, drawn anew."""
    start, cameras, views = _stiff()
    judges = default_views("check", 2, size=SIZE)
    scene = build(smooth(), step(1.0), 11.5e-6)
    seen = render_views(scene, judges, RenderSettings())
    options = OptimizeOptions.of(method, steps=STEPS, check_every=10, max_gaussians=300)
    result, record = optimize(start, cameras, 1 - views, options, (judges, seen))
    require(record.psnr_after is not None, "no look at the check views")
    sound(result, cameras)
    before, after = (
        float(np.mean([psnr(v[..., :3], render(g, c)[..., :3]) for c, v in zip(judges, seen, strict=True)]))
        for g in (start, result)
    )
    assert record.psnr_after is not None
    require(abs(after - record.psnr_after) < 0.05, f"{record.psnr_after} dB said, {after} dB drawn")
    return Figure("dB lost on the check views", before - after, 0.01)


def _better(method: str) -> Figure:
    """From nearby Gaussians back to views that Gaussians made."""
    cameras = default_views("train", 6, size=SIZE)
    target = cloud(60, 3, 0.15, logit=1.0)
    views = np.stack([render(target, camera) for camera in cameras])
    shifted = target.means + np.random.default_rng(0).normal(0, 0.03, target.means.shape)
    start = Gaussians(shifted, target.log_scales, target.quaternions, target.opacity_logits, target.colors)
    options = OptimizeOptions.of(method, steps=60)
    result, _ = optimize(start, cameras, views, options, (cameras, views))

    def error(gaussians: Gaussians) -> float:
        return sum(float(np.square(render(gaussians, c) - v).sum()) for c, v in zip(cameras, views, strict=True))

    return Figure("squared error over that before", error(result) / error(start), 0.9)


def _few(gaussians: Gaussians, size: int) -> Figure:
    """Few Gaussians, or views of one pixel."""
    _, cameras, _ = _stiff()
    cameras = [camera.resized(size / SIZE) for camera in cameras]
    views = np.full((6, size, size, 4), 0.5, np.float32)
    result, _ = optimize(gaussians, cameras, views, OptimizeOptions(steps=STEPS))
    require(len(result) == len(gaussians), f"{len(result)} Gaussians of {len(gaussians)}")
    return Figure("largest alpha", sound(result, cameras), 1.0)


def _adam(size: float) -> Figure:
    """The kernel against Adam in float64, slopes of one size."""
    from vvgt_cli.refine import steps

    rng = np.random.default_rng(0)
    values = rng.normal(size=500).astype(np.float32)
    first, second = np.zeros_like(values), np.zeros_like(values)
    exact, m, v = values.astype(np.float64), np.zeros(500), np.zeros(500)
    for n in range(1, 31):
        slopes = (rng.normal(size=500) * size).astype(np.float32)
        steps.adam(values, slopes, 1e-3, 0.9, 0.999, n, first, second)
        m, v = 0.9 * m + 0.1 * slopes, 0.999 * v + 0.001 * slopes.astype(np.float64) ** 2
        exact -= 1e-3 * (m / (1 - 0.9**n)) / (np.sqrt(v / (1 - 0.999**n)) + 1e-15)
    return Figure("off Adam in float64", float(np.abs(values - exact).max()), 1e-5)


def _loss(weights: tuple[float, float, float]) -> Figure:
    """Slopes of the loss against its formula in float64; ``weights`` of |r|, r^2 and alpha."""
    from vvgt_cli.refine.loss import loss_gradient

    rng = np.random.default_rng(0)
    image, target = (rng.random((9, 7, 4)).astype(np.float32) * 1e3 for _ in range(2))
    grad = np.empty_like(image)
    l1, l2, alpha = (np.float32(w) for w in weights)
    loss_gradient(image, target, l1, l2, alpha, grad, np.empty(9))
    r = image.astype(np.float64) - target
    exact = (l1 * np.sign(r) + 2 * l2 * r) * np.array([1, 1, 1, alpha])
    return Figure("off the formula, relative", float(np.abs(grad - exact).max() / np.abs(exact).max()), 1e-6)


def cases() -> Iterator[Case]:
    """All of them."""
    for method in METHODS:
        for factor in (0.01, 1.0, 100.0):
            yield Case(STAGE, f"{method}, stiff scene, rates x {factor:g}", partial(_run, method, factor, None))
        yield Case(STAGE, f"{method}, extreme Gaussians, rates x 100", partial(_run, method, 100.0, extremes()))
        yield Case(STAGE, f"{method}, views of something else", partial(_never_worse, method))
        yield Case(STAGE, f"{method}, back to where views come from", partial(_better, method))
    needles = shaped((0.8, 1e-4, 1e-4))
    yield Case(STAGE, "frame, needles, rates x 100", partial(_run, "frame", 100.0, needles))
    many = cloud(700)
    alike = many.take(np.zeros(700, np.int64))
    for name, gaussians in (("that share steps", many), ("all alike", alike)):
        yield Case(STAGE, f"frame, Gaussians {name}, rates x 100", partial(_run, "frame", 100.0, gaussians))
    for count in (0, 1, 10):
        yield Case(STAGE, f"K = {count}", partial(_few, cloud(count), SIZE))
    yield Case(STAGE, "views of one pixel", partial(_few, cloud(20), 1))
    for size in (1e-12, 1.0, 1e12):
        yield Case(STAGE, f"Adam, slopes of {size:g}", partial(_adam, size))
    for weights in ((1.0, 0.0, 0.5), (0.0, 1.0, 0.5), (0.8, 0.2, 0.0)):
        yield Case(STAGE, f"slopes of the loss, weights {weights}", partial(_loss, weights))
