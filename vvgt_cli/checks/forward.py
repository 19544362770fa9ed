"""Cases of the splatter: pictures against the float64 twin, and what no picture may do."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.clouds import Cloud, cloud, extremes, hard_clouds, view
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.constants import MAX_ALPHA, MIN_TRANSMITTANCE
from vvgt_cli.splat import blend, project, render, render_reference

STAGE = "splats"
JUMP = 0.01  # a pixel at the cut of alpha, or at the end of its transmittance, may fall either way


def sane(image: np.ndarray) -> None:
    """Finite, nothing below 0, alpha no more than the splatter leaves."""
    require(np.isfinite(image).all(), f"{np.count_nonzero(~np.isfinite(image))} values are not finite")
    require(image.min(initial=0) >= 0, f"a value of {image.min(initial=0):.3g}")
    top = image[..., 3].max(initial=0)
    require(top <= max(MAX_ALPHA, 1 - MIN_TRANSMITTANCE) + 1e-6, f"alpha {top:.9g}")


def _twin(row: Cloud) -> Figure:
    gaussians = row.make()
    image = render(gaussians, row.camera)
    sane(image)
    error = np.abs(image - render_reference(gaussians, row.camera))
    scale = max(1.0, float(np.abs(gaussians.colors).max(initial=0)))
    wrong = (error > row.tight * scale).mean()
    require(wrong <= 3e-3, f"{wrong:.3g} of the pixels differ from the twin by more than {row.tight:g}")
    return Figure("difference from the twin", float(error.max(initial=0)) / scale, JUMP)


def _white(gaussians: Gaussians) -> Gaussians:
    g = gaussians
    return Gaussians(g.means, g.log_scales, g.quaternions, g.opacity_logits, np.ones_like(g.colors))


def _million() -> Figure:
    """A million Gaussians, white: red is alpha in every pixel, and a second picture has the same bytes."""
    gaussians = _white(cloud(1_000_000, 8, 0.004))
    c = view(128, 128)
    image = render(gaussians, c)
    sane(image)
    require(image.tobytes() == render(gaussians, c).tobytes(), "the second picture differs")
    return Figure("colour against alpha", float(np.abs(image[..., :3] - image[..., 3:]).max()), 1e-6)


def _wide() -> Figure:
    """4096 x 16 pixels: the middle as a 16 x 16 picture has it, but for float32 at pixel 2048 (1e-4 px)."""
    gaussians = cloud(300, 9)
    image, middle = render(gaussians, view(4096, 16)), render(gaussians, view(16, 16))
    sane(image)
    return Figure("difference of the middle", float(np.abs(image[:, 2040:2056] - middle).max()), 1e-3)


def _extreme() -> Figure:
    """Nothing that is not finite, and colours of 40 stay what they are times alpha."""
    image = render(extremes(), view())
    sane(image)
    return Figure("brightest over 40 x alpha", float((image[..., :3] - 40 * image[..., 3:]).max()), 1e-4)


def _linear() -> Figure:
    """Pictures are linear in colours, which may be negative."""
    gaussians, c = cloud(300, 10), view()
    p = project(gaussians, c)
    rng = np.random.default_rng(0)
    a, b = (rng.normal(size=(300, 3)).astype(np.float32) for _ in range(2))
    whole, *parts = (blend(p, x, c.height, c.width)[..., :3] for x in (2 * a - 3 * b, a, b))
    return Figure("off linear", float(np.abs(whole - 2 * parts[0] + 3 * parts[1]).max()), 2e-5)


def _order() -> Figure:
    """The order in the file does not matter to the last bit."""
    gaussians, c = cloud(500, 11), view()
    mixed = gaussians.take(np.random.default_rng(0).permutation(500))
    return Figure("values that differ", float(np.count_nonzero(render(gaussians, c) != render(mixed, c))), 0)


def _overflow() -> Figure:
    """A Gaussian whose covariance float32 cannot hold is left out; the others are as without it."""
    g = cloud(4, 12, 0.2, logit=3.0, box=0.1)
    scales = g.log_scales.copy()
    scales[1] = 400.0
    odd = Gaussians(g.means, scales, g.quaternions, g.opacity_logits, g.colors)
    off = np.abs(render(odd, view()) - render(g.take(np.array([0, 2, 3])), view())).max()
    return Figure("difference", float(off), 0)


def cases() -> Iterator[Case]:
    """All of them."""
    for row in hard_clouds():
        yield Case(STAGE, row.name, partial(_twin, row))
    yield Case(STAGE, "K = 1,000,000", _million)
    yield Case(STAGE, "4096 x 16 pixels", _wide)
    yield Case(STAGE, "sizes of 1e-11 to 55, opacities of 0 and 1", _extreme)
    yield Case(STAGE, "linear in colours", _linear)
    yield Case(STAGE, "another order", _order)
    yield Case(STAGE, "a covariance that overflows", _overflow)
