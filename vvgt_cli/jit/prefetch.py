"""Memory that kernels will read soon, asked for ahead of time."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from vvgt_cli.jit.decorators import intrinsic
from vvgt_cli.jit.target import config

BYTE, WORD = ir.IntType(8).as_pointer(), ir.IntType(32)
READ, KEPT, DATA = ir.Constant(WORD, 0), ir.Constant(WORD, 3), ir.Constant(WORD, 1)


def _prefetch(typingctx: Any, rows: Any, index: Any, column: Any) -> Any:
    """The cache line of ``rows[index, column]``, a C-contiguous array (n, m); both are in range and not negative."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, args[0])
        width = builder.extract_value(array.shape, 1)
        at = builder.gep(array.data, [builder.add(builder.mul(args[1], width), args[2])])
        kind = ir.FunctionType(ir.VoidType(), [BYTE, WORD, WORD, WORD])
        ask = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(ask, [builder.bitcast(at, BYTE), READ, KEPT, DATA])
        return context.get_dummy_value()

    return types.void(rows, types.int64, types.int64), codegen


def _nothing(rows: Any, index: int, column: int) -> None:
    """In plain Python there is nothing to ask."""


prefetch: Any = _nothing if config.DISABLE_JIT else intrinsic(_prefetch)
