"""Kernels of `vvgt_cli.gaussians.formats.sog`: optimal intervals of numbers, clusters of rows."""

from __future__ import annotations

import heapq

import numpy as np

from vvgt_cli.jit.decorators import inlined, kernel


@inlined()
def _error(sums: np.ndarray, start: int, end: int) -> float:
    """Return the squared error of the interval from ``start`` to before ``end`` around its mean."""
    weight, first = sums[0, end] - sums[0, start], sums[1, end] - sums[1, start]
    return sums[2, end] - sums[2, start] - first * first / weight


@kernel("f8:2 i4:2")
def divide(sums: np.ndarray, cuts: np.ndarray) -> None:
    """Compute ``cuts[k, j]``, the start of the last of k intervals of the first j numbers with the smallest error.

    This is dynamic programming: the cuts for k increase with j, so each is searched between those of its neighbours on
    either side (Wu 1991, "Optimal quantization by matrix searching"; Wang and Song 2011, "Ckmeans.1d.dp").

    Args:
        sums: (3, n + 1) float64, prefix sums of weights, weighted numbers and their weighted squares.
        cuts: (count + 1, n + 1) int32, zeros; filled in.
    """
    n, count = sums.shape[1] - 1, cuts.shape[0] - 1
    before, now = np.full(n + 1, np.inf), np.full(n + 1, np.inf)
    before[0] = 0.0
    for j in range(1, n + 1):
        before[j] = _error(sums, 0, j)
    open_ranges = np.empty((128, 4), np.int64)
    for k in range(2, count + 1):
        now[:] = np.inf
        open_ranges[0] = k, n, k - 1, n - 1
        left = 1
        while left:
            left -= 1
            low, high, first, last = open_ranges[left]
            if low > high:
                continue
            j = (low + high) // 2
            best, at = np.inf, first
            for i in range(first, min(last, j - 1) + 1):
                error = before[i] + _error(sums, i, j)
                if error < best:
                    best, at = error, i
            now[j], cuts[k, j] = best, at
            open_ranges[left] = low, j - 1, first, at
            open_ranges[left + 1] = j + 1, high, at, last
            left += 2
        before, now = now, before


@inlined()
def _spread(points: np.ndarray, members: np.ndarray, start: int, end: int, sums: np.ndarray) -> tuple[float, int]:
    """Return a cluster's squared error along its worst axis, and the axis; ``sums`` (2, d) is overwritten."""
    sums[:] = 0.0
    for k in range(start, end):
        for d in range(points.shape[1]):
            sums[0, d] += points[members[k], d]
    count = end - start
    for k in range(start, end):
        for d in range(points.shape[1]):
            away = points[members[k], d] - sums[0, d] / count
            sums[1, d] += away * away
    axis = 0
    for d in range(points.shape[1]):
        axis = d if sums[1, d] > sums[1, axis] else axis
    return sums[1, axis], axis


@kernel("f4:2 i8")
def cut_clusters(points: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Cluster ``points`` (n, d) float32 into at most ``most`` rows.

    The cluster with the largest error along an axis is split there at its mean, repeatedly.

    Returns:
        rows (m, d) float32, the clusters' means; (n,) int32, the row of each point.
    """
    n, dims = points.shape
    members, sums = np.arange(n), np.empty((2, dims))
    starts, ends, axes = np.zeros(most, np.int64), np.zeros(most, np.int64), np.zeros(most, np.int64)
    ends[0] = n
    error, axes[0] = _spread(points, members, 0, n, sums)
    heap = [(-error, 0)]
    made = 1
    while made < most and heap:
        error, cluster = heapq.heappop(heap)
        if error == 0.0:
            break
        start, end, axis = starts[cluster], ends[cluster], axes[cluster]
        mean = 0.0
        for k in range(start, end):
            mean += points[members[k], axis]
        mean /= end - start
        low, high = start, end - 1
        while low <= high:
            if points[members[low], axis] < mean:
                low += 1
            else:
                members[low], members[high] = members[high], members[low]
                high -= 1
        if low in (start, end):
            continue  # the points are equal up to rounding
        ends[cluster], starts[made], ends[made] = low, low, end
        for part in (cluster, made):
            error, axes[part] = _spread(points, members, starts[part], ends[part], sums)
            heapq.heappush(heap, (-error, part))
        made += 1
    rows, labels = np.zeros((made, dims), np.float32), np.empty(n, np.int32)
    for part in range(made):
        _spread(points, members, starts[part], ends[part], sums)
        for d in range(dims):
            rows[part, d] = sums[0, d] / (ends[part] - starts[part])
        for k in range(starts[part], ends[part]):
            labels[members[k]] = part
    return rows, labels
