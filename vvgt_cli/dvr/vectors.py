"""Four float64 as one vector register in numba kernels: a row of a table of optics in one load.

LLVM leaves arithmetic on tuples of four floats scalar; as one value of vector type it takes a quarter of the
instructions.
"""

from __future__ import annotations

from typing import Any, TypeAlias

from llvmlite import ir
from numba import TypingError, types
from numba.extending import models, register_model

from vvgt_cli.jit.decorators import inlined, intrinsic

DOUBLE = ir.DoubleType()
QUAD = ir.VectorType(DOUBLE, 4)
FLAGS = ("contract", "nsz")


class QuadType(types.Type):
    """Type of `row` and of what is computed from it."""

    def __init__(self) -> None:
        """Name the type "Quad"."""
        super().__init__(name="Quad")


quad = QuadType()
Vector = tuple[float, float, float]
Quad: TypeAlias = Any  # a value of that type, in annotations: Python has none like it


@register_model(QuadType)
class _QuadModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        models.PrimitiveModel.__init__(self, manager, kind, QUAD)


def _splat(builder: Any, scalar: Any) -> Any:
    one = builder.insert_element(ir.Constant(QUAD, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), 4), [0] * 4)
    return builder.shuffle_vector(one, ir.Constant(QUAD, ir.Undefined), zeros)


@intrinsic
def row(typingctx: Any, table: Any, index: Any) -> Any:
    """Load row ``index`` (unsigned, in range) of a C-contiguous float64 array (n, 4)."""
    if not (isinstance(table, types.Array) and (table.dtype, table.ndim, table.layout) == (types.float64, 2, "C")):
        raise TypingError(f"rows are taken from C-contiguous float64 tables, not from {table}")

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, args[0])
        at = builder.shl(args[1], ir.Constant(args[1].type, 2))
        start = builder.gep(array.data, [at])
        return builder.load(builder.bitcast(start, QUAD.as_pointer()), align=8)

    return quad(table, index), codegen


@intrinsic
def texel(typingctx: Any, grid: Any, index: Any) -> Any:
    """Load voxel ``index`` (unsigned, in range, x fastest) of a C-contiguous float32 array (nz, ny, nx, 4)."""
    if not (isinstance(grid, types.Array) and (grid.dtype, grid.ndim, grid.layout) == (types.float32, 4, "C")):
        raise TypingError(f"voxels are taken from C-contiguous float32 grids, not from {grid}")

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, args[0])
        at = builder.shl(args[1], ir.Constant(args[1].type, 2))
        start = builder.gep(array.data, [at])
        four = builder.load(builder.bitcast(start, ir.VectorType(ir.FloatType(), 4).as_pointer()), align=4)
        return builder.fpext(four, QUAD)

    return quad(grid, index), codegen


@intrinsic
def four(typingctx: Any, values: Any, index: Any) -> Any:
    """Load values ``index`` (unsigned) to ``index + 3``, all in range, of a C-contiguous array (nz, ny, nx)."""
    if not (isinstance(values, types.Array) and (values.ndim, values.layout) == (3, "C")):
        raise TypingError(f"values are taken from C-contiguous volumes, not from {values}")

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, args[0])
        kind = ir.VectorType(context.get_data_type(values.dtype), 4)
        start = builder.gep(array.data, [args[1]])
        loaded = builder.load(builder.bitcast(start, kind.as_pointer()), align=values.dtype.bitwidth // 8)
        return (builder.fpext if isinstance(values.dtype, types.Float) else builder.uitofp)(loaded, QUAD)

    return quad(values, index), codegen


@intrinsic
def vector(typingctx: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Return (a, b, c, d)."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        packed = ir.Constant(QUAD, ir.Undefined)
        for n, part in enumerate(args):
            packed = builder.insert_element(packed, part, ir.Constant(ir.IntType(32), n))
        return packed

    return quad(types.float64, types.float64, types.float64, types.float64), codegen


@intrinsic
def zeros4(typingctx: Any) -> Any:
    """Return (0, 0, 0, 0)."""
    return quad(), lambda context, builder, signature, args: ir.Constant(QUAD, [0.0] * 4)


@intrinsic
def lane(typingctx: Any, vector: Any, index: Any) -> Any:
    """Return entry ``index`` of a vector."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.extract_element(args[0], builder.trunc(args[1], ir.IntType(32)))

    return types.float64(quad, types.int64), codegen


@intrinsic
def add(typingctx: Any, a: Any, b: Any) -> Any:
    """Return a + b."""
    return quad(quad, quad), lambda context, builder, signature, args: builder.fadd(*args, flags=FLAGS)


@intrinsic
def sub(typingctx: Any, a: Any, b: Any) -> Any:
    """Return a - b."""
    return quad(quad, quad), lambda context, builder, signature, args: builder.fsub(*args, flags=FLAGS)


@intrinsic
def scale(typingctx: Any, a: Any, b: Any) -> Any:
    """Multiply vector ``b`` by float ``a``."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fmul(_splat(builder, args[0]), args[1], flags=FLAGS)

    return quad(types.float64, quad), codegen


@inlined(error_model="numpy", _nrt=False)
def mix(a: Quad, b: Quad, share: float) -> Quad:
    """Interpolate linearly from a to b."""
    return add(a, scale(share, sub(b, a)))


@inlined(error_model="numpy", _nrt=False)
def dot(a: Quad, b: Quad) -> float:
    """Return the scalar product of the first three lanes."""
    return lane(a, 0) * lane(b, 0) + lane(a, 1) * lane(b, 1) + lane(a, 2) * lane(b, 2)
