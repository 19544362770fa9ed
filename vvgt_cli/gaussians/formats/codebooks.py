"""Few values for many: 256 numbers for those of a column, a palette of rows for those of a table."""

from __future__ import annotations

import numpy as np

SIZE = 256  # values of a codebook, told by a byte
BINS = 8192  # of the histogram that values are divided by
LARGEST_PALETTE = 1 << 16  # rows, told by two bytes


def codebook(values: np.ndarray) -> np.ndarray:
    """`SIZE` values (float32, rising) for any number of finite ones.

    The division of their histogram into intervals of the smallest squared error, where a bin weighs as the square root
    of its count: equal weights would spend more bytes, whole counts would leave rare values (large Gaussians) coarse.
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
    """Index uint8 of the nearest value of a codebook, of the shape of ``values``."""
    book = book.astype(np.float64)
    places: np.ndarray = np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)
    return places


def best_intervals(means: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Means (count,) float64 of the intervals of rising numbers (n,), n > count, with the smallest squared error."""
    from vvgt_cli.gaussians.formats.codebook_kernels import divide

    shifted = means - means.mean()  # sums of squares lose nothing then
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
    """At most ``most`` rows for ``points`` (n, d), and which of them stands for each.

    Returns:
        rows (m, d) float32; (n,) int32, numbers of rows.
    """
    from vvgt_cli.gaussians.formats.codebook_kernels import cut_clusters

    rows, labels = cut_clusters(np.ascontiguousarray(points, np.float32), min(most, len(points)))
    return rows, labels
