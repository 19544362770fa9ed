"""Numba kernels of the splatter's first half: projection and tile lists. Twin: `splat.reference`.

Arrays of K Gaussians: ``means`` (K, 3), ``log_scales`` (K, 3), ``quats`` (K, 4), ``logits`` (K,), ``factors`` (K, 3,
3), all float32, unit frame. The camera, float64: ``rot`` (3, 3) and ``trans`` (3,) world to camera, ``lens`` (6,) fx,
fy, cx, cy, width, height, pixels. ``rule`` (5,) float64 from `Rule.projecting`. Per Gaussian: ``flat`` (K, 7) float32
centre x, y (px), conic a, b, c (px^-2), opacity as drawn and as given; ``depth`` (K,) float32, unit frame; ``extent``
(K, 4) int32 pixel box x0, y0, x1, y1, empty where nothing is seen.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vvgt_cli.gaussians.constants import TILE
from vvgt_cli.jit.decorators import inlined, kernel, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations
from vvgt_cli.splat.buffer import prefetch
from vvgt_cli.splat.lanes import (
    LANES,
    OPACITY,
    PROJECTED,
    U,
    boxes,
    load_place,
    pose_of,
    project_lanes,
    put_column,
    store_projected,
)

_jit = inlined()
SHIFT = TILE.bit_length() - 1
AHEAD = 16  # Gaussians whose boxes are asked for before they are read: in the order of depth they lie far apart


@_jit
def unit_quaternion(quats: np.ndarray, k: int) -> tuple[float, ...]:
    """Return row k of ``quats`` (K, 4) divided by its norm, and 1 / norm, float64."""
    w, a, b, c = np.float64(quats[k, 0]), np.float64(quats[k, 1]), np.float64(quats[k, 2]), np.float64(quats[k, 3])
    n = 1.0 / math.sqrt(w * w + a * a + b * b + c * c)
    return w * n, a * n, b * n, c * n, n


@_jit
def rotation_column(w: float, a: float, b: float, c: float, axis: int) -> tuple[float, float, float]:
    """Return column ``axis`` of the rotation matrix of a unit quaternion."""
    if axis == 0:
        return 1 - 2 * (b * b + c * c), 2 * (a * b + w * c), 2 * (a * c - w * b)
    if axis == 1:
        return 2 * (a * b - w * c), 1 - 2 * (a * a + c * c), 2 * (b * c + w * a)
    return 2 * (a * c + w * b), 2 * (b * c - w * a), 1 - 2 * (a * a + b * b)


@_jit
def _opacity(logits: np.ndarray, k: int) -> float:
    """Return the sigmoid of ``logits`` (K,) of Gaussian k, float64."""
    return 1.0 / (1.0 + math.exp(-np.float64(logits[k])))


def _project(
    thread: ThreadSlice, means: np.ndarray, factors: np.ndarray | None, log_scales: Any, quats: Any,
    logits: np.ndarray, rot: np.ndarray, trans: np.ndarray, lens: np.ndarray, rule: np.ndarray, flat: np.ndarray,
    depth: np.ndarray, extent: np.ndarray,
) -> None:  # fmt: skip
    """Project every Gaussian by EWA into ``flat``, ``depth`` and ``extent``: every row is written.

    Covariances are ``M M^T`` with ``factors`` (K, 3, 3) M; where these are None, of ``log_scales`` and ``quats``.
    """
    total, pose = means.shape[0], pose_of(rot, trans)
    fx, fy, cx, cy, width, height = lens
    dilation, compensate, min_alpha, farthest, min_variance = rule
    way = dilation, compensate, min_alpha, farthest, min_variance
    for chunk in iterations(thread, (total + LANES - 1) // LANES):
        begin = chunk * LANES
        count = min(LANES, total - begin)
        buf = np.zeros(PROJECTED * LANES)
        for i in range(count):
            k, j = begin + i, U(i)
            if quats is not None:  # numba leaves out what is of None, not what is of the others
                buf[j], buf[j + U(LANES)], buf[j + U(2 * LANES)] = means[k, 0], means[k, 1], means[k, 2]
                w, a, b, c, _ = unit_quaternion(quats, k)
                put_column(buf, j, 0, rotation_column(w, a, b, c, 0), math.exp(np.float64(log_scales[k, 0])))
                put_column(buf, j, 1, rotation_column(w, a, b, c, 1), math.exp(np.float64(log_scales[k, 1])))
                put_column(buf, j, 2, rotation_column(w, a, b, c, 2), math.exp(np.float64(log_scales[k, 2])))
            if factors is not None:
                load_place(buf, j, k, means, factors)
            buf[j + OPACITY] = _opacity(logits, k)
        project_lanes(buf, pose, (fx, fy, cx, cy), way)
        boxes(buf, farthest, width, height)
        store_projected(buf, begin, count, flat, depth, extent)


_VIEW = "f4:1 f8:2 f8:1 f8:1 f8:1 f4:2 f4:1 i4:2"
project = parallel_kernel(f"f4:2 none f4:2 f4:2 {_VIEW}", name="project")(_project)
project_factors = parallel_kernel(f"f4:2 f4:3 none none {_VIEW}", name="project_factors")(_project)


@_jit
def tiles_of(extent: np.ndarray, k: int) -> tuple[int, int, int, int]:
    """Return the tiles that Gaussian k lies in: first column and row, and their ends; none where it is unseen."""
    if extent[k, 2] <= extent[k, 0]:
        return 0, 0, 0, 0
    x1, y1 = ((extent[k, 2] - 1) >> SHIFT) + 1, ((extent[k, 3] - 1) >> SHIFT) + 1
    return extent[k, 0] >> SHIFT, extent[k, 1] >> SHIFT, x1, y1


@kernel("u4:1")
def stable_order(keys: np.ndarray) -> np.ndarray:
    """Order (K,) int64 that sorts ``keys`` (K,) uint32, equal ones as they come (radix sort, 11 bits a pass)."""
    begin = np.zeros((3, 1 << 11), np.int64)
    for key in keys:
        begin[0, key & 0x7FF] += 1
        begin[1, (key >> 11) & 0x7FF] += 1
        begin[2, key >> 22] += 1
    for digit in range(3):
        place = 0
        for value in range(1 << 11):
            count = begin[digit, value]
            begin[digit, value] = place
            place += count
    rows, more = np.empty(len(keys), np.uint64), np.empty(len(keys), np.uint64)  # key and number
    for k in range(len(keys)):
        value = keys[k] & 0x7FF
        rows[begin[0, value]] = np.uint64(keys[k]) << np.uint64(32) | np.uint64(k)
        begin[0, value] += 1
    for row in rows:
        middle = row >> np.uint64(43) & np.uint64(0x7FF)
        more[begin[1, middle]] = row
        begin[1, middle] += 1
    order = np.empty(len(keys), np.int64)
    for row in more:
        top = row >> np.uint64(54)
        order[begin[2, top]] = row & np.uint64(0xFFFFFFFF)
        begin[2, top] += 1
    return order


@parallel_kernel("i8:1 i4:2 i8 i8:2 i8:1")
def count_pairs(
    thread: ThreadSlice, order: np.ndarray, extent: np.ndarray, tiles_x: int, fill: np.ndarray, first: np.ndarray
) -> None:
    """Count the Gaussians of each stretch of ``order`` in each tile: ``fill`` (stretches, tiles), zeros before.

    ``first`` (K + 1,), zeros, gets in how many tiles each Gaussian lies, at the place behind its own.
    """
    workers, total = fill.shape[0], order.shape[0]
    for worker in iterations(thread, workers):
        mine = fill[worker]
        for index in range(worker * total // workers, (worker + 1) * total // workers):
            k = order[index]
            prefetch(extent, order[min(index + AHEAD, total - 1)], 0)
            x0, y0, x1, y1 = tiles_of(extent, k)
            first[k + 1] = (x1 - x0) * (y1 - y0)
            for ty in range(y0, y1):
                for tx in range(x0, x1):
                    mine[U(ty * tiles_x + tx)] += 1


@parallel_kernel("i8:1 i4:2 i8 i8:2 i8:1 i4:1 i8:1")
def file_pairs(
    thread: ThreadSlice, order: np.ndarray, extent: np.ndarray, tiles_x: int, fill: np.ndarray, first: np.ndarray,
    members: np.ndarray, slots: np.ndarray,
) -> None:  # fmt: skip
    """Fill ``members`` and ``slots`` of `tile_lists` from each stretch's first place in each tile, ``fill``."""
    workers, total = fill.shape[0], order.shape[0]
    for worker in iterations(thread, workers):
        mine = fill[worker]
        for index in range(worker * total // workers, (worker + 1) * total // workers):
            k = order[index]
            prefetch(extent, order[min(index + AHEAD, total - 1)], 0)
            slot = first[k]
            x0, y0, x1, y1 = tiles_of(extent, k)
            for ty in range(y0, y1):
                for tx in range(x0, x1):
                    place = mine[U(ty * tiles_x + tx)]
                    members[U(place)], slots[U(place)] = k, slot
                    mine[U(ty * tiles_x + tx)] = place + 1
                    slot += 1


@kernel("i8:2 i8:1 i8:1")
def sum_pairs(fill: np.ndarray, first: np.ndarray, start: np.ndarray) -> None:
    """Turn counts of `count_pairs` into places: ``fill`` and ``first`` in place, ``start`` (tiles + 1,) is filled."""
    pairs = 0
    for tile in range(fill.shape[1]):
        start[tile] = pairs
        for worker in range(fill.shape[0]):
            count = fill[worker, tile]
            fill[worker, tile] = pairs
            pairs += count
    start[fill.shape[1]] = pairs
    for k in range(first.shape[0] - 1):
        first[k + 1] += first[k]


def tile_lists(
    order: np.ndarray, extent: np.ndarray, tiles_x: int, tiles_y: int, workers: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the Gaussians of each tile in the given (depth) order, ``order`` (K,) int64.

    Each of ``workers`` counts, then files, a stretch of ``order``; the result does not depend on how many there are.

    Returns ``start`` (tiles + 1,), ``members`` (pairs,) Gaussian of each entry, ``slots`` (pairs,) place of the
    entry's pair in a list grouped by Gaussian, ``first`` (K + 1,) where each Gaussian's group begins there.
    """
    tiles = tiles_x * tiles_y
    fill, first = np.zeros((workers, tiles), np.int64), np.zeros(len(extent) + 1, np.int64)
    start = np.empty(tiles + 1, np.int64)
    count_pairs(order, extent, tiles_x, fill, first)
    sum_pairs(fill, first, start)
    members, slots = np.empty(start[-1], np.int32), np.empty(start[-1], np.int64)
    file_pairs(order, extent, tiles_x, fill, first, members, slots)
    return start, members, slots, first
