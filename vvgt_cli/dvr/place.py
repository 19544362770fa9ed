"""The kernel that puts a layer on another grid: trilinear samples where each target voxel lies in the layer."""

from __future__ import annotations

import numba as nb
import numpy as np

from vvgt_cli.dvr.kernel import FLAGS
from vvgt_cli.jit.decorators import kernel


@kernel("f4:4 f8:2 f8 f4:4", parallel=True, fastmath=FLAGS, error_model="numpy")
def place(values: np.ndarray, matrix: np.ndarray, outside: float, out: np.ndarray) -> None:
    """Add samples of ``values`` (nz, ny, nx, c) float32 to ``out`` (mz, my, mx, c).

    ``matrix`` (3, 4) float64 leads from voxel indices (x, y, z, 1) of ``out`` to those of ``values``; beyond its box
    ``outside`` is added, in the rim of half a voxel the edge's.
    """
    nz, ny, nx, channels = values.shape
    mz, my, mx, _ = out.shape
    for k in nb.prange(mz):
        for j in range(my):
            for i in range(mx):
                x = matrix[0, 0] * i + matrix[0, 1] * j + matrix[0, 2] * k + matrix[0, 3]
                y = matrix[1, 0] * i + matrix[1, 1] * j + matrix[1, 2] * k + matrix[1, 3]
                z = matrix[2, 0] * i + matrix[2, 1] * j + matrix[2, 2] * k + matrix[2, 3]
                inside = -0.5 <= x <= nx - 0.5 and -0.5 <= y <= ny - 0.5 and -0.5 <= z <= nz - 0.5
                if not inside:
                    for c in range(channels):
                        out[k, j, i, c] += outside
                    continue
                x, y, z = min(max(x, 0.0), nx - 1.0), min(max(y, 0.0), ny - 1.0), min(max(z, 0.0), nz - 1.0)
                i0, j0, k0 = int(x), int(y), int(z)
                i1, j1, k1 = min(i0 + 1, nx - 1), min(j0 + 1, ny - 1), min(k0 + 1, nz - 1)
                fx, fy, fz = x - i0, y - j0, z - k0
                for c in range(channels):
                    c00 = values[k0, j0, i0, c] * (1 - fx) + values[k0, j0, i1, c] * fx
                    c01 = values[k0, j1, i0, c] * (1 - fx) + values[k0, j1, i1, c] * fx
                    c10 = values[k1, j0, i0, c] * (1 - fx) + values[k1, j0, i1, c] * fx
                    c11 = values[k1, j1, i0, c] * (1 - fx) + values[k1, j1, i1, c] * fx
                    out[k, j, i, c] += (c00 * (1 - fy) + c01 * fy) * (1 - fz) + (c10 * (1 - fy) + c11 * fy) * fz
