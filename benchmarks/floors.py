"""What this machine does at best, and medians of alternated repeats: shared by the benchmarks here."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable

import numpy as np


def bandwidth() -> float:
    """Bytes a second that one thread reads and writes, from a copy of 64 MiB."""
    source, target = np.ones(1 << 26, np.uint8), np.ones(1 << 26, np.uint8)
    return 2 * source.nbytes / min(seconds(lambda: np.copyto(target, source)) for _ in range(5))


def flops(dtype: type) -> float:
    """Arithmetic a second with all threads, from a matrix product of 1024 x 1024."""
    a = np.ones((1024, 1024), dtype)
    return 2 * 1024**3 / min(seconds(lambda: a @ a) for _ in range(5))


def seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def alternate(calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median seconds of each call; one of each in turn, so that a change of load meets them all."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()  # compiles
    for _ in range(repeats):
        for name, call in calls.items():
            times[name].append(seconds(call))
    return {name: statistics.median(values) for name, values in times.items()}


def machine() -> str:
    """One line: processor, threads of the kernels, load."""
    import numba

    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return f"{platform.processor() or platform.machine()}, {numba.get_num_threads()} threads, load {load:.1f}"
