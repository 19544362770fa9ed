"""Views of a `Scene`: pixel-integrated images through the numba kernel."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from vvgt_cli.cameras import Blocks, Camera
from vvgt_cli.dvr.scene import Scene
from vvgt_cli.errors import UsageError
from vvgt_cli.progress import ProgressCallback, counted

# Pixels that differ from a neighbour by more than this get that many rays.
ADAPTIVE = ((0.08, 5), (0.3, 13))
LATTICE = {5: 2, 13: 5}  # point i of n at (i, k i mod n) / n: all columns and rows differ, which edges along axes need


@dataclass(frozen=True)
class RenderSettings:
    """Settings of the integration along rays.

    Attributes:
        step: sampling distance in voxels; scalars are linear between samples (pre-integration).
        samples: rays along a pixel's edge, everywhere; None: as ``tiers`` say.
        tiers: (difference, rays): pixels that differ from one of 8 neighbours by more than the first, rising, get so
            many rays (5, 13 or a square), all others one.
        footprint: part of a pixel's edge that its rays cover: w / W where a view of w px samples a screen of W.
    """

    step: float = 0.5
    samples: int | None = None
    tiers: tuple[tuple[float, int], ...] = ADAPTIVE
    footprint: float = 1.0

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            UsageError: a number out of its range.
        """
        if not 0 < self.step <= 4:
            raise UsageError(f"step {self.step} voxels; expected more than 0 and at most 4")
        if self.samples is not None and not 1 <= self.samples <= 16:
            raise UsageError(f"samples {self.samples}; expected 1 to 16 rays along a pixel's edge")
        if not 0 < self.footprint <= 1:
            raise UsageError(f"footprint {self.footprint}; expected more than 0 and at most 1 pixel")


REFERENCE = RenderSettings(step=0.125, tiers=((0.02, 9),))
FIT_VIEWS = RenderSettings(step=1.0, samples=1)  # what colours are solved from


def ray_offsets(count: int) -> np.ndarray:
    """Return a pixel's ray positions (count, 2), right and down from its centre in pixels: a lattice or square grid.

    Raises:
        ValueError: neither.
    """
    if count in LATTICE:
        across = np.arange(count) - count // 2
        down = (LATTICE[count] * across + count // 2) % count - count // 2
        return np.stack([across, down], axis=1) / count
    edge = math.isqrt(count)
    if edge * edge != count:
        raise ValueError(f"{count} rays a pixel; expected {', '.join(map(str, LATTICE))} or a square")
    place = (np.arange(edge) + 0.5) / edge - 0.5
    return np.stack([np.tile(place, edge), np.repeat(place, edge)], axis=1)


class BoxFrame(NamedTuple):
    """A volume's half extents and voxel edges (3,) float64 in the unit frame, (x, y, z), as `Scene` has them."""

    half: np.ndarray
    step: np.ndarray


def camera_arrays(scene: Scene | BoxFrame, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return eye (3,) in voxel coordinates, basis (3, 3) in voxels per unit length, lens (1/fx, 1/fy, cx, cy)."""
    eye = (camera.position + scene.half) / scene.step - 0.5
    basis = camera.rotation / scene.step[None, :]
    lens = np.array([1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy])
    return eye, basis, lens


class Rays(NamedTuple):
    """Rays to cast: at ``offsets`` (m, 2) of every pixel in ``mask`` (h, w), averaged with ``known`` ones before."""

    offsets: np.ndarray
    mask: np.ndarray
    known: int


def tiers(settings: RenderSettings, image: np.ndarray, blocks: Blocks | None = None) -> Iterator[list[Rays]]:
    """Yield rays to cast into ``image`` (h, w, 4), or its ``blocks``, before the next are asked for."""
    everywhere = np.ones(image.shape[:2], bool) if blocks is None else blocks.mask()
    yield first_rays(settings, everywhere)
    yield more_rays(settings, image, everywhere)


def first_rays(settings: RenderSettings, everywhere: np.ndarray) -> list[Rays]:
    """Return all rays of pixels ``everywhere`` (h, w) bool, or one each where their contrast decides on `more_rays`."""
    if settings.samples is not None:
        return [Rays(ray_offsets(settings.samples**2) * settings.footprint, everywhere, 0)]
    return [Rays(np.zeros((1, 2)), everywhere, 0)]


def more_rays(settings: RenderSettings, image: np.ndarray, everywhere: np.ndarray) -> list[Rays]:
    """Return the rays that ``image`` (h, w, 4), of one ray per pixel of ``everywhere`` (h, w) bool, still needs."""
    from vvgt_cli.dvr.contrast import contrast

    if settings.samples is not None:
        return []
    differ = contrast(image, everywhere)
    ends, more = [threshold for threshold, _ in settings.tiers[1:]], []
    for (low, count), high in zip(settings.tiers, [*ends, np.inf], strict=True):
        mask = (differ > low) & (differ <= high)
        if mask.any():
            offsets = ray_offsets(count) * settings.footprint
            new = np.any(offsets != 0, axis=1)  # a grid of an even edge has no ray in the middle
            more.append(Rays(offsets[new], mask, int(not new.all())))
    return more


def for_thin(settings: RenderSettings, box: Scene | BoxFrame, camera: Camera) -> RenderSettings:
    """Set many rays for every pixel if the whole box may fall between the middles of two rows or columns."""
    if 2 * box.half.min() * camera.fx >= np.linalg.norm(camera.position):
        return settings
    return replace(settings, tiers=((-1.0, settings.tiers[-1][1]),))  # a first ray a pixel may show nothing


def host_rays(scene: Scene) -> Callable[..., None]:
    """Return the CPU's kernel for a scene's kind, bound to what it reads of the scene."""
    from vvgt_cli.dvr import march

    if scene.grid is None:
        kernel = march.render_tiles if scene.light is None else march.render_lit_tiles
        return partial(kernel, scene.voxels, scene.optics, None, scene.empty, scene.light)
    if scene.mixed:
        kernel = march.render_mixed_tiles if scene.light is None else march.render_lit_mixed_tiles
    else:
        kernel = march.render_grid_tiles if scene.light is None else march.render_lit_grid_tiles
    return partial(kernel, scene.relieved, scene.optics, scene.mixture, scene.empty, scene.light)


class Viewed(Protocol):
    """Source of its own pictures, such as a volume of which only blocks are in memory."""

    def view(self, camera: Camera, settings: RenderSettings, blocks: Blocks | None = None) -> np.ndarray:
        """Render one view, as `render_view` does."""


def render_view(
    scene: Scene | Viewed, camera: Camera, settings: RenderSettings | None = None, blocks: Blocks | None = None
) -> np.ndarray:
    """Render one view: (height, width, 4) float32, premultiplied RGBA over nothing; with ``blocks`` zero elsewhere."""
    from vvgt_cli.dvr.kernel import TILE

    settings = settings or RenderSettings()
    if not isinstance(scene, Scene):
        return scene.view(camera, settings, blocks)
    draw = scene.rays or host_rays(scene)
    eye, basis, lens = camera_arrays(scene, camera)
    out = np.zeros((camera.height, camera.width, 4), np.float32)
    tiles = math.prod(-(-edge // TILE) for edge in out.shape[:2])
    order = np.arange(tiles) if blocks is None else blocks.numbers
    for rays in tiers(for_thin(settings, scene, camera), out, blocks):
        for offsets, mask, known in rays:
            draw(eye, basis, lens, float(settings.step), order, offsets, mask, known, out)
    return out


def render_views(
    scene: Scene | Viewed,
    cameras: Sequence[Camera],
    settings: RenderSettings | None = None,
    progress: ProgressCallback | None = None,
) -> np.ndarray:
    """Render views of one size: (n, height, width, 4) float32, premultiplied; ``progress(done, total)`` after each."""
    return np.stack([render_view(scene, camera, settings) for camera in counted(cameras, progress)])
