"""Run-length decoder of SLC planes and AmiraMesh (numba; imported only when such values are read)."""

from __future__ import annotations

import numpy as np

from vvgt_cli.jit.decorators import kernel


@kernel("u1:1 u1:1")
def decode_runs(packed: np.ndarray, out: np.ndarray) -> int:
    """Decode run lengths, never past either end.

    Each run is a byte: 7 bits of count (0 ends the runs), and the top bit set if that many literal bytes follow,
    else one byte follows that repeats.

    Returns:
        Voxels written, or -1 if the runs leave ``packed`` or ``out``.
    """
    i = 0
    o = 0
    while i < packed.size:
        n = packed[i] & 127
        if n == 0:
            return o
        if o + n > out.size:
            return -1
        if packed[i] & 128:
            if i + n >= packed.size:
                return -1
            out[o : o + n] = packed[i + 1 : i + 1 + n]
            i += 1 + n
        else:
            if i + 1 >= packed.size:
                return -1
            out[o : o + n] = packed[i + 1]
            i += 2
        o += n
    return o
