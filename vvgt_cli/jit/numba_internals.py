"""Everything used of numba that numba does not document, and may change in any minor release.

No other file of the package imports ``numba.core`` or ``numba.np``. pyproject.toml bounds numba by the minor release
that was tested, and tests/test_jit_numba.py compares each name below with the numba that is installed.
"""

from __future__ import annotations

import itertools
import pickle
from collections.abc import Callable
from functools import cache
from typing import Any

import llvmlite.binding
import numba
from llvmlite import ir
from numba import extending, types
from numba.core import bytecode, cgutils, compiler
from numba.core.callconv import excinfo_ptr_t
from numba.core.codegen import JITCPUCodegen
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps
from numba.np.ufunc.parallel import _launch_threads

config: Any = numba.config  # its attributes come from the environment, which type checkers do not see
alloca_once: Any = cgutils.alloca_once
get_or_insert_function: Any = cgutils.get_or_insert_function

NO_C_ENTRY: dict[str, Any] = {"no_cfunc_wrapper": True}
NO_ENTRY = NO_C_ENTRY | {"no_cpython_wrapper": True}
INLINED = NO_ENTRY | {"forceinline": True}
BORROWED: dict[str, Any] = {"_nrt": False}  # arrays are not reference-counted within the function

SETTINGS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "DISABLE_INTEL_SVML", "USING_SVML", "CPU_FEATURES")
WIDE = "+avx512vbmi2"  # Ice Lake, Zen 4: from there on, vectors of 512 bits hardly lower the clock

BYTE, CODE, SIZE = ir.IntType(8).as_pointer(), ir.IntType(32), ir.IntType(64)
LOOP = ir.FunctionType(ir.VoidType(), [BYTE.as_pointer(), SIZE.as_pointer(), SIZE.as_pointer(), BYTE])
THREAD = types.UniTuple(types.int64, 3)  # `vvgt_cli.jit.threads.ThreadSlice`
VALUES, COUNT, TAKEN, FAILED, ERROR = range(5)  # fields of the struct that threads share


# Where compiled code comes from and goes to.


def attach(dispatcher: Any, cached: Any) -> None:
    """Have ``dispatcher`` ask ``cached`` to ``load_overload`` before it compiles, and to ``save_overload`` after."""
    dispatcher._cache = cached


def forbid_calls(dispatcher: Any, message: str) -> None:
    """Have calls of ``dispatcher`` from Python raise a `TypeError`; kernels still call it."""

    def refuse(*args: Any, **keywords: Any) -> None:
        raise TypeError(message)

    dispatcher._compile_for_args = refuse


def dump_result(result: Any) -> bytes:
    """Return what `load_result` needs of a compiled kernel.

    The bitcode that numba keeps for linking is replaced by bare symbols: no kernel calls another, and reading all of it
    would take longer than reading the machine code.
    """
    (name, kind, (code, bitcode)), *rest = result._reduce()
    return bytes(dumps(((name, kind, (code, symbols_of(bitcode))), *rest)))


def symbols_of(bitcode: bytes) -> bytes:
    """Return bitcode that defines the symbols of ``bitcode``, empty."""
    module = llvmlite.binding.parse_bitcode(bitcode)
    symbols = [f'define void @"{f.name}"() {{ unreachable }}' for f in module.functions if not f.is_declaration]
    symbols += [f'@"{v.name}" = global i8 0' for v in module.global_variables if not v.is_declaration]
    return bytes(llvmlite.binding.parse_assembly("\n".join(symbols)).as_bitcode())


def load_result(context: Any, payload: bytes) -> Any:
    """Return the compiled kernel of `dump_result`, loaded into a target ``context``.

    It needs numba's runtime, not what numba can compile (`context.refresh`), whose import takes a sixth of a second.
    """
    rtsys.initialize(context)
    return compiler.CompileResult._rebuild(context, *pickle.loads(payload))


def python_function(value: Any) -> Any:
    """Return the Python function behind a compiled one or an intrinsic; other values as they are."""
    if isinstance(value, Dispatcher):
        return value.py_func
    return getattr(value, "_defn", value) if type(value).__name__ == "_Intrinsic" else value


def options_of(function: Any) -> list[tuple[str, str]] | None:
    """Return the options that a function is compiled with; None for one that is not."""
    if not isinstance(function, Dispatcher):
        return None
    return sorted((k, repr(sorted(v) if isinstance(v, set) else v)) for k, v in function.targetoptions.items())


# What code is compiled for.


@cache
def _host() -> tuple[str, str, str]:
    """Return the target, the processor and its features as numba finds them, which asks the system each time."""
    return cpu_target.target_context.codegen().magic_tuple()


def processor() -> tuple[Any, ...]:
    """Return what machine code depends on: the target, the processor, its features and numba's settings."""
    triple, name, given = _host()
    return triple, name, features(given), [getattr(config, setting, None) for setting in SETTINGS]


def features(known: str) -> str:
    """Return LLVM's features for those that numba knows: wide vectors where they cost no clock.

    LLVM keeps to vectors of 256 bits on Intel's processors with AVX-512, because the clock of the first of them fell
    with wider ones; the splatter's rows of 16 pixels are one vector of 512 bits (docs/log/refinement.md).
    NUMBA_CPU_FEATURES is obeyed.
    """
    if config.CPU_FEATURES is not None or WIDE not in known.split(","):
        return known
    return f"{known},-prefer-256-bit"


def use_wide_vectors() -> None:
    """Compile by `features` in this process; call it before numba has compiled anything."""
    codegen: Any = JITCPUCodegen
    usual = codegen._customize_tm_options

    def customize(self: Any, options: dict[str, Any]) -> None:
        usual(self, options)
        options["features"] = features(options["features"])

    codegen._customize_tm_options = customize


def refresh_targets() -> None:
    """Have numba register all that has been imported: once, rather than in every fork."""
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()


def number_symbols(first: int) -> None:
    """Count the numbers in names of symbols from ``first`` on: those of two kernels in one process must differ."""
    bytecode.FunctionIdentity._unique_ids = itertools.count(first)


# Loops on all threads. `numba.prange` does the same, but has a body typed, outlined and compiled twice.


@cache  # types are asked for more than once
def _compiled(context: Any, dispatcher: Any, kinds: tuple[Any, ...]) -> Any:
    """Return a function for arguments of these types, as intermediate code alone."""
    own = dispatcher._compiler
    flags: Any = compiler.Flags()
    own.targetdescr.options.parse_as_flags(flags, own.targetoptions)
    flags.no_compile = True
    return compiler.compile_extra(context, own.targetdescr.target_context, own.py_func, kinds, types.none, flags, {})


def _on_threads(context: Any, body: Any, values: Any) -> Any:
    """Call ``body(thread, *values)`` once on each of numba's threads; raise what one of them raises."""
    made = _compiled(context, body.dispatcher, (THREAD, *values.types))

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        _launch_threads()  # compiled code finds their functions by name, loaded code too
        context.active_code_library._reload_init.add(_launch_threads)
        context.active_code_library.add_linking_library(made.library)
        shared = ir.LiteralStructType([args[1].type, SIZE, SIZE, CODE, excinfo_ptr_t])
        data = alloca_once(builder, shared)
        threads = get_or_insert_function(builder.module, ir.FunctionType(SIZE, []), "get_num_threads")
        count = builder.call(threads, [])
        count = builder.select(builder.icmp_signed("<", count, SIZE(1)), SIZE(1), count)  # a fork may know of none
        for place, value in ((VALUES, args[1]), (COUNT, count), (TAKEN, SIZE(0)), (FAILED, CODE(0))):
            builder.store(value, cgutils.gep_inbounds(builder, data, 0, place))
        loop = _loop(context, builder, made, values, shared)
        _start(builder, loop, builder.bitcast(data, BYTE), count)
        code, error = (builder.load(cgutils.gep_inbounds(builder, data, 0, place)) for place in (FAILED, ERROR))
        with builder.if_then(builder.icmp_signed("!=", code, CODE(0)), likely=False):
            status = context.call_conv._get_return_status(builder, code, error)
            context.call_conv.return_status_propagate(builder, status)
        return context.get_dummy_value()

    return types.none(body, values), build


def _loop(context: Any, builder: Any, made: Any, values: Any, shared: Any) -> Any:
    """Write the function that numba's threads call for consecutive slices; its first argument tells the first one."""
    loop = ir.Function(builder.module, LOOP, f"{builder.function.name}.parts")
    loop.linkage = "internal"
    inner = ir.IRBuilder(loop.append_basic_block())
    first, counts, _, data = loop.args
    begin = inner.sub(inner.ptrtoint(inner.load(first), SIZE), inner.ptrtoint(data, SIZE))
    held = inner.bitcast(data, shared.as_pointer())
    given, slices = (inner.load(cgutils.gep_inbounds(inner, held, 0, place)) for place in (VALUES, COUNT))
    taken = inner.ptrtoint(cgutils.gep_inbounds(inner, held, 0, TAKEN), SIZE)
    items = [inner.extract_value(given, place) for place in range(len(values))]
    function = context.declare_function(builder.module, made.fndesc)
    with cgutils.for_range(inner, inner.load(counts)) as turn:
        thread = context.make_tuple(inner, THREAD, [inner.add(begin, turn.index), slices, taken])
        status, _ = context.call_conv.call_function(
            inner, function, made.fndesc.restype, made.fndesc.argtypes, [thread, *items]
        )
        with inner.if_then(status.is_error, likely=False):
            inner.store(status.excinfoptr, cgutils.gep_inbounds(inner, held, 0, ERROR))
            inner.store(status.code, cgutils.gep_inbounds(inner, held, 0, FAILED))
    inner.ret_void()
    return loop


def _start(builder: Any, loop: Any, data: Any, count: Any) -> None:
    """Have numba's threads call ``loop`` for ``count`` slices; its first argument is ``data`` plus a slice's number."""
    first, counts, steps = (alloca_once(builder, kind) for kind in (BYTE, SIZE, SIZE))
    for value, place in ((data, first), (count, counts), (SIZE(1), steps)):
        builder.store(value, place)
    kind = ir.FunctionType(ir.VoidType(), [BYTE] * 5 + [SIZE] * 3)
    start = get_or_insert_function(builder.module, kind, "numba_parallel_for")
    with builder.if_else(builder.icmp_signed("==", count, SIZE(1))) as (one, more):
        with one:
            builder.call(loop, [first, counts, steps, data])
        with more:
            pointers = [builder.bitcast(value, BYTE) for value in (loop, first, counts, steps)]
            builder.call(start, [*pointers, data, SIZE(0), SIZE(1), count])


on_threads: Callable[..., Any] | None = None if config.DISABLE_JIT else extending.intrinsic(_on_threads)
