"""Runs of samples along a ray, trilinear, so laid out that LLVM turns the loop into vector instructions."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from vvgt_cli.jit import inlined

RUN = 16  # samples of a run: one vector of AVX-512 float32, two of AVX2

F, N, U = nb.float32, nb.int32, nb.uint64


@intrinsic
def stack_run(typingctx: Any) -> Any:
    """Pointer to `RUN` float64 on the caller's stack, for `numba.carray`.

    Stores to memory that the compiler cannot tell apart from the volume would forbid it to vectorise.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), RUN))
        return builder.bitcast(array, ir.DoubleType().as_pointer())

    return types.CPointer(types.float64)(), codegen


@inlined(error_model="numpy")
def _base(p, v, n):
    """Lowest voxel of a run along one axis, and from there its start and the end of the axis, float32.

    Counted from there, float32 keeps positions to 1e-5 voxels in a volume of any size.
    """
    base = min(max(math.floor(min(p, p + (RUN - 1) * v)), 0), n - 1)
    return base, F(p - base), F(n - 1 - base)


@inlined(fastmath={"contract", "nsz", "arcp", "afn"}, error_model="numpy")
def sample_run(values, flat, px, py, pz, vx, vy, vz, lo, inv_width, bins, out):
    """Table coordinates ``out`` (RUN,) in [0, bins] of the samples at p + k v, k < RUN; -1 where not finite.

    ``values`` (nz, ny, nx), ``flat`` the same in one axis; p, v in voxel coordinates. As `kernel.sample` and
    `kernel.table_coordinate`, interpolated in float32.
    """
    nz, ny, nx = values.shape
    bx, x0, x_top = _base(px, vx, nx)
    by, y0, y_top = _base(py, vy, ny)
    bz, z0, z_top = _base(pz, vz, nz)
    dx, dy, dz = F(vx), F(vy), F(vz)
    row = nb.int64(nx)
    slab = row * nb.int64(ny)
    first = bz * slab + by * row + bx
    last_i, last_j, last_k = N(nx - 1 - bx), N(ny - 1 - by), N(nz - 1 - bz)
    top = float(bins)
    for n in range(RUN):
        s = F(N(n))
        x = min(max(x0 + s * dx, F(0)), x_top)
        y = min(max(y0 + s * dy, F(0)), y_top)
        z = min(max(z0 + s * dz, F(0)), z_top)
        i, j, k = N(x), N(y), N(z)
        fx, fy, fz = x - F(i), y - F(j), z - F(k)
        right = U(1 if i < last_i else 0)
        a = U(first + nb.int64(k) * slab + nb.int64(j) * row + nb.int64(i))
        b = a + U(row if j < last_j else 0)
        above = U(slab if k < last_k else 0)
        c, d = a + above, b + above
        v00, v01, v10, v11 = F(flat[a]), F(flat[b]), F(flat[c]), F(flat[d])
        v00 += (F(flat[a + right]) - v00) * fx
        v01 += (F(flat[b + right]) - v01) * fx
        v10 += (F(flat[c + right]) - v10) * fx
        v11 += (F(flat[d + right]) - v11) * fx
        v00 += (v01 - v00) * fy
        v10 += (v11 - v10) * fy
        value = nb.float64(v00 + (v10 - v00) * fz)
        u = min(max((value - lo) * inv_width, 0.0), top)
        out[n] = u if abs(value) < np.inf else -1.0
