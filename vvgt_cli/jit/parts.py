"""Loops that threads share: a kernel's body is run once a thread, each time for its own part.

`numba.prange` does the same, but has a body typed, outlined and compiled twice: 45 % of the time of compiling.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from inspect import signature
from itertools import count as iterate
from typing import Any, TypeAlias

import numba as nb
from llvmlite import ir
from numba import extending, types
from numba.core import cgutils, compiler
from numba.core.callconv import excinfo_ptr_t
from numba.np.ufunc.parallel import _launch_threads

from vvgt_cli.jit.target import config

Part: TypeAlias = tuple[int, int, Any]  # which, of how many; where they count the turns that are taken one by one
U = nb.uint64  # an index that cannot be negative needs no test
NO_C_ENTRY: dict[str, Any] = {"no_cfunc_wrapper": True}
NO_ENTRY = NO_C_ENTRY | {"no_cpython_wrapper": True}
BYTE, CODE, SIZE = ir.IntType(8).as_pointer(), ir.IntType(32), ir.IntType(64)
LOOP = ir.FunctionType(ir.VoidType(), [BYTE.as_pointer(), SIZE.as_pointer(), SIZE.as_pointer(), BYTE])
OF_PART = types.UniTuple(types.int64, 3)
VALUES, COUNT, TAKEN, FAILED, ERROR = range(5)  # fields of what parts are handed


@nb.njit(forceinline=True, **NO_ENTRY)  # type: ignore[untyped-decorator]
def turns_of(part: Part, count: int) -> range:
    """Which of ``count`` turns of a loop are a ``part``'s own: a stretch of them."""
    return range(U(part[0] * count // part[1]), U((part[0] + 1) * count // part[1]))


def _take(context: Any, part: Any) -> Any:
    """The next turn of a loop that no part has taken yet: for turns that take unlike times."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        taken = builder.inttoptr(builder.extract_value(args[0], 2), SIZE.as_pointer())
        return builder.atomic_rmw("add", taken, SIZE(1), "monotonic")

    return types.int64(part), build


def whole() -> Part:
    """The only part, in plain Python."""
    return 0, 1, iterate()


def shared(body: Any, name: str) -> Callable[..., None]:
    """The function that runs ``body(part, ...)``, an `njit` function without a result, on numba's threads."""
    function = body.py_func
    names = ", ".join(list(signature(function).parameters)[1:])
    scope = {"body": body, "run": _run, "__name__": function.__module__}
    exec(f"def {name}({names}):\n    run(body, ({names},))", scope)
    made: Any = scope[name]
    made.__module__, made.__qualname__, made.__doc__ = function.__module__, name, function.__doc__
    return made  # type: ignore[no-any-return]


@cache  # types are asked for more than once
def _compiled(context: Any, dispatcher: Any, kinds: tuple[Any, ...]) -> Any:
    """A function for arguments of these types, as intermediate code alone."""
    own = dispatcher._compiler
    flags: Any = compiler.Flags()
    own.targetdescr.options.parse_as_flags(flags, own.targetoptions)
    flags.no_compile = True
    return compiler.compile_extra(context, own.targetdescr.target_context, own.py_func, kinds, types.none, flags, {})


def _run_parts(context: Any, body: Any, values: Any) -> Any:
    """``body(part, *values)`` for every part, each on a thread; what one of them raises."""
    made = _compiled(context, body.dispatcher, (OF_PART, *values.types))

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        _launch_threads()  # compiled code finds their functions by name, loaded code too
        context.active_code_library._reload_init.add(_launch_threads)
        context.active_code_library.add_linking_library(made.library)
        handed = ir.LiteralStructType([args[1].type, SIZE, SIZE, CODE, excinfo_ptr_t])
        data = cgutils.alloca_once(builder, handed)
        threads = cgutils.get_or_insert_function(builder.module, ir.FunctionType(SIZE, []), "get_num_threads")
        count = builder.call(threads, [])
        count = builder.select(builder.icmp_signed("<", count, SIZE(1)), SIZE(1), count)  # a fork may know of none
        for place, value in ((VALUES, args[1]), (COUNT, count), (TAKEN, SIZE(0)), (FAILED, CODE(0))):
            builder.store(value, cgutils.gep_inbounds(builder, data, 0, place))
        loop = _loop(context, builder, made, values, handed)
        _call(builder, loop, builder.bitcast(data, BYTE), count)
        code, error = (builder.load(cgutils.gep_inbounds(builder, data, 0, place)) for place in (FAILED, ERROR))
        with builder.if_then(builder.icmp_signed("!=", code, CODE(0)), likely=False):
            status = context.call_conv._get_return_status(builder, code, error)
            context.call_conv.return_status_propagate(builder, status)
        return context.get_dummy_value()

    return types.none(body, values), build


def _loop(context: Any, builder: Any, made: Any, values: Any, handed: Any) -> Any:
    """The function that numba's threads call, which runs consecutive parts; its first argument tells the first one."""
    loop = ir.Function(builder.module, LOOP, f"{builder.function.name}.parts")
    loop.linkage = "internal"
    inner = ir.IRBuilder(loop.append_basic_block())
    first, counts, _, data = loop.args
    begin = inner.sub(inner.ptrtoint(inner.load(first), SIZE), inner.ptrtoint(data, SIZE))
    held = inner.bitcast(data, handed.as_pointer())
    given, parts = (inner.load(cgutils.gep_inbounds(inner, held, 0, place)) for place in (VALUES, COUNT))
    taken = inner.ptrtoint(cgutils.gep_inbounds(inner, held, 0, TAKEN), SIZE)
    items = [inner.extract_value(given, place) for place in range(len(values))]
    function = context.declare_function(builder.module, made.fndesc)
    with cgutils.for_range(inner, inner.load(counts)) as turn:
        part = context.make_tuple(inner, OF_PART, [inner.add(begin, turn.index), parts, taken])
        status, _ = context.call_conv.call_function(
            inner, function, made.fndesc.restype, made.fndesc.argtypes, [part, *items]
        )
        with inner.if_then(status.is_error, likely=False):
            inner.store(status.excinfoptr, cgutils.gep_inbounds(inner, held, 0, ERROR))
            inner.store(status.code, cgutils.gep_inbounds(inner, held, 0, FAILED))
    inner.ret_void()
    return loop


def _call(builder: Any, loop: Any, data: Any, count: Any) -> None:
    """Have numba's threads call ``loop`` for ``count`` parts; its first argument is ``data`` plus the part's number."""
    first, counts, steps = (cgutils.alloca_once(builder, kind) for kind in (BYTE, SIZE, SIZE))
    for value, place in ((data, first), (count, counts), (SIZE(1), steps)):
        builder.store(value, place)
    kind = ir.FunctionType(ir.VoidType(), [BYTE] * 5 + [SIZE] * 3)
    start = cgutils.get_or_insert_function(builder.module, kind, "numba_parallel_for")
    with builder.if_else(builder.icmp_signed("==", count, SIZE(1))) as (one, more):
        with one:
            builder.call(loop, [first, counts, steps, data])
        with more:
            pointers = [builder.bitcast(value, BYTE) for value in (loop, first, counts, steps)]
            builder.call(start, [*pointers, data, SIZE(0), SIZE(1), count])


_run: Any = None if config.DISABLE_JIT else extending.intrinsic(_run_parts)


def _take_in_python(part: Part) -> int:
    """`_take` of the only part."""
    return int(next(part[2]))


take_turn: Any = _take_in_python if config.DISABLE_JIT else extending.intrinsic(_take)
