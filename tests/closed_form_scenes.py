"""Scenes, transfer functions and pictures that the tests of vvgt_cli.closed_form share."""

from dataclasses import dataclass

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.dvr import Scene
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.images.metrics import psnr
from vvgt_cli.splat import render
from vvgt_cli.volume import Volume


@dataclass(frozen=True)
class Ramp:
    """Extinction ``k x`` exactly, per unit distance 1, on [lo, hi]; colour goes from (1, 0.25, 0) to (0, 0.25, 1)."""

    k: float = 1.0
    lo: float = 0.0
    hi: float = 1.0
    name: str = "ramp"

    def node_range(self) -> tuple[float, float]:
        return self.lo, self.hi

    def _fraction(self, x: np.ndarray) -> np.ndarray:
        return np.clip((np.asarray(x, np.float64) - self.lo) / (self.hi - self.lo), 0, 1)

    def opacity(self, x: np.ndarray) -> np.ndarray:
        return -np.expm1(-self.k * self._fraction(x))

    def color(self, x: np.ndarray) -> np.ndarray:
        f = self._fraction(x)
        return np.stack([1 - f, np.full_like(f, 0.25), f], axis=-1)


@dataclass(frozen=True)
class Tent:
    """Opacity ``top`` at ``centre``, falling linearly to 0 at ``width`` on either side; colour as `Ramp`."""

    centre: float = 0.5
    width: float = 0.2
    top: float = 0.6
    name: str = "tent"

    def node_range(self) -> tuple[float, float]:
        return 0.0, 1.0

    def breakpoints(self) -> np.ndarray:
        return np.array([0, self.centre - self.width, self.centre, self.centre + self.width, 1])

    def opacity(self, x: np.ndarray) -> np.ndarray:
        return self.top * np.clip(1 - np.abs(np.asarray(x, np.float64) - self.centre) / self.width, 0, 1)

    def color(self, x: np.ndarray) -> np.ndarray:
        return Ramp().color(x)


@dataclass(frozen=True)
class Above:
    """Opacity ``top`` above ``edge``, none below (a ramp of 1e-3 between); the colour is ``rgb``."""

    top: float = 1.0
    edge: float = 0.5
    rgb: tuple[float, float, float] = (0.9, 0.6, 0.2)
    name: str = "above"

    def node_range(self) -> tuple[float, float]:
        return 0.0, 1.0

    def opacity(self, x: np.ndarray) -> np.ndarray:
        return self.top * np.clip((np.asarray(x, np.float64) - self.edge) * 1e3, 0, 1)

    def color(self, x: np.ndarray) -> np.ndarray:
        return np.broadcast_to(np.array(self.rgb), (*np.shape(x), 3))


def scene_of(volume: Volume, tf: object, distance: float | None = None) -> Scene:
    """``distance`` is the world length that opacity is per; by default the mean voxel spacing."""
    return Scene.build(volume, tf, float(np.mean(volume.spacing)) if distance is None else distance)  # type: ignore[arg-type]


def score(gaussians: Gaussians, cameras: list[Camera], views: np.ndarray) -> float:
    """Mean PSNR over the views, RGB over black."""
    return float(
        np.mean([psnr(v[..., :3], render(gaussians, c)[..., :3]) for c, v in zip(cameras, views, strict=True)])
    )
