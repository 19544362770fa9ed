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
from vvgt_cli.jit.numba_internals import BORROWED, INLINED, NO_C_ENTRY, NO_ENTRY, attach, config, forbid_calls
from vvgt_cli.jit.threads import ThreadSlice, on_all_threads

P = ParamSpec("P")
F = TypeVar("F", bound=Callable[..., Any])  # a kernel is called as the function that it is made of


def kernel(usual: str = "", tuples: Mapping[type, str] | None = None, **options: Any) -> Callable[[F], F]:
    """Compile a function that Python calls: in another process, to be loaded from disk.

    It runs without the interpreter's lock, so that a signal is answered meanwhile (`vvgt_cli.commands.process`).

    Args:
        usual: types of the arguments as commands pass them: "f4:2 i8" is a C-contiguous float32 array of two axes and
            an int64, "V" a volume's values, "E" an extinction, "none" is None. They are compiled ahead
            (`vvgt_cli.jit.ahead`), other types when they are met.
        tuples: types of the fields of the named tuples whose names ``usual`` holds.
        **options: of ``numba.njit``.

    Returns:
        A decorator.
    """

    def wrap(function: F) -> F:
        made: Any = nb.njit(nogil=True, **NO_C_ENTRY, **options)(function)
        if hasattr(made, "py_func"):  # with NUMBA_DISABLE_JIT it is the function
            made.usual, made.tuples, made.kernel_cache = usual, tuples or {}, KernelCache(made)
            attach(made, made.kernel_cache)
        return cast(F, made)

    return wrap


def parallel_kernel(
    usual: str = "", tuples: Mapping[type, str] | None = None, name: str = "", **options: Any
) -> Callable[[Callable[Concatenate[ThreadSlice, P], None]], Callable[P, None]]:
    """Compile a function without a result that runs at once on all of numba's threads; else as `kernel`.

    Args:
        usual: types of the arguments but the first, the `vvgt_cli.jit.threads.ThreadSlice` that Python does not pass.
        tuples: as of `kernel`.
        name: of the kernel, where several are made of one function; by default the function's.
        **options: of ``numba.njit``.

    Returns:
        A decorator.
    """

    def wrap(function: Callable[Concatenate[ThreadSlice, P], None]) -> Callable[P, None]:
        body = nb.njit(**NO_ENTRY, **options)(function)
        made = on_all_threads(body, name or function.__name__)
        return made if config.DISABLE_JIT else kernel(usual, tuples)(made)

    return wrap


def inlined(borrowed: bool = False, **options: Any) -> Callable[[F], F]:
    """Compile a function that only kernels call: inlined always, without an entry for Python.

    The entries would take a quarter of the time of compiling.

    Args:
        borrowed: arrays are not reference-counted within it, nor in named tuples: counting costs 100 ns a ray.
        **options: of ``numba.njit``.

    Returns:
        A decorator.
    """

    def wrap(function: F) -> F:
        made: Any = nb.njit(**INLINED, **(BORROWED if borrowed else {}), **options)(function)
        if hasattr(made, "py_func"):
            forbid_calls(made, f"{function.__qualname__} is called by kernels only; call its .py_func")
        return cast(F, made)

    return wrap


def intrinsic(typed: Callable[..., tuple[Any, Any]]) -> Callable[..., Any]:
    """Make ``typed``, a ``numba.extending.intrinsic``, callable from kernels, without its first argument.

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
