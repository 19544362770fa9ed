"""Runs of samples along a ray, trilinear, so laid out that LLVM turns the loop into vector instructions."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from vvgt_cli.dvr.vectors import intrinsic
from vvgt_cli.jit import inlined

RUN = 16  # samples of a run: one vector of AVX-512 float32, two of AVX2

# Arrays are not reference-counted within these functions: counting cost 100 ns a ray.
BORROWED = {"_nrt": False}

F, N, U = nb.float32, nb.int32, nb.uint64


@intrinsic
def stack_run(typingctx: Any) -> Any:
    """Pointer to `RUN` float64 on the caller's stack.

    Stores to memory that the compiler cannot tell apart from the volume would forbid it to vectorise.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), RUN))
        return builder.bitcast(array, ir.DoubleType().as_pointer())

    return types.CPointer(types.float64)(), codegen


@intrinsic
def run_range(typingctx: Any, run: Any) -> Any:
    """Smallest and largest of the `RUN` values behind a pointer; none may be NaN."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = ir.VectorType(ir.DoubleType(), RUN)
        values = builder.load(builder.bitcast(args[0], vector.as_pointer()), align=8)
        kind = ir.FunctionType(ir.DoubleType(), [vector])
        ends = []
        for name in ("fmin", "fmax"):
            reduce = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.{name}.v{RUN}f64")
            ends.append(builder.call(reduce, [values], fastmath=("nnan", "nsz")))
        return context.make_tuple(builder, signature.return_type, ends)

    return types.UniTuple(types.float64, 2)(run), codegen


@intrinsic
def first_value(typingctx: Any, values: Any) -> Any:
    """Pointer to the first value of an array."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return context.make_array(signature.args[0])(context, builder, args[0]).data

    return types.CPointer(values.dtype)(values), codegen


@intrinsic
def _pair(typingctx: Any, values: Any, index: Any, edge: Any) -> Any:
    """Values ``index + edge`` and ``index + 1`` behind a pointer, as float32.

    Integers come in one load, without ``edge``: its weight is zero there, but a NaN would not vanish by that.
    """
    bits = values.dtype.bitwidth
    whole, half = ir.IntType(2 * bits), ir.IntType(bits)

    def floats(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        one = ir.Constant(args[1].type, 1)
        places = [builder.add(args[1], offset) for offset in (args[2], one)]
        ends = [builder.load(builder.gep(args[0], [place])) for place in places]
        return context.make_tuple(builder, signature.return_type, ends)

    def integers(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = builder.bitcast(builder.gep(args[0], [args[1]]), whole.as_pointer())
        both = builder.load(place, align=bits // 8)
        parts = [both, builder.lshr(both, ir.Constant(whole, bits))]  # little-endian
        ends = [builder.uitofp(builder.trunc(part, half), ir.FloatType()) for part in parts]
        return context.make_tuple(builder, signature.return_type, ends)

    codegen = floats if isinstance(values.dtype, types.Float) else integers
    return types.UniTuple(types.float32, 2)(values, index, edge), codegen


@inlined(error_model="numpy", **BORROWED)
def _base(p, v, n):
    """Lowest voxel of a run along one axis, and from there its start and the end of the axis, float32.

    Counted from there, float32 keeps positions to 1e-5 voxels in a volume of any size.
    """
    base = max(min(math.floor(min(p, p + (RUN - 1) * v)), n - 2), 0)
    return base, F(p - base), F(n - 1 - base)


@inlined(fastmath={"contract", "nsz", "arcp", "afn"}, error_model="numpy", **BORROWED)
def sample_run(values, flat, px, py, pz, vx, vy, vz, lo, inv_width, bins, out):
    """Table coordinates ``out`` (RUN,) in [0, bins] of the samples at p + k v, k < RUN; -1 where not finite.

    ``values`` (nz, ny, nx), ``flat`` its `first_value`; p, v in voxel coordinates. Integer volumes are at least two
    voxels wide along x (`scene.kernel_values`). As `kernel.sample` and `kernel.table_coordinate`, in float32.
    """
    nz, ny, nx = values.shape
    bx, x0, x_top = _base(px, vx, nx)
    by, y0, y_top = _base(py, vy, ny)
    bz, z0, z_top = _base(pz, vz, nz)
    dx, dy, dz = F(vx), F(vy), F(vz)
    row = nb.int64(nx)
    slab = row * nb.int64(ny)
    first = bz * slab + by * row + bx
    last_i, last_j, last_k = N(nx - 2 - bx), N(ny - 1 - by), N(nz - 1 - bz)  # the last pair along x
    top = float(bins)
    for n in range(RUN):
        s = F(N(n))
        x = min(max(x0 + s * dx, F(0)), x_top)
        y = min(max(y0 + s * dy, F(0)), y_top)
        z = min(max(z0 + s * dz, F(0)), z_top)
        i, j, k = min(N(x), last_i), N(y), N(z)
        fx, fy, fz = x - F(i), y - F(j), z - F(k)
        edge = U(1 if N(x) > last_i else 0)
        a = U(first + nb.int64(k) * slab + nb.int64(j) * row + nb.int64(i))
        b = a + U(row if j < last_j else 0)
        above = U(slab if k < last_k else 0)
        c, d = a + above, b + above
        v00, w00 = _pair(flat, a, edge)
        v01, w01 = _pair(flat, b, edge)
        v10, w10 = _pair(flat, c, edge)
        v11, w11 = _pair(flat, d, edge)
        v00 += (w00 - v00) * fx
        v01 += (w01 - v01) * fx
        v10 += (w10 - v10) * fx
        v11 += (w11 - v11) * fx
        v00 += (v01 - v00) * fy
        v10 += (v11 - v10) * fy
        value = nb.float64(v00 + (v10 - v00) * fz)
        u = min(max((value - lo) * inv_width, 0.0), top)
        out[n] = u if abs(value) < np.inf else -1.0
