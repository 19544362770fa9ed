"""Space-filling curves: codes of cells along a Z-order or a Hilbert curve (PTV3, Sec. 4.1).

The tests have twins in plain Python.
"""

from __future__ import annotations

import numpy as np

BITS = 16  # an axis; three of them fit 48 bits of an int64
CURVES = ("z", "z-trans", "hilbert", "hilbert-trans")
_SPREAD = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
           (2, 0x1249249249249249))  # fmt: skip


def spread(values: np.ndarray) -> np.ndarray:
    """Return ``values`` (below 2^21) with bit i moved to bit 3 i."""
    bits = values.astype(np.uint64)
    for shift, mask in _SPREAD:
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    return bits.astype(np.int64)


def interleave(cells: np.ndarray) -> np.ndarray:
    """Return the Z-order codes (n,) int64 of ``cells`` (n, 3) non-negative integers below 2^21, first axis first."""
    result: np.ndarray = spread(cells[:, 0]) << 2 | spread(cells[:, 1]) << 1 | spread(cells[:, 2])
    return result


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
