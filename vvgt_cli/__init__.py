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
    from vvgt_cli.cameras import Camera as Camera
    from vvgt_cli.cameras import default_views as default_views
    from vvgt_cli.cameras import orbit_views as orbit_views
    from vvgt_cli.commands.check import check as check
    from vvgt_cli.commands.convert import convert as convert
    from vvgt_cli.commands.evaluate import evaluate as evaluate
    from vvgt_cli.commands.infer import infer as infer
    from vvgt_cli.commands.info import info as info
    from vvgt_cli.commands.init import init as init
    from vvgt_cli.commands.optimize import optimize as optimize
    from vvgt_cli.commands.recolor import recolor as recolor
    from vvgt_cli.commands.render import render as render
    from vvgt_cli.commands.render_views import render_views as render_views
    from vvgt_cli.commands.report import report as report
    from vvgt_cli.commands.session import Session as Session
    from vvgt_cli.commands.session import read_ply as read_ply
    from vvgt_cli.commands.session import read_volume as read_volume
    from vvgt_cli.commands.synth import synth as synth
    from vvgt_cli.commands.view import view as view
    from vvgt_cli.commands.voxelize import voxelize as voxelize
    from vvgt_cli.conversion.clouds import Clouds as Clouds
    from vvgt_cli.conversion.result import Conversion as Conversion
    from vvgt_cli.conversion.result import Result as Result
    from vvgt_cli.errors import DataError as DataError
    from vvgt_cli.errors import UsageError as UsageError
    from vvgt_cli.errors import VvgtError as VvgtError
    from vvgt_cli.gaussians import Gaussians as Gaussians
    from vvgt_cli.gaussians import PlyHeader as PlyHeader
    from vvgt_cli.integrations.pyvista import export_plotter as export_plotter
    from vvgt_cli.library.inputs import Look as Look
    from vvgt_cli.look import ColorMap as ColorMap
    from vvgt_cli.look import LightOptions as LightOptions
    from vvgt_cli.look import PiecewiseOpacity as PiecewiseOpacity
    from vvgt_cli.look import TransferFunction as TransferFunction
    from vvgt_cli.look import read_transfer_function as read_transfer_function
    from vvgt_cli.volume import Volume as Volume

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

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    """Import a public name on its first use."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    """List public names, those not yet imported included."""
    return sorted([*globals(), *_MODULES])
