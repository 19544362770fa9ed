"""Whether the values of a raw volume lie as its dimensions say: neighbours along an axis are alike."""

from __future__ import annotations

import warnings
from itertools import permutations

import numpy as np

RUNS, LENGTH = 64, 512  # what is looked at, of the whole volume: runs of neighbouring values
LESS = 0.5  # difference of neighbours, of that in the order given, below which another order is worth a word
LEAST = 4  # voxels along an axis below which there is nothing to tell


def guess_dims(data: np.ndarray) -> tuple[int, int, int] | None:
    """Dimensions (x, y, z) in another order, in which neighbouring values differ by less than half of what they do now.

    Rows and slices of a volume are like those beside them; read in another order than they were written they are not.

    Args:
        data: (nz, ny, nx), contiguous; memory-mapped data are read in a few places only.

    Returns:
        The order in which neighbours differ least, or None where that given is no worse, or nothing can be told.
    """
    given = data.shape[::-1]
    orders = sorted(set(permutations(given)), key=lambda order: order != given)  # the one given first: it wins ties
    if len(orders) == 1 or min(given) < LEAST or not data.flags.c_contiguous:
        return None
    flat, reach = data.reshape(-1), LENGTH + max(x * y for x, y, _ in orders)
    if reach >= flat.size:
        return None
    index = np.linspace(0, flat.size - reach, RUNS).astype(np.int64)[:, None] + np.arange(LENGTH)
    lags = sorted({lag for x, y, _ in orders for lag in (x, x * y)})
    with np.errstate(invalid="ignore", over="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy's, of a mean of nothing but NaN
        here = flat[index].astype(np.float64)
        differs = {lag: float(np.nanmean(np.abs(flat[index + lag].astype(np.float64) - here))) for lag in lags}
    unlike = [differs[x] + differs[x * y] for x, y, _ in orders]
    best = int(np.argmin(unlike))
    if not np.isfinite(unlike).all() or not unlike[best] < LESS * unlike[0]:
        return None
    return orders[best]
