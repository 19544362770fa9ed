"""Kernels of a CUDA device: compiled by numba-cuda, kept on disk, and recorded so that one call starts many of them.

What kernels of the CPU call, functions marked `inlined`, kernels of a device call as well.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

import numba
import numpy as np
from numba import cuda as numba_cuda

from vvgt_cli.jit.cache import source_digest
from vvgt_cli.jit.compile import usual_types

cuda: Any = numba_cuda  # which numba-cuda replaces
config: Any = numba.config
config.CUDA_LOW_OCCUPANCY_WARNINGS = False
SIMULATED = bool(config.ENABLE_CUDASIM)  # kernels run in Python, a thread of the processor each, for tests


@cache
def _kept() -> Any:
    """Return numba-cuda's cache of a kernel, by the sources of all that it calls: numba looks at its own alone."""
    from numba.cuda.dispatcher import CUDACache

    class Kept(CUDACache):
        def _index_key(self, sig: Any, codegen: Any) -> Any:
            key: Any = super()._index_key(sig, codegen)  # type: ignore[no-untyped-call]
            return *key, _digest(self._py_func)

    return Kept


_digest = cache(source_digest)


def gpu_kernel(usual: str = "", **options: Any) -> Callable[[Callable[..., None]], Any]:
    """Compile a function for the device, where it is called as ``function[blocks, threads, stream](...)``.

    Args:
        usual: types of its arguments, for `load`, as of `vvgt_cli.jit.decorators.kernel`.
        **options: of ``numba.cuda.jit``.
    """

    def wrap(function: Callable[..., None]) -> Any:
        made = cuda.jit(**options)(function)
        with contextlib.suppress(RuntimeError):  # there is no folder to keep it in
            if not SIMULATED:
                made._cache = _kept()(function)
        made.usual, made.tuples = usual, {}
        return made

    return wrap


def load(kernels: Iterable[Any]) -> None:
    """Load kernels for their usual types from disk; compile what is not there."""
    for kernel in kernels:
        kernel.compile(usual_types(kernel, ""))


class Recorded:
    """Launches that are made again and again: a CUDA graph from the second time on.

    The kernels, and the arrays that they are given, must stay the same.
    """

    def __init__(self, launch: Callable[[], None], stream: Any) -> None:
        """Take a function that launches kernels on ``stream``, does not wait and allocates nothing."""
        self.launch, self.stream, self.graph, self.calls = launch, stream, None, 0

    def __call__(self) -> None:
        """Start the launches."""
        self.calls += 1
        if self.calls == 2 and not SIMULATED:
            self.graph = self._record()
        if self.graph is None:
            self.launch()  # the first time: kernels are loaded
        else:
            _driver("cuGraphLaunch", self.graph, int(self.stream))

    def _record(self) -> Any:
        """Return the executable graph; it lives as long as the process."""
        from cuda.bindings import driver

        local = driver.CUstreamCaptureMode.CU_STREAM_CAPTURE_MODE_THREAD_LOCAL
        _driver("cuStreamBeginCapture", int(self.stream), local)
        try:
            self.launch()
        finally:
            graph = _driver("cuStreamEndCapture", int(self.stream))
        return _driver("cuGraphInstantiate", graph, 0)


def _driver(name: str, *args: Any) -> Any:
    """Call a function of the CUDA driver.

    Raises:
        OSError: it fails.
    """
    from cuda.bindings import driver

    error, *values = getattr(driver, name)(*args)
    if error != driver.CUresult.CUDA_SUCCESS:
        raise OSError(f"{name}: {error.name}")
    return values[0] if values else None


def sent(value: Any, stream: Any = 0) -> Any:
    """Return arrays, or tuples of them, with the arrays on the device; a copy of each."""
    if isinstance(value, tuple):
        made = [sent(part, stream) for part in value]
        return value._make(made) if hasattr(value, "_make") else tuple(made)
    if isinstance(value, np.ndarray):
        return cuda.to_device(np.ascontiguousarray(value), stream)
    return value


def size_of(value: Any) -> int:
    """Return the bytes of arrays, or of tuples of them."""
    return sum(map(size_of, value)) if isinstance(value, tuple | list) else int(getattr(value, "nbytes", 0))


def free_bytes() -> float:
    """Return the bytes of memory that are free on the device."""
    return float(cuda.current_context().get_memory_info()[0])
