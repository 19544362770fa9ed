"""The kernel under `tallies`: how often each whole number occurs."""

from __future__ import annotations

import numba as nb
import numpy as np

from vvgt_cli.jit.decorators import kernel

LANES = 4  # tables that neighbours are counted in: equal ones need not wait for each other


@kernel("V i8:3", parallel=True)
def count_values(values: np.ndarray, out: np.ndarray) -> None:
    """Counts of each number in ``values`` (nz, ny, nx) uint8 or uint16; ``out`` (parts, LANES, 256 or 65536), zeros."""
    parts = out.shape[0]
    for part in nb.prange(parts):
        for z in range(part, values.shape[0], parts):
            for y in range(values.shape[1]):
                row = values[z, y]
                for x in range(values.shape[2]):
                    out[part, x % LANES, int(row[x])] += 1
