"""Optical moments of base cells: a streaming reduction of the volume, brick by brick.

A base cell is a box of ``2^e`` voxels along each axis (e may be negative). Its moments are integrals of the extinction
``tau(trilinear(scalar))`` by midpoint quadrature, each point averaged over the scalar's spread within its own box
(so that a step function needs no finer points). A cell of whole voxels takes one point for eight if the function is
straight over its values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vvgt_cli.closed_form.cell_kernels import morton_codes
from vvgt_cli.closed_form.columns import MASS, MOMENTS
from vvgt_cli.closed_form.quadrature import block_moments, compact, grid_moments
from vvgt_cli.dvr.bricks import visible_blocks
from vvgt_cli.dvr.layout import BRICK, Optics, Texels, Voxels
from vvgt_cli.dvr.scene import Scene

FINEST_CUT = -4
POINTS = 2  # of quadrature a voxel and axis
WIDE = 1  # exponent of cells under whose voxels it is asked where the function is straight
CHUNK_CELLS, CHUNK_BLOCKS = 1 << 17, 16  # cells of the dense scratch buffer; blocks at least
MAX_CELLS = 32  # along the edge of a block that is made a cube of cells
BEND = 0.03  # of the extinction, by which a straight line may miss it; smooth bends miss their mean by a sixth of that
_last: tuple[np.ndarray, float, np.ndarray] | None = None  # nodes, bend and what came of them: blocks ask again


@dataclass(frozen=True)
class Cells:
    """Base cells with extinction, in Morton order.

    Attributes:
        index: (n, 3) int32 cell indices (x, y, z) from the box's corner.
        moments: (n, 13) float64 integrals of tau over the cell by `columns` (unit-frame lengths: the mass is an area).
        edge: (3,) cell edge in unit-frame lengths (x, y, z).
        exponent: (3,) int cell edge in voxels = 2^exponent.
        normals: (n, 3) float64 at their centroids, where light asks for them and the volume is not in memory.
    """

    index: np.ndarray
    moments: np.ndarray
    edge: np.ndarray
    exponent: np.ndarray
    normals: np.ndarray | None = None


def exponents(step: np.ndarray, level: int) -> np.ndarray:
    """Return per-axis exponents of cells of about ``2^level`` x the finest voxel edge, as cubic as powers of two allow.

    No voxel is cut into more than ``2^-FINEST_CUT`` along an axis: trilinear matter has nothing to show below that.
    """
    target = float(step.min()) * 2.0**level
    return np.maximum(np.round(np.log2(target / step)), FINEST_CUT).astype(np.int64)


def morton(index: np.ndarray) -> np.ndarray:
    """Return (n,) uint64 Morton codes of (n, 3) cell indices below 2^21, x lowest."""
    out = np.empty(len(index), np.uint64)
    morton_codes(np.ascontiguousarray(index, np.int32), out)
    return out


def base_cells(
    scene: Scene, exponent: np.ndarray, points_per_voxel: int = POINTS, progress: Callable[[float], None] | None = None
) -> Cells:
    """Integrate the moments of every base cell with extinction (see `Cells`) in a fixed scratch beside the result.

    ``progress`` is called with the completed share.
    """
    block, _ = blocks(exponent)
    shape = -(-np.array(scene.values.shape[::-1]) // block)
    origins = visible_blocks(scene.values, np.zeros(3), block, shape, scene.optics) * block
    index, moments = region_cells(Region.whole(scene), origins, exponent, points_per_voxel, progress)
    return Cells(index, moments, 2.0**exponent * scene.step, exponent)


@dataclass(frozen=True)
class Region:
    """Voxels of a volume, or of a part of it with a margin of one voxel towards the rest.

    Attributes:
        voxels, optics: as kernels take them.
        half, step: (3,) of the whole volume, as `Scene` has them.
        begin: (3,) float64 voxel of the whole volume that ``voxels`` begin with, (x, y, z).
        texels: of an optics grid.
    """

    voxels: Voxels
    optics: Optics
    half: np.ndarray
    step: np.ndarray
    begin: np.ndarray
    texels: Texels | None = None

    @classmethod
    def whole(cls, scene: Scene) -> Region:
        """Return the region of a whole scene."""
        texels = None if scene.grid is None else scene.texels
        return cls(scene.voxels, scene.optics, np.asarray(scene.half), np.asarray(scene.step), np.zeros(3), texels)


def region_cells(
    region: Region,
    origins: np.ndarray,
    exponent: np.ndarray,
    points_per_voxel: int = POINTS,
    progress: Callable[[float], None] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return cells with extinction in `blocks` at ``origins`` (n, 3), voxels (x, y, z) of the whole volume.

    Returns:
        Indices (m, 3) int32 and moments (m, 13), as in `Cells`: the same bytes whatever part of the volume is there.
    """
    cell = 2.0**exponent
    block, cells = blocks(exponent)
    points = np.maximum(np.round(cell * points_per_voxel), min(points_per_voxel, 2)).astype(np.int64)
    whole = region.texels is None and exponent.min() >= WIDE and points_per_voxel == POINTS
    origins = origins[np.argsort(morton(origins // block))]
    chunk = max(int(CHUNK_CELLS // cells.prod()), CHUNK_BLOCKS)
    scratch = np.empty((min(chunk, max(len(origins), 1)), *cells[::-1], MOMENTS))
    order = np.argsort(morton(np.argwhere(np.ones(cells[::-1]))[:, ::-1]))
    moments, index = np.empty((0, MOMENTS)), [np.empty((0, 3), np.int32)]
    for first in range(0, len(origins), chunk):
        part = origins[first : first + chunk]
        dense = scratch[: len(part)]
        at = part - region.begin
        if whole:
            _integrate_voxels(region, at, exponent, dense)
        else:
            _integrate(region, at, points, cell, dense)
        counts = np.count_nonzero(dense[..., MASS].reshape(len(part), -1), axis=1)
        done, local = len(moments), np.empty((counts.sum(), 3), np.int32)
        moments.resize((done + len(local), MOMENTS), refcheck=False)  # moves no bytes where the system can remap them
        compact(dense, order, np.cumsum(counts) - counts, moments[done:], local)
        index.append(local + np.repeat(np.round(part / cell).astype(np.int32), counts, axis=0))
        if progress:
            progress(min(first + chunk, len(origins)) / len(origins))
    del scratch
    whole = np.concatenate(index)
    codes = morton(whole)
    if (codes[1:] > codes[:-1]).all():
        return whole, moments
    along = np.argsort(codes, kind="stable")
    return whole[along], moments[along]


def _integrate(region: Region, at: np.ndarray, points: np.ndarray, cell: np.ndarray, out: np.ndarray) -> None:
    """Compute `block_moments` by the kernel of the region's kind."""
    kernel = block_moments if region.texels is None else grid_moments
    scene = region.voxels, region.optics, region.texels
    kernel(*scene, at, points, cell, region.half, region.step, region.begin, out)


def _integrate_voxels(region: Region, at: np.ndarray, exponent: np.ndarray, out: np.ndarray) -> None:
    """Compute `block_moments` of cells of whole voxels, two points a voxel and axis or the equivalent."""
    from vvgt_cli.closed_form.voxelwise import voxel_moments

    linear_until = linear_ranges(region.optics)
    voxel_moments(
        region.voxels, region.optics, linear_until, at, exponent, region.half, region.step, region.begin, out
    )  # fmt: skip


def blocks(exponent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return edges of a block in voxels and in cells, (3,): as many cells along each axis, where that is not too many.

    Such blocks, taken in Morton order, leave cells in Morton order.
    """
    cell = 2.0**exponent
    cells = np.round(np.maximum(BRICK, cell) / cell).astype(np.int64)
    if cells.max() <= MAX_CELLS:
        cells[:] = cells.max()
    return np.round(cells * cell).astype(np.int64), cells


# offsets (x, y, z) of a cell's children, x fastest
CHILDREN = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.int32)


def cell_moments(scene: Scene, corners: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Return moments (n, 8, 13) of children of cells of ``edge`` (3,) voxels at ``corners`` (n, 3), voxels."""
    child = edge / 2
    points = np.maximum(np.round(child * 2), 2).astype(np.int64)
    out = np.empty((len(corners), 2, 2, 2, MOMENTS))
    at = np.ascontiguousarray(corners, np.float64)
    _integrate(Region.whole(scene), at, points, child, out)
    return out.reshape(len(corners), 8, MOMENTS)


def linear_ranges(optics: Optics) -> np.ndarray:
    """Return the u (n + 1,) float64 up to which the optics are linear from bin i on.

    Within a window of bins, the slopes of tau and tau * (r, g, b) may differ by 4 `BEND` times the smallest slope of
    tau (all of one sign), or so little that what adds up is within 4 `BEND` of the smallest tau. So a part of a
    straight window is straight.
    """
    global _last
    bend = BEND
    if _last is not None and _last[0] is optics.nodes and _last[1] == bend:
        return _last[2]
    slopes = np.diff(optics.nodes, axis=0)
    count = len(slopes)
    levels = [(slopes.T, slopes.T, np.minimum(optics.nodes[:-1, 3], optics.nodes[1:, 3]))]
    while 2 << len(levels) - 1 <= count:  # of windows twice as long each
        low, high, least = levels[-1]
        half = 1 << len(levels) - 1
        levels.append((
            np.minimum(low[:, :-half], low[:, half:]), np.maximum(high[:, :-half], high[:, half:]),
            np.minimum(least[:-half], least[half:]),
        ))  # fmt: skip
    at = np.arange(count)
    low, high, least = np.full((4, count), np.inf), np.full((4, count), -np.inf), np.full(count, np.inf)
    for k in range(len(levels) - 1, -1, -1):  # the longest window, bit by bit
        wide, length = levels[k], 1 << k
        fits = np.flatnonzero(at + length <= count)
        start = at[fits]
        more = (
            np.minimum(low[:, fits], wide[0][:, start]), np.maximum(high[:, fits], wide[1][:, start]),
            np.minimum(least[fits], wide[2][start]),
        )  # fmt: skip
        rises = np.maximum(np.maximum(more[0][3], -more[1][3]), 0)
        allowed = 4 * bend * np.maximum(rises, more[2] / (start + length - fits)) + 1e-12 * np.abs(slopes).max()
        good = ((more[1] - more[0]) <= allowed).all(axis=0)
        took = fits[good]
        low[:, took], high[:, took], least[took] = more[0][:, good], more[1][:, good], more[2][good]
        at[took] += length
    out = np.append(at, count).astype(np.float64)
    _last = optics.nodes, bend, out
    return out
