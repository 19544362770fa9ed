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
POINTS = 3  # a cell that views see
MOST_PATHS = 1 << 20
ERROR = 0.1  # of a cell's light, at which no more paths are begun
FIRST = 1  # paths of a point before others follow where they vary
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

    Rays from all around say which places views see, as often as they see them; paths from there bring light: two from
    each place, and more into cells where they differ.

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
    total, begun, own = np.zeros((len(points), 4)), np.zeros(len(points), np.int64), _nearest(at, grid)
    more, left = np.full(len(points), FIRST), MOST_PATHS
    while more.any() and left > 0:
        which = np.flatnonzero(more)
        last = begun + more
        total[which] += matter.gathered(sky, SEED, points[which], begun[which], last[which])[:, :4]
        left -= int(more.sum())
        begun = last
        more = np.where(_uncertain(total, begun, own, math.prod(grid)), begun, 0)
        more = np.minimum(more, left // max(int(np.count_nonzero(more)), 1))
    light = _filtered(at, total, begun, grid)
    return np.ascontiguousarray(light.transpose(3, 0, 1, 2) ** (1 / GAMMA), np.float32)


def _seen(matter: Scattering, grid: Sequence[int], cell: int) -> tuple[np.ndarray, np.ndarray]:
    """Return places (n, 6) that views see, as `paths._gather` takes them, and their coordinates (n, 3) in the grid."""
    rng, found, cells, cast = np.random.default_rng(SEED), [np.empty((0, 6))], np.zeros(math.prod(grid), bool), 0
    count, at = 0, [np.empty((0, 3))]
    while cast < MOST_RAYS and count < MOST_PATHS // FIRST:
        rays = lines(matter.voxels.values.shape, matter.step, RAYS, rng)
        some = matter.scattered(rays, SEED + cast)[:, :6]
        cast += RAYS
        here = ((some[:, :3] + 0.5) * matter.cell) / cell - 0.5
        cells[_nearest(here, grid)] = True
        found.append(some)
        at.append(here)
        count += len(some)
        if count >= POINTS * np.count_nonzero(cells):
            break
    return np.concatenate(found), np.concatenate(at)


def _nearest(at: np.ndarray, grid: Sequence[int]) -> np.ndarray:
    """Return the numbers (n,) of the cells that coordinates (n, 3) lie in."""
    x, y, z = np.clip(np.round(at).astype(np.int64), 0, np.array(grid[::-1]) - 1).T
    numbers: np.ndarray = (z * grid[1] + y) * grid[2] + x
    return numbers


def _uncertain(total: np.ndarray, begun: np.ndarray, own: np.ndarray, cells: int) -> np.ndarray:
    """Return which points (n,) lie in cells whose light is uncertain by more than `ERROR`."""
    paths = np.bincount(own, begun, cells)[own]
    mean = np.bincount(own, total[:, :3].mean(axis=1), cells)[own] / paths
    square = np.bincount(own, total[:, 3], cells)[own] / paths
    uncertain: np.ndarray = (square - mean**2) / np.maximum(paths - 1, 1) > (ERROR * mean) ** 2
    return uncertain


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
    paths = np.maximum(sums[4], 1e-9)
    mean = (sums[:3] / paths).T
    if size <= 8:
        whole = total[:, :3].sum(axis=0) / begun.sum()
        out: np.ndarray = np.where((sums[4] > 0)[:, None], mean, whole)
        return out.reshape(*grid, 3)
    half = tuple(-(-n // 2) for n in grid)
    coarse = _filtered((at + 0.5) / 2 - 0.5, total, begun, half)
    z, y, x = np.indices(grid).reshape(3, -1)
    below, places = np.zeros((size, 3)), np.stack([x, y, z], axis=1) / 2 - 0.25
    for (i, j, k), weight in corners(places, half[::-1]):
        below += weight[:, None] * coarse[k, j, i]
    noise = np.maximum(sums[3] / paths - mean.mean(axis=1) ** 2, 0) * sums[5] / paths**2
    differs = (mean.mean(axis=1) - below.mean(axis=1)) ** 2
    share = np.where(sums[4] > 0, differs / np.maximum(differs + 2 * noise, 1e-30), 0)
    out = below + share[:, None] * (mean - below)
    return out.reshape(*grid, 3)
