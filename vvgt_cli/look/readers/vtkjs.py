"""vtk.js presets: ParaView's, with opacity as ``OpacityPoints`` (ParaView Glance, VolView).

``OpacityPoints`` is flat (x, opacity), without midpoint and sharpness; colours are read as ParaView's.
"""

from __future__ import annotations

from typing import Any

from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.readers import paraview
from vvgt_cli.look.readers.fields import table


def matches(parsed: Any) -> bool:
    """Whether parsed JSON is a preset or an array of presets, some with OpacityPoints."""
    presets = parsed if isinstance(parsed, list) else [parsed]
    return paraview.matches(parsed) and any("OpacityPoints" in preset for preset in presets)


def read(parsed: Any, what: str, pick: str = "") -> TransferFunction:
    """One preset as a `TransferFunction` on data values.

    Raises:
        DataError: as `paraview.read`.
    """
    preset = dict(paraview.choose(parsed if isinstance(parsed, list) else [parsed], what, pick))
    if "OpacityPoints" in preset:
        nodes = table(f"{what}: OpacityPoints", preset["OpacityPoints"], 2, "x, opacity")
        preset["Points"] = [number for x, y in nodes.tolist() for number in (x, y, 0.5, 0.0)]
    return paraview.read(preset, what)
