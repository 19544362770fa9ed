"""The kernel that puts a layer on another grid: trilinear samples where each target voxel lies in the layer."""

from __future__ import annotations

import numpy as np

from vvgt_cli.dvr.kernel import FLAGS
from vvgt_cli.jit.decorators import parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations


@parallel_kernel("f8:4 f8:2 i8:1 i8:1 i8:1 f8:1 f8 f8:4", fastmath=FLAGS, error_model="numpy")
def place(
    thread: ThreadSlice,
    values: np.ndarray, matrix: np.ndarray, lo: np.ndarray, first: np.ndarray, dims: np.ndarray, rim: np.ndarray,
    outside: float, out: np.ndarray,
) -> None:  # fmt: skip
    """Add samples of ``values`` (z, y, x, c), a part of a layer, to ``out`` (mz, my, mx, c), a part of the target.

    ``matrix`` (3, 4) float64 leads from voxel indices (x, y, z, 1) of the target to those of the layer, of ``dims``
    voxels; ``lo`` and ``first`` (3,) are where ``out`` and ``values`` begin, (x, y, z). The edge's values go on for
    half a voxel, to the face of the layer's box, and for ``rim`` (3,) of its voxels; beyond, ``outside`` is added.
    """
    nx, ny, nz, channels = dims[0], dims[1], dims[2], values.shape[3]
    mz, my, mx, _ = out.shape
    for k in iterations(thread, mz):
        for j in range(my):
            for i in range(mx):
                u, v, w = i + lo[0], j + lo[1], k + lo[2]
                x = matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2] * w + matrix[0, 3]
                y = matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2] * w + matrix[1, 3]
                z = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2] * w + matrix[2, 3]
                x_rim, y_rim, z_rim = 0.5 + rim[0], 0.5 + rim[1], 0.5 + rim[2]
                inside = -x_rim <= x <= nx - 1 + x_rim and -y_rim <= y <= ny - 1 + y_rim
                if not (inside and -z_rim <= z <= nz - 1 + z_rim):
                    for c in range(channels):
                        out[k, j, i, c] += outside
                    continue
                x, y, z = min(max(x, 0.0), nx - 1.0), min(max(y, 0.0), ny - 1.0), min(max(z, 0.0), nz - 1.0)
                i0, j0, k0 = int(x), int(y), int(z)
                i1, j1, k1 = min(i0 + 1, nx - 1), min(j0 + 1, ny - 1), min(k0 + 1, nz - 1)
                fx, fy, fz = x - i0, y - j0, z - k0
                i0, i1, j0, j1 = i0 - first[0], i1 - first[0], j0 - first[1], j1 - first[1]
                k0, k1 = k0 - first[2], k1 - first[2]
                for c in range(channels):
                    c00 = values[k0, j0, i0, c] * (1 - fx) + values[k0, j0, i1, c] * fx
                    c01 = values[k0, j1, i0, c] * (1 - fx) + values[k0, j1, i1, c] * fx
                    c10 = values[k1, j0, i0, c] * (1 - fx) + values[k1, j0, i1, c] * fx
                    c11 = values[k1, j1, i0, c] * (1 - fx) + values[k1, j1, i1, c] * fx
                    out[k, j, i, c] += (c00 * (1 - fy) + c01 * fy) * (1 - fz) + (c10 * (1 - fy) + c11 * fy) * fz
