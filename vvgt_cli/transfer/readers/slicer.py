"""Volume properties of 3D Slicer: ``.vp`` (lines of numbers), ``.vp.json``, and presets that carry the lines as fields.

``.vp`` has nine lines: interpolation, shading, diffuse, ambient, specular, specular power, then scalar opacity,
gradient opacity and colours, each a count of numbers and the numbers, (x, opacity) or (x, r, g, b). ``.vp.json`` names
the same, with midpoints and sharpness, once a component; the first component is read. Opacity is per
``scalarOpacityUnitDistance`` in millimetres; the old format has none and VTK's default of 1 is taken. Lighting is left
out; so is gradient opacity, and the function's name says so where there is any. A JSON object with ``scalarOpacity``
and ``colorTransfer`` as such lines of text, as viewers on vtk.js keep Slicer's presets, is read as well.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.transfer.colormap import ColorMap
from vvgt_cli.transfer.function import TransferFunction
from vvgt_cli.transfer.opacity import PiecewiseOpacity
from vvgt_cli.transfer.readers import paraview
from vvgt_cli.transfer.readers.fields import Lines, floats, named, number, rgb

UNIT_DISTANCE = 1.0  # vtkVolumeProperty's


def matches(parsed: Any) -> bool:
    """Whether it is a volume property of any of the three forms."""
    if isinstance(parsed, Lines):
        return True
    if isinstance(parsed, dict) and "volumeProperties" in parsed:
        return True
    presets = parsed if isinstance(parsed, list) else [parsed]
    return bool(presets) and all(isinstance(p, dict) and {"scalarOpacity", "colorTransfer"} <= set(p) for p in presets)


def read(parsed: Any, what: str, pick: str = "") -> TransferFunction:
    """The function of a volume property.

    Raises:
        DataError: too few lines, a count that is not that of the numbers, a field that is not what it must be, several
            presets and no ``pick``, or ``pick`` where there are none.
    """
    if pick and not (isinstance(parsed, list) or "colorTransfer" in getattr(parsed, "keys", dict)()):
        raise DataError(f"{what}: one function, no presets to pick {pick!r} from; leave out #{pick}")
    try:
        if isinstance(parsed, Lines):
            if len(parsed.items) < 9:
                raise DataError(f"{len(parsed.items)} lines of numbers; expected the nine of a volume property (.vp)")
            return _of_lines("volume property", *parsed.items[6:9])
        if isinstance(parsed, dict) and "volumeProperties" in parsed:
            return _of_json(parsed)
        presets = [{**p, "Name": p.get("name", "")} for p in (parsed if isinstance(parsed, list) else [parsed])]
        preset = paraview.choose(presets, what, pick)
        fields = (preset["scalarOpacity"], preset.get("gradientOpacity", ""), preset["colorTransfer"])
        if not all(isinstance(field, str) for field in fields):
            raise DataError("scalarOpacity, gradientOpacity and colorTransfer; expected text, a count and numbers each")
        return _of_lines(str(preset["Name"]) or "volume property", *fields)
    except DataError as error:
        raise error if str(error).startswith(what) else named(what, error) from error


def _counted(what: str, line: str, width: int) -> np.ndarray:
    """A line of a count and as many numbers, as rows."""
    count, *values = floats(what, line)
    if count != len(values) or not values or len(values) % width:
        raise DataError(f"{what}: {len(values)} numbers after the count {count:g}; expected that many, {width} a node")
    return np.array(values).reshape(-1, width)


def _of_lines(name: str, opacity: str, gradient: str, color: str) -> TransferFunction:
    nodes, colors = _counted("scalar opacity", opacity, 2), _counted("colours", color, 4)
    slopes = _counted("gradient opacity", gradient, 2)[:, 1] if gradient.strip() else np.ones(1)
    return TransferFunction(
        name + _left_out(bool((slopes != 1).any())),
        PiecewiseOpacity(*nodes.T),
        ColorMap(colors[:, 0], colors[:, 1:]),
        UNIT_DISTANCE,
    )


def _left_out(gradient: bool) -> str:
    return " (gradient opacity left out)" if gradient else ""


def _of_json(parsed: dict[str, Any]) -> TransferFunction:
    properties = parsed["volumeProperties"]
    first = properties[0] if isinstance(properties, list) and properties else None
    parts = first.get("components") if isinstance(first, dict) else None
    if not isinstance(parts, list) or not parts or not isinstance(parts[0], dict):
        raise DataError("volumeProperties; expected a list of objects with components")
    part = parts[0]
    opacity = [(_x(p), number("scalarOpacity y", p.get("y")), *_bend(p)) for p in _points(part, "scalarOpacity")]
    key = "rgbTransferFunction" if "rgbTransferFunction" in part else "grayTransferFunction"
    points = _points(part, key)
    if key == "rgbTransferFunction":
        colors = [rgb(f"{key} color", p.get("color")) for p in points]
    else:
        colors = [(grey, grey, grey) for grey in (number(f"{key} y", p.get("y")) for p in points)]
    bends = np.array([_bend(p) for p in points])
    gradient = part.get("gradientOpacity") and not part.get("disableGradientOpacity")
    slopes = [p.get("y") for p in _points(part, "gradientOpacity")] if gradient else []
    distance = number("scalarOpacityUnitDistance", part.get("scalarOpacityUnitDistance", UNIT_DISTANCE))
    return TransferFunction(
        "volume property" + _left_out(any(y != 1 for y in slopes)),
        PiecewiseOpacity(*np.array(opacity).T),
        ColorMap(np.array([_x(p) for p in points]), np.array(colors), bends[:, 0], bends[:, 1]),
        distance,
    )


def _points(part: dict[str, Any], key: str) -> list[dict[str, Any]]:
    function = part.get(key)
    points = function.get("points") if isinstance(function, dict) else None
    if not isinstance(points, list) or not points or not all(isinstance(p, dict) for p in points):
        raise DataError(f"{key}; expected an object with points")
    return points


def _x(point: dict[str, Any]) -> float:
    return number("x", point.get("x"))


def _bend(point: dict[str, Any]) -> tuple[float, float]:
    return number("midpoint", point.get("midpoint", 0.5)), number("sharpness", point.get("sharpness", 0.0))
