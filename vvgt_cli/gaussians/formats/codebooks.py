"""Quantisation: a codebook of 256 numbers for a column, a palette of rows for a table."""

from __future__ import annotations

import numpy as np

SIZE = 256  # values of a codebook, indexed by a byte
BINS = 8192  # of the histogram that is divided into intervals
LARGEST_PALETTE = 1 << 16  # rows, indexed by two bytes


def codebook(values: np.ndarray) -> np.ndarray:
    """Return `SIZE` values (float32, ascending) that represent any number of finite ones.

    Their histogram is divided into intervals with the smallest squared error, where a bin is weighted by the square
    root of its count. Equal weights would make larger files, and full counts would quantise rare values (large
    Gaussians) coarsely.
    """
    flat = values.ravel().astype(np.float64)
    low, high = float(flat.min()), float(flat.max())
    places = np.minimum((flat - low) / ((high - low) or 1.0) * BINS, BINS - 1).astype(np.int64)
    counts, sums = np.bincount(places, minlength=BINS), np.bincount(places, flat, BINS)
    some = counts > 0
    means, weights = sums[some] / counts[some], np.sqrt(counts[some])
    if len(means) > SIZE:
        means = best_intervals(means, weights, SIZE)
    return np.concatenate([means, np.full(SIZE - len(means), means[-1])]).astype(np.float32)


def places_in(book: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the index of the nearest value of a codebook, uint8 in the shape of ``values``."""
    book = book.astype(np.float64)
    places: np.ndarray = np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)
    return places


def best_intervals(means: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Return the means (count,) float64 of the intervals of ascending numbers (n > count,) with least squared error."""
    from vvgt_cli.gaussians.formats.codebook_kernels import divide

    shifted = means - means.mean()  # avoids cancellation in the sums of squares
    sums = np.zeros((3, len(means) + 1))
    sums[:, 1:] = np.cumsum([weights, weights * shifted, weights * shifted**2], axis=1)
    cuts = np.zeros((count + 1, len(means) + 1), np.int32)
    divide(sums, cuts)
    found, end = np.empty(count, np.float64), len(means)
    for k in range(count, 0, -1):
        start = int(cuts[k, end])
        found[k - 1] = (sums[1, end] - sums[1, start]) / (sums[0, end] - sums[0, start])
        end = start
    found += means.mean()
    return found


def palette(points: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Cluster ``points`` (n, d) into at most ``most`` rows.

    Returns:
        rows (m, d) float32; (n,) int32, the row of each point.
    """
    from vvgt_cli.gaussians.formats.codebook_kernels import cut_clusters

    rows, labels = cut_clusters(np.ascontiguousarray(points, np.float32), min(most, len(points)))
    return rows, labels
