"""Sets of Gaussians that are hard to splat: needles, discs, points, giants, thousands of layers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.gaussians import Gaussians

EYE = (2.0, -1.7, 1.1)
FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "colors")


def cloud(
    count: int, seed: int = 0, scale: float = 0.05, spread: float = 0.3, logit: float = 0.0, box: float = 0.6
) -> Gaussians:
    """Random Gaussians about the origin; colours from -0.3 to 1.2."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-box, box, (count, 3)),
        np.log(scale) + rng.normal(0, spread, (count, 3)),
        rng.normal(size=(count, 4)),
        logit + rng.normal(0, 2, count),
        rng.uniform(-0.3, 1.2, (count, 3)),
    )


def shaped(axes: tuple[float, float, float], count: int = 60, seed: int = 1) -> Gaussians:
    """Random places and turns, one shape."""
    g = cloud(count, seed)
    return Gaussians(g.means, np.log(np.tile(axes, (count, 1))), g.quaternions, g.opacity_logits, g.colors)


def extremes(count: int = 80) -> Gaussians:
    """Sizes from 1e-11 to 55, opacities that round to 0 and 1, centres beside and behind cameras, colours to 40."""
    rng = np.random.default_rng(0)
    return Gaussians(
        rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-2, 1, (count, 1)),
        rng.uniform(-25, 4, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(-60, 60, count),
        rng.uniform(0, 40, (count, 3)),
    )


def _norms() -> Gaussians:
    g = cloud(200, 4)
    factors = np.geomspace(1e-12, 1e12, 200)[:, None]
    return Gaussians(g.means, g.log_scales, g.quaternions * factors, g.opacity_logits, g.colors)


def _near_plane() -> Gaussians:
    """Four around the nearest depth that is drawn, 0.01, on the axis of `view`."""
    c = view()
    depths = np.array([0.0099, 0.0100001, 0.011, 0.02])
    means = (c.rotation.T @ (np.outer([0, 0, 1.0], depths) - c.translation[:, None])).T
    return Gaussians(means, np.full((4, 3), -6.0), np.ones((4, 4)), np.full(4, -1.0), np.full((4, 3), 0.5))


def _clamped() -> Gaussians:
    return Gaussians(np.zeros((1, 3)), np.full((1, 3), 5.0), *map(np.array, ([[1, 0, 0, 0]], [30.0], [[1, 0.5, -1]])))


def view(width: int = 48, height: int = 48, eye: tuple[float, float, float] = EYE, fov: float = 40.0) -> Camera:
    """A camera that looks at the origin."""
    return look_at(eye, width=width, height=height, fov=fov)


@dataclass(frozen=True)
class Cloud:
    """Gaussians and who looks at them.

    Attributes:
        name: what is hard about them.
        make: builds them.
        camera: that looks.
        tight: allowed of a pixel (forward), or of a Gaussian's size of gradient (backward, 50 times it).
        share: of Gaussians whose gradient may be off by more: float32 decides otherwise at the thresholds of alpha
            and transmittance.
    """

    name: str
    make: Callable[[], Gaussians]
    camera: Camera
    tight: float = 4e-5
    share: float = 0.03


def hard_clouds() -> list[Cloud]:
    """Every set that the float64 twin can follow, in order."""
    inside = view(40, 40, (0.1, 0.05, 0.0), 90.0)
    return [
        Cloud("K = 0", partial(cloud, 0), view()),
        Cloud("K = 1", partial(cloud, 1, 5, 0.2, logit=3.0, box=0.1), view()),
        Cloud("K = 10", partial(cloud, 10), view()),
        *(Cloud(f"{w} x {h} pixels", partial(cloud, 300, 2), view(w, h)) for w, h in ((1, 1), (17, 49), (80, 15))),
        Cloud("needles", partial(shaped, (0.8, 1e-3, 1e-3)), view(), 1e-3, 0.1),  # cancellation in the exponent
        Cloud("pancakes", partial(shaped, (0.8, 0.8, 1e-4)), view(), 1e-3, 0.1),
        Cloud("points", partial(shaped, (1e-6, 1e-6, 1e-6)), view(), 1e-3, 0.1),
        Cloud("giants", partial(shaped, (3.0, 3.0, 3.0)), view(), 1e-3, 0.1),
        Cloud("an eye among them", partial(cloud, 400, 2, 0.02), inside),
        Cloud("at the near plane", _near_plane, view(32, 32), share=0.0),
        Cloud("alpha at its clamp", _clamped, view(33, 33), share=0.0),
        Cloud("all too faint to draw", partial(cloud, 20, logit=-20.0), view()),
        Cloud("a thousand faint layers", partial(cloud, 1000, 3, 0.3, logit=-3.0, box=0.2), view(16, 16), share=0.05),
        Cloud("a thousand opaque layers", partial(cloud, 1000, 3, 0.3, logit=6.0, box=0.2), view(16, 16), share=0.05),
        Cloud("quaternions of norm 1e-12 to 1e12", _norms, view()),
        Cloud("all in one place", partial(cloud, 100, 6, 0.1, 0.5, box=0.0), view(), 1e-3, 0.1),
    ]
