"""Runs of samples along a ray, trilinear, so laid out that LLVM turns the loop into vector instructions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numba as nb
import numpy as np
from llvmlite import ir
from numba import TypingError, types

from vvgt_cli.dvr.layout import Optics, Voxels
from vvgt_cli.jit.decorators import inlined, intrinsic
from vvgt_cli.jit.numba_internals import alloca_once, get_or_insert_function

RUN = 32  # samples of a run: two vectors of AVX-512 float32, four of AVX2
INT32_MAX = (1 << 31) - 1
NEAR = INT32_MAX // (4 * RUN + 3)  # voxels of a slab up to which offsets within a run of steps to 4 voxels fit 32 bits

F: Any = nb.float32  # Any: mypy knows what they make outside of kernels
N: Any = nb.int32
L: Any = nb.int64
Pointer: TypeAlias = Any  # to values of the volume
Run: TypeAlias = Any  # pointer to `RUN` float32, of `stack_run`


@intrinsic
def stack_run(typingctx: Any) -> Any:
    """Return a pointer to `RUN` float32 on the caller's stack.

    Stores to memory that the compiler cannot tell apart from the volume would forbid it to vectorise.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array = alloca_once(builder, ir.ArrayType(ir.FloatType(), RUN))
        return builder.bitcast(array, ir.FloatType().as_pointer())

    return types.CPointer(types.float32)(), codegen


@intrinsic
def run_range(typingctx: Any, run: Any) -> Any:
    """Return the smallest and largest of the `RUN` values behind a pointer; none may be NaN."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = ir.VectorType(ir.FloatType(), RUN)
        values = builder.load(builder.bitcast(args[0], vector.as_pointer()), align=4)
        kind = ir.FunctionType(ir.FloatType(), [vector])
        ends = []
        for name in ("fmin", "fmax"):
            reduce = get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.{name}.v{RUN}f32")
            ends.append(builder.call(reduce, [values], fastmath=("nnan", "nsz")))
        return context.make_tuple(builder, signature.return_type, ends)

    return types.UniTuple(types.float32, 2)(run), codegen


@intrinsic
def _first(typingctx: Any, voxels: Any) -> Any:
    """Return a pointer to the first value of `Voxels`: of nothing else, for only their layout has been checked."""
    if getattr(voxels, "instance_class", None) is not Voxels:
        raise TypingError(f"runs of samples are read from Voxels, not from {voxels}")

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return context.make_array(voxels[0])(context, builder, builder.extract_value(args[0], 0)).data

    return types.CPointer(voxels[0].dtype)(voxels), codegen


@intrinsic
def _pair(typingctx: Any, values: Any, index: Any, edge: Any, last: Any) -> Any:
    """Return values ``index + edge`` and ``index + 1`` behind a pointer, as float32.

    Integers come in one load of 32 bits, without ``edge``: its weight is zero there, but a NaN would not vanish by
    that. ``last``: the highest index at which such a load stays within the array.
    """
    bits = values.dtype.bitwidth
    whole, half = ir.IntType(32), ir.IntType(bits)

    def floats(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        one = ir.Constant(args[1].type, 1)
        places = [builder.add(args[1], offset) for offset in (args[2], one)]
        ends = [builder.load(builder.gep(args[0], [place])) for place in places]
        return context.make_tuple(builder, signature.return_type, ends)

    def integers(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        first, last = args[1], args[3]
        if bits == 8:
            first = builder.select(builder.icmp_signed("<", first, last), first, last)
        place = builder.bitcast(builder.gep(args[0], [first]), whole.as_pointer())
        both = builder.load(place, align=bits // 8)
        if bits == 8:
            behind = builder.sub(args[1], first)
            if behind.type.width > 32:
                behind = builder.trunc(behind, whole)
            both = builder.lshr(both, builder.shl(behind, ir.Constant(whole, 3)))
        parts = [both, builder.lshr(both, ir.Constant(whole, bits))]  # little-endian
        ends = [builder.uitofp(builder.trunc(part, half), ir.FloatType()) for part in parts]
        return context.make_tuple(builder, signature.return_type, ends)

    codegen = floats if isinstance(values.dtype, types.Float) else integers
    return types.UniTuple(types.float32, 2)(values, index, edge, last), codegen


@inlined(error_model="numpy", borrowed=True)
def _base(p: float, v: float, n: int) -> tuple[int, float, float]:
    """Return a run's lowest voxel along an axis of ``n``, and from there its start and the axis' end, float32.

    The run goes from ``p`` by ``v`` a sample, voxels. Counted from there, float32 keeps positions to 1e-5 voxels in a
    volume of any size.
    """
    base = max(min(math.floor(min(p, p + (RUN - 1) * v)), n - 2), 0)
    return base, F(p - base), F(n - 1 - base)


@intrinsic
def _from(typingctx: Any, values: Any, index: Any) -> Any:
    """Return a pointer to value ``index`` behind a pointer."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.gep(args[0], [args[1]])

    return values(values, index), codegen


def _sampler(index: Callable[[int], int]) -> Callable[..., None]:
    """Make the loop over a run, offsets of type ``index``: 32 bits are one vector of AVX-512 where 64 are two.

    ``here`` points to the run's lowest voxel; ``row``, ``slab``: voxels from one row, one slab to the next; ``last``:
    see `_pair`; ``start``, ``step``, ``top``, ``last_voxel`` (x, y, z) voxels from ``here``; ``table`` (lo, inv_width,
    bins); ``out`` (RUN,) float32.
    """

    @inlined(fastmath={"contract", "nsz", "arcp", "afn"}, error_model="numpy", borrowed=True)
    def samples(
        here: Pointer, row: int, slab: int, last: int, start: tuple[float, float, float],
        step: tuple[float, float, float], top: tuple[float, float, float], last_voxel: tuple[int, int, int],
        table: tuple[float, float, float], out: Run,
    ) -> None:  # fmt: skip
        (x0, y0, z0), (dx, dy, dz), (x_top, y_top, z_top) = start, step, top
        (last_i, last_j, last_k), (lo, inv_width, bins) = last_voxel, table
        for n in range(RUN):
            s = F(N(n))
            x = min(max(x0 + s * dx, F(0)), x_top)
            y = min(max(y0 + s * dy, F(0)), y_top)
            z = min(max(z0 + s * dz, F(0)), z_top)
            i, j, k = min(N(x), last_i), N(y), N(z)
            fx, fy, fz = x - F(i), y - F(j), z - F(k)
            edge = index(1 if N(x) > last_i else 0)
            a = index(index(index(k) * slab) + index(index(j) * row) + index(i))
            b = index(a + (row if j < last_j else index(0)))
            above = slab if k < last_k else index(0)
            c, d = index(a + above), index(b + above)
            v00, w00 = _pair(here, a, edge, last)
            v01, w01 = _pair(here, b, edge, last)
            v10, w10 = _pair(here, c, edge, last)
            v11, w11 = _pair(here, d, edge, last)
            v00 += (w00 - v00) * fx
            v01 += (w01 - v01) * fx
            v10 += (w10 - v10) * fx
            v11 += (w11 - v11) * fx
            v00 += (v01 - v00) * fy
            v10 += (v11 - v10) * fy
            value = v00 + (v10 - v00) * fz
            u = min(max((value - lo) * inv_width, F(0)), bins)
            out[n] = u if abs(value) < F(np.inf) else F(-1)

    return samples


_near_samples, _far_samples = _sampler(N), _sampler(L)


@inlined(fastmath={"contract", "nsz", "arcp", "afn"}, error_model="numpy", borrowed=True)
def sample_run(
    voxels: Voxels, px: float, py: float, pz: float, vx: float, vy: float, vz: float, optics: Optics, out: Run
) -> None:
    """Write table coordinates in [0, bins] of the samples at p + k v, k < RUN; -1 where not finite.

    ``voxels`` `Voxels`, ``optics`` `Optics`; p, v in voxels (x, y, z), from the first voxel's centre; ``out``
    `stack_run`, (RUN,) float32. As `kernel.sample` and `kernel.table_coordinate`, in float32.
    """
    nz, ny, nx = voxels.values.shape
    bx, x0, x_top = _base(px, vx, nx)
    by, y0, y_top = _base(py, vy, ny)
    bz, z0, z_top = _base(pz, vz, nz)
    row, slab = L(nx), L(nx) * L(ny)
    first = bz * slab + by * row + bx
    last = slab * L(nz) - 4 - first
    here = _from(_first(voxels), first)
    start, step, top = (x0, y0, z0), (F(vx), F(vy), F(vz)), (x_top, y_top, z_top)
    last_voxel = N(nx - 2 - bx), N(ny - 1 - by), N(nz - 1 - bz)  # the last pair along x
    table = F(optics.lo), F(optics.inv_width), F(optics.nodes.shape[0] - 1)
    if slab < NEAR:
        _near_samples(here, N(row), N(slab), N(min(last, INT32_MAX)), start, step, top, last_voxel, table, out)
    else:
        _far_samples(here, row, slab, last, start, step, top, last_voxel, table, out)
