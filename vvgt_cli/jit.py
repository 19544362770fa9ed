"""How the functions that kernels call are compiled."""

from __future__ import annotations

from typing import Any

import numba as nb


def inlined(**options: Any) -> Any:
    """``numba.njit`` for functions that other kernels call: always inlined, kept on disk.

    A function that LLVM leaves out of line exists twice, compiled on its own and within its caller's library. The
    process that compiles runs the first copy, later ones that load the caller from disk run the second, and the two may
    round sums differently: the first run's bytes would differ from the second's.
    """
    return nb.njit(cache=True, forceinline=True, **options)
