"""Views marched through the volume itself, block after block: what Gaussians are fitted to and scored against.

A block leaves what it shows of each ray; front to back these compose to what a ray through the whole volume sees.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.cameras.blocks import BLOCK, Blocks, spread_blocks
from vvgt_cli.dvr.layout import BRICK, Optics, Voxels
from vvgt_cli.dvr.render import camera_arrays, ray_offsets
from vvgt_cli.runs.seats import PREVIEW_VIEWS
from vvgt_cli.scale.parts import CELLS, Parts
from vvgt_cli.splat.rules import INRIA, Rule
from vvgt_cli.transfer.tables import OpticalTables

if TYPE_CHECKING:
    from vvgt_cli.gaussians import Gaussians
    from vvgt_cli.metrics import Scores
    from vvgt_cli.scale.grid import CellGrid

PIXELS = 8192  # of a test view, about
JUDGED = 64  # blocks of pixels of a check view, at most
RAYS = 5  # a pixel of both
STEP, FIT_STEP = 0.5, 1.0  # voxels, as scores and training views in memory; a segment ends within a voxel of its block
SUFFIX = ".rays"
A_GAUSSIAN = 400  # bytes that drawing one takes
TEST, CHECK, TRAIN = "test", "check", "train"


class Box(NamedTuple):
    """A volume's half extents and voxel edges (3,), unit frame, as cameras ask for them."""

    half: np.ndarray
    step: np.ndarray


@dataclass(frozen=True)
class Sight:
    """Which views are marched.

    Attributes:
        size: pixels of the screen, of whose test views some pixels are.
        check: some blocks of its check views, too.
        train, edge: so many training views of so many pixels, whole.
    """

    size: int
    check: bool = False
    train: int = 0
    edge: int = 0


@dataclass(frozen=True)
class Look:
    """What of a view is marched.

    Attributes:
        kind: `TEST`, `CHECK` or `TRAIN`.
        camera: in the box frame.
        blocks: of the picture that hold the pixels, None for all.
        chosen: (n,) int64 places of the pixels in what `Blocks.pick` makes of a picture.
        pixels: (n, 2) int64 columns and rows.
        offsets: (m, 2) places of a pixel's rays, from its centre.
        step: between samples, voxels.
    """

    kind: str
    camera: Camera
    blocks: Blocks | None
    chosen: np.ndarray
    pixels: np.ndarray
    offsets: np.ndarray
    step: float = STEP

    def of(self, image: np.ndarray) -> np.ndarray:
        """The pixels (n, 1, c) of a picture (h, w, c)."""
        picked = image if self.blocks is None else self.blocks.pick(image)
        result: np.ndarray = picked.reshape(-1, 1, image.shape[2])[self.chosen]
        return result


@lru_cache(maxsize=1)
def looks(sight: Sight) -> tuple[Look, ...]:
    """All of them, test views first."""
    found, rays = [], ray_offsets(RAYS)
    for number in PREVIEW_VIEWS:
        camera = default_views("test", size=sight.size)[number]
        blocks = spread_blocks(camera.width, camera.height, number)
        places = _places(camera, blocks)
        every = max(len(places) // PIXELS, 1) | 1  # odd: in no step with the columns of a block of 16
        chosen = np.arange(number % every, len(places), every)
        found.append(Look(TEST, camera, blocks, chosen, places[chosen], rays))
    for number, camera in enumerate(default_views("check", size=sight.size) if sight.check else []):
        blocks = _some(spread_blocks(camera.width, camera.height, number), camera)
        places = _places(camera, blocks)
        found.append(Look(CHECK, camera, blocks, np.arange(len(places)), places, rays))
    cameras = default_views("train", sight.train, size=sight.edge) if sight.train else []
    if cameras:
        places, middle = _places(cameras[0], None), np.zeros((1, 2))
        every_pixel = np.arange(len(places))
        found += [Look(TRAIN, camera, None, every_pixel, places, middle, FIT_STEP) for camera in cameras]
    return tuple(found)


def _places(camera: Camera, blocks: Blocks | None) -> np.ndarray:
    """(n, 2) int64 columns and rows of the pixels of a picture, or of its blocks."""
    rows, columns = np.indices((camera.height, camera.width))
    places = np.stack([columns, rows], axis=-1)
    places = places if blocks is None else blocks.pick(places)
    return np.ascontiguousarray(places.reshape(-1, 2), np.int64)


def _some(blocks: Blocks | None, camera: Camera) -> Blocks:
    """At most `JUDGED` blocks of a picture, all over it."""
    across, down = camera.width // BLOCK, camera.height // BLOCK
    inside = np.arange(down)[:, None] * -(-camera.width // BLOCK) + np.arange(across)
    numbers = inside.ravel() if blocks is None else blocks.numbers
    few = np.unique(np.linspace(0, len(numbers) - 1, min(JUDGED, len(numbers))).astype(np.int64))
    return Blocks(camera.width, camera.height, numbers[few])


def segments(
    values: np.ndarray, begin: np.ndarray, number: int, grid: CellGrid, tables: OpticalTables, sight: Sight
) -> dict[str, np.ndarray]:
    """What block ``number`` shows of the rays of all `looks`; of look i "rays{i}" (m,) and "rgba{i}" (m, 4) float32.

    Args:
        values: the block with a voxel around it, as kernels read it.
        begin: (3,) its first voxel, (x, y, z).
        number, grid: which block.
        tables: optics over its values.
        sight: the views.
    """
    from vvgt_cli.dvr.bricks import empty_distance
    from vvgt_cli.dvr.segments import cast_segments
    from vvgt_cli.vbm.ranges import ranges_of

    edge = np.full(3, BRICK)
    ranges = ranges_of(values, np.zeros(3, np.int64), edge, -(-np.array(values.shape[::-1]) // edge))
    empty = empty_distance(ranges, tables)
    if empty.all():
        return {}
    lo, hi = grid.blocks.at(number)
    faces = np.stack([
        np.where(lo == 0, -np.inf, lo - 0.5), np.where(hi == grid.dims, np.inf, hi - 0.5), grid.dims.astype(np.float64)
    ])  # fmt: skip
    optics = Optics(tables.lo, tables.inv_width, tables.nodes, tables.cumulative, tables.dark)
    box = Box(np.array(grid.half), np.array(grid.step))
    found: dict[str, np.ndarray] = {}
    for n, look in enumerate(looks(sight)):
        camera = camera_arrays(box, look.camera)
        near = meeting(look, *camera, lo - 0.5, hi - 0.5)
        seen = np.zeros((len(near), len(look.offsets), 4), np.float32)
        cast_segments(
            Voxels(values), optics, empty, faces, begin.astype(np.float64), *camera, look.step, look.pixels[near],
            look.offsets, seen,
        )  # fmt: skip
        rays = np.flatnonzero(seen[..., 3])
        if len(rays):
            each = len(look.offsets)
            found[f"rays{n}"] = (near[rays // each] * each + rays % each).astype(np.int32)
            found[f"rgba{n}"] = seen.reshape(-1, 4)[rays]
    return found


def meeting(
    look: Look, eye: np.ndarray, basis: np.ndarray, lens: np.ndarray, lo: np.ndarray, hi: np.ndarray
) -> np.ndarray:
    """Places (n,) int64, ascending, of the pixels of a look that may meet the box from ``lo`` to ``hi`` (3,), voxels.

    ``eye``, ``basis``, ``lens`` as `camera_arrays` has them. Those within the rectangle around the picture of the
    box's corners; all, where a corner is not in front of the eye.
    """
    corners = np.array(list(itertools.product(*zip(lo, hi, strict=True))), np.float64) - eye
    across, down, ahead = np.linalg.solve(basis.T, corners.T)
    if ahead.min() <= 1e-6 * np.abs(ahead).max():
        return np.arange(len(look.pixels))
    edge = 1.0  # a pixel's own width, and what rounding moves
    x, y = across / ahead / lens[0] + lens[2] - 0.5, down / ahead / lens[1] + lens[3] - 0.5
    column, row = look.pixels.T
    inside = (column >= x.min() - edge) & (column <= x.max() + edge) & (row >= y.min() - edge) & (row <= y.max() + edge)
    result: np.ndarray = np.flatnonzero(inside)
    return result


def marched(parts: Parts, grid: CellGrid, sight: Sight, kind: str) -> Iterator[tuple[Look, np.ndarray]]:
    """The looks of a kind, each with its pixels (n, 1, 4) float32, premultiplied, from all blocks' segments.

    Raises:
        DataError: a part is missing or damaged.
    """
    box = Box(np.array(grid.half), np.array(grid.step))
    held = [parts.names(CELLS, number, SUFFIX) for number in range(len(grid.blocks))]
    for n, look in enumerate(looks(sight)):
        if look.kind != kind:
            continue
        color = np.zeros((len(look.pixels) * len(look.offsets), 3))
        through = np.ones(len(color))
        for number in front_to_back(grid, camera_arrays(box, look.camera)[0]):
            if f"rays{n}" not in held[number]:
                continue
            part = parts.load(CELLS, number, SUFFIX, (f"rays{n}", f"rgba{n}"))
            rays, rgba = part[f"rays{n}"], part[f"rgba{n}"]
            color[rays] += through[rays, None] * rgba[:, :3]
            through[rays] *= 1.0 - rgba[:, 3]
        whole = np.concatenate([color, 1 - through[:, None]], axis=1).reshape(-1, len(look.offsets), 4)
        yield look, whole.mean(axis=1, keepdims=True).astype(np.float32)


def front_to_back(grid: CellGrid, eye: np.ndarray) -> list[int]:
    """Numbers of the blocks so that of two that a ray from ``eye`` (3,), voxels, meets, the nearer comes first.

    Along a ray every index goes one way only, away from the eye's.
    """
    edge = np.array(grid.blocks.edge)
    own = np.floor((eye + 0.5) / edge)
    steps = [float(np.abs(grid.blocks.at(number)[0] // edge - own).sum()) for number in range(len(grid.blocks))]
    return [int(number) for number in np.argsort(steps, kind="stable")]


def score_gaussians(gaussians: Gaussians, parts: Parts, grid: CellGrid, size: int, rule: str | Rule = INRIA) -> Scores:
    """Gaussians of the box frame, drawn by a rule, against pixels of the volume's test views."""
    from vvgt_cli.metrics import score_views
    from vvgt_cli.splat import render

    tests = list(marched(parts, grid, Sight(size), TEST))
    drawn = (look.of(render(gaussians, look.camera, rule, blocks=look.blocks)) for look, _ in tests)
    return score_views([seen for _, seen in tests], drawn, perceptual=False)


def score_text(scores: Scores, size: int) -> str:
    """What there is to say of them."""
    from vvgt_cli.runs.score import psnr_note

    pixels = sum(len(look.pixels) for look in looks(Sight(size)))
    return f"{psnr_note(scores)}, {pixels} pixels of {scores.views} views of {size} px, through all voxels"


def drawing_bytes(gaussians: int, size: int) -> int:
    """Memory that scoring so many Gaussians takes."""
    return A_GAUSSIAN * gaussians + 2 * 16 * size**2
