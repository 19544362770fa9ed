"""Integer tables of the geometry transformer, in numpy: order, windows, pooling, neighbours (PTV3, Sec. 4).

They depend only on the positions of the Gaussians, not on learned values, so they are not part of the graphs.

Space-filling curves are codes of cells along a Z-order or a Hilbert curve (PTV3, Sec. 4.1), with twins in the tests.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vvgt_cli.gaussians.formats.splats import interleave
from vvgt_cli.network.config import STAGES, GeometryConfig

OFFSETS = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)])  # (27, 3)


@dataclass(frozen=True)
class StagePoints:
    """Points of one stage, in Z-order: at stage 0 Gaussians, later cells.

    Attributes:
        cells: (n, 3) int64 below 2^bits.
        bits: depth of the grid.
        positions: (n, 3) float32 mean position of the Gaussians within, unit frame.
        counts: (n,) int64 Gaussians within.
    """

    cells: np.ndarray
    bits: int
    positions: np.ndarray
    counts: np.ndarray


def block_curves(config: GeometryConfig) -> list[list[str]]:
    """Return the curves of blocks, i mod 4 for block i, in nine lists: encoder stages 0 to 4, decoder stages 3 to 0."""
    depths = [*config.depths, *config.decoder_depths[::-1]]
    curves, block = [], 0
    for depth in depths:
        curves.append([CURVES[(block + i) % len(CURVES)] for i in range(depth)])
        block += depth
    return curves


def bound(means: np.ndarray) -> float:
    """Return half the edge of the cube around the unit frame and all means (n, 3)."""
    return max(1.0, float(np.abs(means).max(initial=0)))


def quantise(means: np.ndarray, bound: float) -> np.ndarray:
    """Return cells (n, 3) int64 of the finest grid: 2^16 per axis over the cube of half edge ``bound``."""
    cells = np.floor((means.astype(np.float64) / bound + 1) * (1 << BITS - 1)).astype(np.int64)
    return np.clip(cells, 0, (1 << BITS) - 1)


def canonical_order(rows: np.ndarray) -> np.ndarray:
    """Return the permutation (K,) that sorts rows (K, n), mean first, along the Z-order; ties by all parameters.

    The result does not depend on the order of the rows (exact duplicates aside).
    """
    codes = interleave(quantise(rows[:, :3], bound(rows[:, :3])))
    order = np.argsort(codes, kind="stable")
    ordered = codes[order]
    tied = np.zeros(len(rows), bool)
    same = ordered[1:] == ordered[:-1]
    tied[1:] |= same
    tied[:-1] |= same
    if tied.any():
        some = order[tied]
        keys = [*(rows[some, i] for i in reversed(range(rows.shape[1]))), codes[some]]
        order[tied] = some[np.lexsort(keys)]
    return order


def pool(stage: StagePoints) -> tuple[StagePoints, np.ndarray]:
    """Return the next stage, the finest grid with at most half the points, and the parent (n,) of each point.

    PTV3 halves the resolution each time; the cells of the closed form have many sizes, and so may need more.
    """
    codes = interleave(stage.cells)
    target = max(len(codes) // 2, 1)
    bits = stage.bits if len(codes) > 1 else 0
    steps = codes[1:] ^ codes[:-1]  # sorted: a cell ends where the code above the shift changes
    while bits > 0:
        bits -= 1
        ends = steps >> 3 * (stage.bits - bits) != 0
        if np.count_nonzero(ends) + 1 <= target:
            break
    else:
        ends = np.zeros(len(steps), bool)
    first = np.concatenate([[0], np.flatnonzero(ends) + 1])
    parents = np.concatenate([[0], np.cumsum(ends)]).astype(np.int64)
    counts = np.add.reduceat(stage.counts, first)
    sums = np.add.reduceat(stage.positions.astype(np.float64) * stage.counts[:, None], first, axis=0)
    positions = (sums / counts[:, None]).astype(np.float32)
    return StagePoints(stage.cells[first] >> stage.bits - bits, bits, positions, counts), parents


def neighbours(stage: StagePoints) -> np.ndarray:
    """Return (n, 27) int64: the point in each of the cells around a point's own; n if there is none."""
    count, side = len(stage.cells), 1 << stage.bits
    codes = interleave(stage.cells)  # ascending and distinct
    table = np.full((count, 27), count, np.int64)
    own = np.arange(count)
    table[:, 13] = own
    for j in range(13):  # the other 13 are mirror images
        near = stage.cells + OFFSETS[j]
        inside = ((near >= 0) & (near < side)).all(axis=1)
        wanted = interleave(near[inside])
        place = np.minimum(np.searchsorted(codes, wanted), count - 1)
        hit = codes[place] == wanted
        points, others = own[inside][hit], place[hit]
        table[points, j] = others
        table[others, 26 - j] = points
    return table


def windows(order: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return windows along an order of n points: members (p, w) int64, and the slot (n,) that each point reads.

    The last window begins early if n is no multiple of ``size``: its first points attend twice and the slot takes the
    earlier result. Padding would need a mask.
    """
    n = len(order)
    width = min(size, n)
    count = -(-n // width)
    starts = np.minimum(np.arange(count) * width, n - width)
    members = order[starts[:, None] + np.arange(width)]  # (p, w)
    place = np.arange(n)
    slots = np.empty(n, np.int64)
    window = np.minimum(place // width, count - 1)
    slots[order] = window * width + place - starts[window]
    return members, slots


def build(means: np.ndarray, config: GeometryConfig, bound: float = 1.0) -> dict[str, np.ndarray]:
    """Return all tables of a scene.

    Args:
        means: (K, 3) float32, already in `canonical_order`.
        config: of the geometry side.
        bound: half the edge of the finest grid, `bound` of all rows that were ordered together.

    Returns:
        By name: ``positions`` (n, 3) float32 of the epipolar stage; ``parents_I`` (n_I,) into stage I + 1;
        ``neighbours_I`` (n_I, 27) for I from 1; ``windows_I_C`` and ``slots_I_C`` for each curve C that stage I uses.
    """
    stage = StagePoints(quantise(means, bound), BITS, means, np.ones(len(means), np.int64))
    wanted: list[list[str]] = [[] for _ in range(STAGES)]
    stages = [*range(STAGES), *reversed(range(STAGES - 1))]  # of the nine groups of blocks
    for number, curves in zip(stages, block_curves(config), strict=True):
        wanted[number] += [curve for curve in curves if curve not in wanted[number]]
    tables: dict[str, np.ndarray] = {}
    for i in range(STAGES):
        if i == config.epipolar_stage:
            tables["positions"] = stage.positions
        if i > 0:
            tables[f"neighbours_{i}"] = neighbours(stage)
        for curve in wanted[i]:
            # stable: equal codes keep the canonical order
            order = np.argsort(curve_code(stage.cells, max(stage.bits, 1), curve), kind="stable")
            tables[f"windows_{i}_{curve}"], tables[f"slots_{i}_{curve}"] = windows(order, config.window)
        if i < STAGES - 1:
            stage, tables[f"parents_{i}"] = pool(stage)
    return tables


BITS = 16  # an axis; three of them fit 48 bits of an int64
CURVES = ("z", "z-trans", "hilbert", "hilbert-trans")


def hilbert(cells: np.ndarray, bits: int) -> np.ndarray:
    """Return the Hilbert codes (n,) int64 of ``cells`` (n, 3) below 2^bits.

    Skilling, "Programming the Hilbert curve", AIP Conf. Proc. 707 (2004): undo the turns from the top bit down,
    then Gray-decode.
    """
    x = cells.astype(np.int64).T.copy()  # (3, n)
    for bit in range(bits - 1, 0, -1):
        below = (1 << bit) - 1
        for axis in range(3):
            invert = x[axis] >> bit & 1
            swap = (x[0] ^ x[axis]) & below & (invert - 1)  # all ones where the bit is clear
            x[0] ^= swap | (-invert & below)
            x[axis] ^= swap
    x[1] ^= x[0]
    x[2] ^= x[1]
    flips = np.zeros_like(x[0])
    for bit in range(bits - 1, 0, -1):
        flips ^= ((1 << bit) - 1) * (x[2] >> bit & 1)
    return interleave((x ^ flips).T)


def curve_code(cells: np.ndarray, bits: int, curve: str) -> np.ndarray:
    """Return codes (n,) int64 of ``cells`` (n, 3) below 2^bits along one of `CURVES`; "-trans" swaps two axes."""
    if curve.endswith("-trans"):
        cells = cells[:, (1, 0, 2)]
    return hilbert(cells, bits) if curve.startswith("hilbert") else interleave(cells)
