"""Cases of the splatter's gradients: against the float64 twin, adjoint to the picture, finite at the extremes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.clouds import FIELDS, Cloud, cloud, extremes, hard_clouds, view
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.splat import blend, gather, project, render, render_backward, render_backward_reference
from vvgt_cli.splat.render import Gradients

STAGE = "gradients"


def _gradients(gaussians: Gaussians, camera: Camera, grad: np.ndarray) -> Gradients:
    projection = project(gaussians, camera)
    found = render_backward(gaussians, camera, projection, render(gaussians, camera, projection=projection), grad)
    for field in FIELDS:
        require(np.isfinite(getattr(found, field)).all(), f"gradients of {field} that are not finite")
    return found


def _random(camera: Camera, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(camera.height, camera.width, 4)).astype(np.float32)


def _twin(row: Cloud) -> Figure:
    """Difference relative to a Gaussian's own size of gradient, all but a share of them; the worst field's."""
    gaussians, grad = row.make(), _random(row.camera)
    ours = _gradients(gaussians, row.camera, grad)
    twin = render_backward_reference(gaussians, row.camera, grad.astype(np.float64))
    worst = 0.0
    for field in FIELDS if len(gaussians) else ():
        a, b = getattr(ours, field).reshape(len(gaussians), -1), twin[field].reshape(len(gaussians), -1)
        scale = np.abs(b).max(axis=1) + 1e-2 * np.abs(b).mean() + 1e-12
        off = np.abs(a - b).max(axis=1) / scale
        worst = max(worst, float(np.quantile(off, 1 - row.share, method="higher")))
    return Figure("difference from the twin, relative", worst, 50 * row.tight)


def _adjoint(count: int) -> Figure:
    """<blend(c), f> = <c, gather(f)>: the gradient of colours is the picture's own weights."""
    gaussians, c = cloud(count, 10), view()
    p, field = project(gaussians, c), _random(c).transpose(2, 0, 1)
    sums = np.zeros((count, 5))
    gather(p, np.ascontiguousarray(field), sums)
    colors = np.random.default_rng(1).normal(size=(count, 3)).astype(np.float32)
    image = blend(p, colors, c.height, c.width).astype(np.float64)
    terms = image[..., :3] * field[:3].transpose(1, 2, 0)
    return Figure("off, relative", abs(terms.sum() - (colors * sums[:, 1:4]).sum()) / np.abs(terms).sum(), 1e-6)


def _million() -> Figure:
    """A million Gaussians: finite, and the gradients of white colours add up to the picture's."""
    gaussians, c = cloud(1_000_000, 8, 0.004), view(64, 64)
    white = Gaussians(
        gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.opacity_logits,
        np.ones_like(gaussians.colors),
    )  # fmt: skip
    found = _gradients(white, c, np.ones((64, 64, 4), np.float32))
    total, alpha = found.colors.sum(dtype=np.float64), 3 * render(white, c)[..., 3].sum(dtype=np.float64)
    return Figure("sum of colour gradients off, relative", abs(total / alpha - 1), 1e-4)


def _extreme(size: float) -> Figure:
    """Gradients of the loss from 1e-30 to 1e10: finite, and nothing behind the eye moves."""
    gaussians, c = extremes(), view()
    found = _gradients(gaussians, c, _random(c) * np.float32(size))
    behind = (gaussians.means @ c.rotation.T + c.translation)[:, 2] <= 0.01
    require(behind.any(), "none behind the eye")
    moved = max(float(np.abs(getattr(found, field)[behind]).max()) for field in FIELDS)
    return Figure("gradient behind the eye", moved, 0)


def _same_bytes() -> Figure:
    gaussians, c = cloud(500, 7), view()
    first, second = (_gradients(gaussians, c, _random(c)) for _ in range(2))
    differ = sum(getattr(first, f).tobytes() != getattr(second, f).tobytes() for f in FIELDS)
    return Figure("fields that differ", differ, 0)


def cases() -> Iterator[Case]:
    """All of them."""
    for row in hard_clouds():
        yield Case(STAGE, row.name, partial(_twin, row))
    for count in (1, 400):
        yield Case(STAGE, f"adjoint of the picture, K = {count}", partial(_adjoint, count))
    yield Case(STAGE, "K = 1,000,000", _million)
    for size in (1e-30, 1.0, 1e10):
        yield Case(STAGE, f"extreme Gaussians, slopes of {size:g}", partial(_extreme, size))
    yield Case(STAGE, "the same bytes twice", _same_bytes)
