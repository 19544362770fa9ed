"""Loops that threads share: a kernel's body runs once on each thread, and asks which iterations are its own.

`iterations` are a fixed stretch of the loop; `next_iteration` takes the next one that no thread has taken, by an atomic
counter, where iterations take unlike times. Either way an iteration writes places of its own, so that results do not
depend on the number of threads.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from inspect import signature
from typing import Any, TypeAlias

import numba as nb
from numba import extending, types

from vvgt_cli.jit.numba_internals import NO_ENTRY, SIZE, config, on_threads

ThreadSlice: TypeAlias = tuple[int, int, Any]  # number of the thread, of how many, where they count iterations taken
U = nb.uint64  # an index that cannot be negative needs no test


@nb.njit(forceinline=True, **NO_ENTRY)  # type: ignore[untyped-decorator]
def iterations(thread: ThreadSlice, count: int) -> range:
    """Return the iterations, of a loop of ``count``, that are the thread's own: a stretch of them."""
    return range(U(thread[0] * count // thread[1]), U((thread[0] + 1) * count // thread[1]))


def _next_iteration(context: Any, thread: Any) -> Any:
    """Return the next iteration of a loop that no thread has taken."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        taken = builder.inttoptr(builder.extract_value(args[0], 2), SIZE.as_pointer())
        return builder.atomic_rmw("add", taken, SIZE(1), "monotonic")

    return types.int64(thread), build


next_iteration: Any = (lambda thread: next(thread[2])) if config.DISABLE_JIT else extending.intrinsic(_next_iteration)


def on_all_threads(body: Any, name: str) -> Callable[..., None]:
    """Return the function ``name`` that runs ``body(thread, ...)`` on numba's threads, with the body's arguments.

    Args:
        body: a compiled function without a result; plain Python where numba is off, which runs once.
        name: of the new function, which has the body's docstring and module.
    """
    function = getattr(body, "py_func", body)
    if on_threads is None:
        return lambda *args, **keywords: function((0, 1, itertools.count()), *args, **keywords)
    names = ", ".join(list(signature(function).parameters)[1:])
    scope = {"body": body, "run": on_threads, "__name__": function.__module__}
    exec(f"def {name}({names}):\n    run(body, ({names},))", scope)
    made: Any = scope[name]
    made.__module__, made.__qualname__, made.__doc__ = function.__module__, name, function.__doc__
    return made
