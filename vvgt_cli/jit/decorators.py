"""Typed decorators of compiled functions.

`kernel` marks what Python calls, `parallel_kernel` what all threads run at once, `inlined` what kernels call,
`intrinsic` what writes LLVM instructions itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

import numba as nb
from numba import extending

from vvgt_cli.errors import UsageError
from vvgt_cli.jit.cache import KernelCache
from vvgt_cli.jit.parts import NO_C_ENTRY, NO_ENTRY, Part, shared, whole
from vvgt_cli.jit.target import config

P = ParamSpec("P")
F = TypeVar("F", bound=Callable[..., Any])  # a kernel is called as the function that it is made of


def kernel(usual: str = "", tuples: Mapping[type, str] | None = None, **options: Any) -> Callable[[F], F]:
    """``numba.njit`` for functions that Python calls: compiled in another process, loaded from disk.

    They run without the interpreter's lock, so that a signal is answered while they do (`vvgt_cli.cli.process`).

    Args:
        usual: types of the arguments as commands pass them: "f4:2 i8" is a C-contiguous float32 array of two axes and
            an int64, "V" a volume's values. What is compiled ahead (`vvgt_cli.jit.ahead`); other types are compiled
            when they are met.
        tuples: the types of the fields of the named tuples whose names ``usual`` holds.
        options: of ``numba.njit``.
    """

    def wrap(function: F) -> F:
        made: Any = nb.njit(nogil=True, **NO_C_ENTRY, **options)(function)
        if hasattr(made, "py_func"):  # with NUMBA_DISABLE_JIT it is the function
            made._cache = KernelCache(made)
            made.usual, made.tuples = usual, tuples or {}
        return cast(F, made)

    return wrap


def parallel_kernel(
    usual: str = "", tuples: Mapping[type, str] | None = None, **options: Any
) -> Callable[[Callable[Concatenate[Part, P], None]], Callable[P, None]]:
    """`kernel` for functions without a result, run at once on all of numba's threads.

    The first argument of each call, `vvgt_cli.jit.parts.Part`, says which turns of a loop are its own; Python does not
    pass it.
    """

    def wrap(function: Callable[Concatenate[Part, P], None]) -> Callable[P, None]:
        if config.DISABLE_JIT:

            def alone(*args: P.args, **keywords: P.kwargs) -> None:
                function(whole(), *args, **keywords)

            return alone
        body = nb.njit(**NO_ENTRY, **options)(function)
        return kernel(usual, tuples)(shared(body, function.__name__))

    return wrap


def inlined(**options: Any) -> Callable[[F], F]:
    """``numba.njit`` for functions that only kernels call: inlined always, without an entry for Python.

    The entries would take a quarter of the time of compiling.
    """

    def wrap(function: F) -> F:
        made: Any = nb.njit(forceinline=True, **NO_ENTRY, **options)(function)
        if hasattr(made, "py_func"):

            def refuse(*args: Any, **keywords: Any) -> None:
                raise TypeError(f"{function.__qualname__} is called by kernels only; call its .py_func")

            made._compile_for_args = refuse
        return cast(F, made)

    return wrap


def intrinsic(typed: Callable[..., tuple[Any, Any]]) -> Callable[..., Any]:
    """``numba.extending.intrinsic``: kernels call the result without the first argument of ``typed``.

    Raises:
        UsageError: on a call outside compiled code, where ``NUMBA_DISABLE_JIT`` is set.
    """
    if not config.DISABLE_JIT:
        return cast(Callable[..., Any], extending.intrinsic(typed))

    def refuse(*_: Any) -> None:
        raise UsageError(
            "NUMBA_DISABLE_JIT is set, but rendering a volume uses vector instructions that Python does not have; "
            "unset it or set it to 0 (rendering Gaussians alone, as in vvgt render, works with it set)"
        )

    return refuse
