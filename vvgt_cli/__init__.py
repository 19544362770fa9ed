"""The library of VVGT, which turns scientific volumes into 3D Gaussian splats; see docs/python.md.

>>> import vvgt_cli as vvgt
>>> result = vvgt.convert("example:blob:16", max_gaussians=50, screen=48, steps=0)
>>> len(result.gaussians) <= 50
True
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

from vvgt_cli.version import VERSION

# Read when numba is imported. With TBB a parallel region costs the more the more have run before (docs/log/kernels.md).
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")
# Threads that wait for the next region sleep, and leave the processors to others.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__version__ = VERSION

if TYPE_CHECKING:
    from vvgt_cli.cameras import Camera, default_views, orbit_views
    from vvgt_cli.commands.check import check
    from vvgt_cli.commands.convert import convert
    from vvgt_cli.commands.evaluate import evaluate
    from vvgt_cli.commands.infer import infer
    from vvgt_cli.commands.info import info
    from vvgt_cli.commands.init import init
    from vvgt_cli.commands.optimize import optimize
    from vvgt_cli.commands.recolor import recolor
    from vvgt_cli.commands.render import render
    from vvgt_cli.commands.render_views import render_views
    from vvgt_cli.commands.report import report
    from vvgt_cli.commands.session import Session, read_ply, read_volume
    from vvgt_cli.commands.synth import synth
    from vvgt_cli.commands.view import view
    from vvgt_cli.commands.voxelize import voxelize
    from vvgt_cli.conversion.clouds import Clouds
    from vvgt_cli.conversion.result import Conversion, Result
    from vvgt_cli.errors import DataError, UsageError, VvgtError
    from vvgt_cli.gaussians import Gaussians, PlyHeader
    from vvgt_cli.integrations.pyvista import export_plotter
    from vvgt_cli.library.inputs import Look
    from vvgt_cli.look import ColorMap, LightOptions, PiecewiseOpacity, TransferFunction, read_transfer_function
    from vvgt_cli.volume import Volume

_WHERE = {  # imported on first use, so that `import vvgt_cli` costs nothing
    "cameras": ("Camera", "default_views", "orbit_views"),
    "errors": ("DataError", "UsageError", "VvgtError"),
    "gaussians": ("Gaussians", "PlyHeader"),
    "integrations.pyvista": ("export_plotter",),
    "commands.session": ("Session", "read_ply", "read_volume"),
    "library.inputs": ("Look",),
    "conversion.clouds": ("Clouds",),
    "conversion.result": ("Conversion", "Result"),
    "look": ("ColorMap", "PiecewiseOpacity", "TransferFunction", "read_transfer_function"),
    "look.lighting": ("LightOptions",),
    "volume": ("Volume",),
    **{f"commands.{name}": (name,) for name in ("check", "convert", "evaluate", "infer", "info", "init", "optimize")},
    **{
        f"commands.{name}": (name,)
        for name in ("recolor", "render", "render_views", "report", "synth", "view", "voxelize")
    },
}
_MODULES = {name: module for module, names in _WHERE.items() for name in names}

__all__ = [
    "Camera",
    "Clouds",
    "ColorMap",
    "Conversion",
    "DataError",
    "Gaussians",
    "LightOptions",
    "Look",
    "PiecewiseOpacity",
    "PlyHeader",
    "Result",
    "Session",
    "TransferFunction",
    "UsageError",
    "Volume",
    "VvgtError",
    "check",
    "convert",
    "default_views",
    "evaluate",
    "export_plotter",
    "infer",
    "info",
    "init",
    "optimize",
    "orbit_views",
    "read_ply",
    "read_transfer_function",
    "read_volume",
    "recolor",
    "render",
    "render_views",
    "report",
    "synth",
    "view",
    "voxelize",
]


def __getattr__(name: str) -> Any:
    """Import a public name on its first use."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    """List public names, those not yet imported included."""
    return sorted([*globals(), *_MODULES])
