"""The CUDA device that views are drawn and steps are taken on (docs/gpu.md): whether there is one, and its memory."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from vvgt_cli.errors import DataError, UsageError, pip_install

if TYPE_CHECKING:
    from vvgt_cli.dvr import Scene

PACKAGES = {"numba_cuda": "numba-cuda"}  # modules, and what installs them
FREE = 0.5  # of a GPU's memory, below which "auto" leaves it to others


class Gpu(NamedTuple):
    """A GPU: its name, and bytes of memory, free and in all."""

    name: str
    free: int
    total: int

    def text(self) -> str:
        """Return one line."""
        return f"{self.name}, {self.free / 1e9:.1f} of {self.total / 1e9:.1f} GB free"


def missing() -> list[str]:
    """Return the packages for a GPU that are not installed."""
    return [package for module, package in PACKAGES.items() if importlib.util.find_spec(module) is None]


def first_gpu() -> Gpu | None:
    """Return the first CUDA device; None where there is none, or it does not answer."""
    if importlib.util.find_spec("numba_cuda") is None:
        return None
    from numba import cuda

    try:
        name = cuda.get_current_device().name
        free, total = cuda.current_context().get_memory_info()
    except Exception:  # the driver's errors, and that there is none, share no class
        return None
    return Gpu(name.decode() if isinstance(name, bytes) else name, int(free), int(total))


def chosen(device: str) -> str:
    """Return "cpu" or "cuda": "auto" is a GPU that is there and has at least half its memory free, else the CPU.

    Raises:
        UsageError: "cuda" without the packages that it needs.
        DataError: "cuda" without a CUDA device.
    """
    if device == "cpu":
        return device
    absent = missing()
    gpu = None if absent else first_gpu()
    if device == "auto":
        return "cuda" if gpu is not None and gpu.free >= FREE * gpu.total else "cpu"
    if absent:
        raise UsageError(f"--device cuda needs {', '.join(absent)}: {pip_install('cuda')}, or use --device cpu")
    if gpu is None:
        raise DataError("--device cuda: no CUDA device found; check the driver (nvidia-smi), or use --device cpu")
    return "cuda"


def describe() -> str:
    """Return what there is of a GPU, for people."""
    if absent := missing():
        return f"none that could be used: {', '.join(absent)} not installed ({pip_install('cuda')})"
    gpu = first_gpu()
    return "none found" if gpu is None else gpu.text()


def on_device(scene: Scene, device: str, report: Callable[[str], None]) -> Scene:
    """Return the scene with its rays cast on ``device``, "cpu" or "cuda"; where that fails, ``report`` gets a line."""
    if device == "cpu":
        return scene
    if scene.grid is not None:
        report("labels and layers are drawn on the CPU; a GPU draws one volume under a function")
        return scene
    from vvgt_cli.dvr.cuda import DeviceRays

    return replace(scene, rays=DeviceRays(scene, report))
