"""Light along traced paths (docs/light.md): what arrives where views see matter, on a grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from vvgt_cli.dvr.layout import Optics, Texels, Voxels, corners
from vvgt_cli.dvr.sky import Sky

DENSEST = 64.0  # optical depth a voxel: denser matter is as opaque, and would take as many steps more
RAYS = 1 << 18  # that are cast at once
MOST_RAYS = 1 << 23
POINTS = 16  # a cell that views see
MOST_PATHS = 1 << 20
TRIES = 8  # times that a ray is cast, to find where it is scattered
FAINTEST = 1e-3  # colour of a ray, in [0, 1], below which nobody sees what it loses
SEED = 1


@dataclass(frozen=True)
class Scattering:
    """Matter that scatters light, as the kernels of `paths` take it.

    Attributes:
        voxels, optics, texels, empty, step: as of `Scene`; ``texels`` None: colours are those of ``optics``.
        cell: voxels of the scene along the edge of one of these.
        phase: mean cosine of Henyey and Greenstein's phase function.
    """

    voxels: Voxels
    optics: Optics
    texels: Texels | None
    empty: np.ndarray
    step: np.ndarray
    cell: int = 1
    phase: float = 0.0
    limit: float = field(init=False)
    most: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        """Find the largest extinction of each brick."""
        object.__setattr__(self, "limit", DENSEST / float(self.step.min()))
        object.__setattr__(self, "most", _largest(self.voxels.values, self.optics, self.limit))

    def scattered(self, rays: np.ndarray, seed: int) -> np.ndarray:
        """Return places in voxels and directions (n, 6) of the first scatterings of rays (m, 6), and which rays' (n,).

        Returned as one array (n, 7), the ray's number last.
        """
        from vvgt_cli.dvr.paths import first_scatterings

        out = np.empty((len(rays), 3))
        first_scatterings(self.voxels, self.optics, self.empty, self.most, self.limit, self.step, seed, rays, out)
        which = np.flatnonzero(np.isfinite(out[:, 0]))
        return np.concatenate([out[which], rays[which, 3:], which[:, None]], axis=1)

    def gathered(self, sky: Sky, seed: int, points: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Return what `paths._gather` adds up at points (n, 6), (n, 7)."""
        from vvgt_cli.dvr import paths

        out, points = np.zeros((len(points), 7)), np.ascontiguousarray(points)
        rest = (self.empty, self.most, self.limit, self.step, sky, self.phase, seed, points, first, last, out)
        if self.texels is None:
            paths.gather(self.voxels, self.optics, None, *rest)
        else:
            paths.gather_grid(self.voxels, self.optics, self.texels, *rest)
        return out


def _largest(values: np.ndarray, optics: Optics, limit: float) -> np.ndarray:
    """Return the largest extinction of each brick, (bz, by, bx)."""
    from vvgt_cli.dvr.bricks import brick_ranges

    ranges = brick_ranges(values)
    none = ranges[..., 1] < ranges[..., 0]
    u = optics.coordinate(np.where(none[..., None], optics.lo, ranges))
    first, last = np.floor(u.min(axis=-1)).astype(np.int64), np.ceil(u.max(axis=-1)).astype(np.int64)
    levels = [optics.nodes[:, 3]]  # the largest of 1, 2, 4, ... nodes from each on
    while 2 << (len(levels) - 1) <= len(levels[0]):
        half = 1 << (len(levels) - 1)
        levels.append(np.maximum(levels[-1][:-half], levels[-1][half:]))
    depth = np.log2(last - first + 1).astype(np.int64)
    out = np.zeros(first.shape)
    for level, table in enumerate(levels):
        here = (depth == level) & ~none
        out[here] = np.maximum(table[first[here]], table[last[here] + 1 - (1 << level)])
    return np.minimum(out, limit)


def lines(shape: Sequence[int], step: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return rays (count, 6) into a box of voxels (z, y, x), spread evenly over all lines that meet it."""
    dims = np.array(shape[::-1], np.float64)
    edges = dims * step
    area = np.array([edges[1] * edges[2], edges[2] * edges[0], edges[0] * edges[1]])
    axis, side = rng.choice(3, count, p=area / area.sum()), rng.integers(0, 2, count)
    place, rows = rng.random((count, 3)), np.arange(count)
    place[rows, axis] = side
    cosine, turn = np.sqrt(rng.random(count)), 2 * math.pi * rng.random(count)
    across, along = np.sqrt(1 - cosine**2), np.empty((count, 3))
    along[rows, axis] = np.where(side == 0, cosine, -cosine)
    along[rows, (axis + 1) % 3], along[rows, (axis + 2) % 3] = across * np.cos(turn), across * np.sin(turn)
    return np.concatenate([place * dims - 0.5, along], axis=1)


def light_grid(matter: Scattering, sky: Sky, shape: Sequence[int], cell: int) -> np.ndarray:
    """Return the light that views see matter in, (3, cz, cy, cx) float32, to the power that colours are in.

    Rays from all around say which places views see, as often as they see them, and a path from each brings light, whose
    mean a cell takes. Views add up colours to the power of 1 / `GAMMA`, and are darker than the light along a ray where
    it or the matter's colour varies. Cells are made brighter by as much as the rays that see them lose.

    Args:
        matter: what scatters.
        sky: where light comes from.
        shape: voxels (z, y, x) of the scene.
        cell: voxels along the edge of a cell.
    """
    from vvgt_cli.dvr.paths import GAMMA

    grid = tuple(-(-n // cell) for n in shape)
    points, at = _seen(matter, grid, cell)
    if not len(points):
        return np.ones((3, *grid), np.float32)
    one = np.ones(len(points), np.int64)
    paths = matter.gathered(sky, SEED, points[:, :6], 0 * one, one)
    light = _filtered(at, paths[:, :4], one, grid)
    light *= _gain(points[:, 6], at, paths, light)
    return np.ascontiguousarray(light.transpose(3, 0, 1, 2) ** (1 / GAMMA), np.float32)


def _gain(rays: np.ndarray, at: np.ndarray, paths: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return the factor (cz, cy, cx, 3) that makes views as bright as the light along their rays.

    Along each ray, the light that paths bring is averaged as light is, and the light of the grid as views add it up. A
    cell takes the ratio of the rays that are scattered in it. The power of a mean over few places is too large, by a
    term in its variance, which is taken off.

    Args:
        rays: numbers (n,) of the rays that see the places.
        at: the places' coordinates (n, 3) in the grid.
        paths: of `Scattering.gathered`, one a place.
        light: what the grid holds, linear.
    """
    from vvgt_cli.dvr.paths import GAMMA

    grid = light.shape[:3]
    _, ray, count = np.unique(rays, return_inverse=True, return_counts=True)
    places = count[ray, None]

    def along_ray(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(ray, column)[ray] for column in values.T], axis=1) / places

    here = sum(weight[:, None] * light[z, y, x] for (x, y, z), weight in corners(at, grid[::-1]))
    color = (paths[:, 4:] * here) ** (1 / GAMMA)
    shown = np.maximum(along_ray(color), FAINTEST)
    variance = np.maximum(along_ray(color**2) / shown**2 - 1, 0) / np.maximum(places - 1, 1)
    added = shown**GAMMA * (1 - np.minimum(GAMMA * (GAMMA - 1) / 2 * variance, 0.5))
    ratio = np.where(shown > FAINTEST, along_ray(paths[:, 4:] * paths[:, :3]) / added, 1)
    weight = (color * added).mean(axis=1) * (count[ray] > 1) + 1e-9
    weight /= TRIES * weight.mean()
    return _filtered(at, np.column_stack([ratio, ratio.mean(axis=1) ** 2]) * weight[:, None], weight, grid)


def _seen(matter: Scattering, grid: Sequence[int], cell: int) -> tuple[np.ndarray, np.ndarray]:
    """Return places (n, 7) that views see, as of `Scattering.scattered`, and their coordinates (n, 3) in the grid."""
    rng, found, cells, count = np.random.default_rng(SEED), [np.empty((0, 7))], np.zeros(math.prod(grid), bool), 0
    at, cast, rays = [np.empty((0, 3))], 0, RAYS // TRIES
    while cast < MOST_RAYS and count < MOST_PATHS:
        some = matter.scattered(
            np.tile(lines(matter.voxels.values.shape, matter.step, rays, rng), (TRIES, 1)), SEED + cast
        )
        some[:, 6] = some[:, 6] % rays + cast
        cast += RAYS
        here = ((some[:, :3] + 0.5) * matter.cell) / cell - 0.5
        x, y, z = np.clip(np.round(here).astype(np.int64), 0, np.array(grid[::-1]) - 1).T
        cells[(z * grid[1] + y) * grid[2] + x] = True
        found.append(some)
        at.append(here)
        count += len(some)
        if count >= POINTS * np.count_nonzero(cells):
            break
    return np.concatenate(found), np.concatenate(at)


def _filtered(at: np.ndarray, total: np.ndarray, begun: np.ndarray, grid: Sequence[int]) -> np.ndarray:
    """Return light (cz, cy, cx, 3) at the nodes of a grid, from sums of paths at coordinates ``at`` (n, 3).

    Each node takes the mean of the paths around it, weighed as the grid is interpolated, and where they are few and
    vary, that of a grid half as fine.
    """
    size = math.prod(grid)
    sums = np.zeros((6, size))
    for (x, y, z), weight in corners(at, grid[::-1]):
        node = (z * grid[1] + y) * grid[2] + x
        for row, part in zip(sums, (*total.T, begun, begun * weight), strict=True):
            row += np.bincount(node, part * weight, size)
    return np.moveaxis(_means(sums.reshape(6, *grid)), 0, -1)


def _means(sums: np.ndarray) -> np.ndarray:
    """Return means (3, cz, cy, cx) of sums (6, cz, cy, cx) of paths, their squares, number and squared weights.

    On coarser grids the last counts a path that is shared by nodes as several: these are trusted more.
    """
    paths = np.maximum(sums[4], 1e-30)
    mean = sums[:3] / paths
    if sums[0].size <= 8:
        whole = (sums[:3].sum(axis=(1, 2, 3)) / sums[4].sum())[:, None, None, None]
        return np.where(sums[4] > 0, mean, whole)
    half = sums
    for axis in (1, 2, 3):
        half = np.concatenate([_halved(half[:5], axis, 0.75, 0.25), _halved(half[5:], axis, 0.5625, 0.0625)])
    below = _means(half)
    for axis in (1, 2, 3):
        below = _doubled(below, axis, sums.shape[axis])
    differs = (mean.mean(axis=0) - below.mean(axis=0)) ** 2  # a single path has no variance of its own
    noise = (np.maximum(sums[3] / paths - mean.mean(axis=0) ** 2, 0) + differs) * sums[5] / paths**2
    share = np.where(sums[4] > 0, differs / np.maximum(differs + 2 * noise, 1e-30), 0)
    below += share * (mean - below)
    return below


def _halved(fine: np.ndarray, axis: int, near: float, far: float) -> np.ndarray:
    """Return sums at every second node along an axis, gathered from all nodes by the weights of interpolation."""
    fine = np.moveaxis(fine, axis, 0)
    even, odd = fine[::2], fine[1::2]
    out = near * even
    out[: len(odd)] += near * odd
    out[:-1] += far * even[1:]
    out[0] += far * even[0]
    out[1:] += far * odd[: len(out) - 1]
    if len(odd) == len(out):
        out[-1] += far * odd[-1]
    return np.moveaxis(out, 0, axis)


def _doubled(coarse: np.ndarray, axis: int, count: int) -> np.ndarray:
    """Return values at ``count`` nodes along an axis, interpolated from every second node."""
    coarse = np.moveaxis(coarse, axis, 0)
    edged = np.concatenate([coarse[:1], coarse, coarse[-1:]])
    out = np.empty((2 * len(coarse), *coarse.shape[1:]))
    out[::2] = 0.75 * coarse + 0.25 * edged[:-2]
    out[1::2] = 0.75 * coarse + 0.25 * edged[2:]
    return np.moveaxis(out[:count], 0, axis)
