"""Views of a `Scene`: pixel-integrated images through the numba kernel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.dvr.scene import Scene
from vvgt_cli.errors import UsageError

EDGE = 0.02  # neighbouring pixels that differ by more get a grid of rays


@dataclass(frozen=True)
class RenderSettings:
    """How a view is integrated.

    Attributes:
        step: sampling distance in voxels; scalars are linear between samples (pre-integration).
        samples: rays along a pixel's edge where neighbours differ by more than 0.02 (``adaptive``), else everywhere.
        adaptive: False renders ``samples`` x ``samples`` rays in every pixel.
    """

    step: float = 0.5
    samples: int = 3
    adaptive: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.step <= 4:
            raise UsageError(f"step {self.step} voxels; expected more than 0 and at most 4")
        if not 1 <= self.samples <= 16:
            raise UsageError(f"samples {self.samples}; expected 1 to 16 rays along a pixel's edge")


REFERENCE = RenderSettings(step=0.125, samples=3)
FIT_VIEWS = RenderSettings(step=1.0, samples=1)  # one ray a pixel: pixel-integrated views fit no better
SCORE_VIEWS = RenderSettings(step=1.0, samples=2)


def camera_arrays(scene: Scene, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eye (3,) in voxel coordinates, basis (3, 3) in voxels per unit length, lens (1/fx, 1/fy, cx, cy)."""
    eye = (camera.position + scene.half) / scene.step - 0.5
    basis = camera.rotation / scene.step[None, :]
    lens = np.array([1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy])
    return eye, basis, lens


def tile_order(height: int, width: int) -> np.ndarray:
    """Tiles dealt out over the threads like cards, so that equal chunks have equal work."""
    import numba

    from vvgt_cli.dvr.kernel import TILE

    count, threads = -(-height // TILE) * -(-width // TILE), numba.get_num_threads()
    return np.concatenate([np.arange(first, count, threads) for first in range(threads)])


def edges(image: np.ndarray) -> np.ndarray:
    """Pixels (h, w) of an image (h, w, c) that differ from one of 8 neighbours by more than `EDGE`."""
    mask = np.zeros(image.shape[:2], bool)
    pairs = [
        (np.s_[1:, :], np.s_[:-1, :]),
        (np.s_[:, 1:], np.s_[:, :-1]),
        (np.s_[1:, 1:], np.s_[:-1, :-1]),
        (np.s_[1:, :-1], np.s_[:-1, 1:]),
    ]
    for a, b in pairs:
        differ = np.abs(image[a] - image[b]).max(axis=-1) > EDGE
        mask[a] |= differ
        mask[b] |= differ
    return mask


def render_view(scene: Scene, camera: Camera, settings: RenderSettings | None = None) -> np.ndarray:
    """One view: (height, width, 4) float32, premultiplied RGBA over nothing."""
    from vvgt_cli.dvr.kernel import render_tiles

    settings = settings or RenderSettings()
    tables = scene.tables
    eye, basis, lens = camera_arrays(scene, camera)
    out = np.zeros((camera.height, camera.width, 4), np.float32)
    everywhere = np.ones(out.shape[:2], bool)
    order = tile_order(camera.height, camera.width)
    first = 1 if settings.adaptive else settings.samples

    def trace(grid: int, mask: np.ndarray, known: bool) -> None:
        render_tiles(
            scene.values, tables.lo, tables.inv_width, tables.nodes, tables.cumulative, tables.dark, scene.empty,
            eye, basis, lens, float(settings.step), order, grid, mask, known, out,
        )  # fmt: skip

    trace(first, everywhere, False)
    if settings.adaptive and settings.samples > 1:
        mask = edges(out)
        if mask.any():
            trace(settings.samples, mask, settings.samples % 2 == 1)
    return out


def render_views(
    scene: Scene,
    cameras: Sequence[Camera],
    settings: RenderSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> np.ndarray:
    """Views of one size: (n, height, width, 4) float32, premultiplied; ``progress(done, total)`` after each."""
    images = []
    for i, camera in enumerate(cameras):
        images.append(render_view(scene, camera, settings))
        if progress:
            progress(i + 1, len(cameras))
    return np.stack(images)
