"""Volume properties of 3D Slicer: ``.vp`` (lines of numbers), ``.vp.json``, ``presets.xml``, and presets as JSON.

``.vp`` has nine lines: interpolation, shading, diffuse, ambient, specular, specular power, then scalar opacity,
gradient opacity and colours, each a count of numbers and the numbers, (x, opacity) or (x, r, g, b). ``.vp.json`` names
the same, with midpoints and sharpness, once a component; the first component is read. Ours
(`vvgt_cli.integrations.vtk_property`) has more of VTK's function in it: ``colorSpace``, ``hsvWrap``, ``useLogScale``,
``nanColor``. Opacity is per ``scalarOpacityUnitDistance``; the other forms have none and VTK's default of 1 is taken.
MRML (``presets.xml``, scenes) has a ``VolumeProperty`` element a preset, with the lines of ``.vp`` as attributes
(``scalarOpacity``, ``gradientOpacity``, ``colorTransfer``, ``shade``, ``ambient``, ...); viewers on vtk.js keep the
same as JSON. Where shading is on, the function has the head-light of VTK's viewers with the file's coefficients
(`vvgt_cli.look.lighting`). Gradient opacity is not used, which a warning says where a file asks for it.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, naming
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.lighting import Lighting, preset_lighting
from vvgt_cli.look.readers import paraview
from vvgt_cli.look.readers.fields import Elements, Lines, floats, number, rgb

UNIT_DISTANCE = 1.0  # vtkVolumeProperty's
DEFAULT = "VTK's default"  # what that distance is called
_LIGHT = {"ambient": "ambient", "diffuse": "diffuse", "specular": "specular", "specularPower": "specular_power"}


def matches(parsed: Any) -> bool:
    """Return whether it is a volume property in any of the forms."""
    if isinstance(parsed, Lines):
        return True
    if isinstance(parsed, Elements):
        return any(tag == "volumeproperty" for tag, _ in parsed.items)
    if isinstance(parsed, dict) and "volumeProperties" in parsed:
        return True
    presets = parsed if isinstance(parsed, list) else [parsed]
    return bool(presets) and all(isinstance(p, dict) and {"scalarOpacity", "colorTransfer"} <= set(p) for p in presets)


def read(parsed: Any, what: str, pick: str = "") -> TransferFunction:
    """Return the function of a volume property, of several the preset ``pick``, or raise DataError."""
    several = isinstance(parsed, list | Elements) or "colorTransfer" in getattr(parsed, "keys", dict)()
    if pick and not several:
        raise DataError(f"{what}: holds one function, no presets; omit #{pick}")
    with naming(what):
        if isinstance(parsed, Lines):
            if len(parsed.items) < 9:
                raise DataError(f"{len(parsed.items)} lines of numbers; expected the nine of a volume property (.vp)")
            keys = ("shade", "diffuse", "ambient", "specular", "specularPower")
            fields = dict(zip(("scalarOpacity", "gradientOpacity", "colorTransfer"), parsed.items[6:9], strict=True))
            return _of_fields("volume property", fields | dict(zip(keys, parsed.items[1:6], strict=True)), what)
        if isinstance(parsed, dict) and "volumeProperties" in parsed:
            return _of_json(parsed, what)
        if isinstance(parsed, Elements):
            nodes = [dict(attributes) for tag, attributes in parsed.items if tag == "volumeproperty"]
        else:
            nodes = parsed if isinstance(parsed, list) else [parsed]
        preset = paraview.choose([{**p, "Name": p.get("name", "")} for p in nodes], what, pick)
        shown = f"{what}#{pick}" if pick else what
        return _of_fields(str(preset["Name"]) or "volume property", preset, shown)


def _counted(what: str, line: str, width: int) -> np.ndarray:
    """Return the numbers of a line, after their count, as rows."""
    count, *values = floats(what, line)
    if count != len(values) or not values or len(values) % width:
        raise DataError(f"{what}: {len(values)} numbers after the count {count:g}; expected that many, {width} a node")
    return np.array(values).reshape(-1, width)


def _of_fields(name: str, fields: Mapping[str, Any], what: str) -> TransferFunction:
    """Return the function of a preset with ``scalarOpacity``, ``gradientOpacity``, ``colorTransfer`` as lines."""
    opacity, gradient, color = (fields.get(key, "") for key in ("scalarOpacity", "gradientOpacity", "colorTransfer"))
    if not all(isinstance(field, str) for field in (opacity, gradient, color)):
        raise DataError("scalarOpacity, gradientOpacity and colorTransfer; expected text, a count and numbers each")
    nodes, colors = _counted("scalar opacity", opacity, 2), _counted("colours", color, 4)
    slopes = _counted("gradient opacity", gradient, 2)[:, 1] if gradient.strip() else np.ones(1)
    _warn_unused(what, bool((slopes != 1).any()))
    distance = fields.get("scalarOpacityUnitDistance")
    label = "file" if distance is not None else DEFAULT
    return TransferFunction(
        name,
        PiecewiseOpacity(*nodes.T),
        ColorMap(colors[:, 0], colors[:, 1:]),
        UNIT_DISTANCE if distance is None else floats("scalarOpacityUnitDistance", str(distance))[0],
        opacity_unit_label=label,
        lighting=_lighting(what, fields),
    )


def _warn_unused(what: str, gradient: bool) -> None:
    """Warn that a file's gradient opacity is not used."""
    if gradient:
        warnings.warn(f"{what}: gradient opacity not used", stacklevel=3)


def _lighting(what: str, fields: Mapping[str, Any]) -> Lighting | None:
    """Return the light of a shaded volume property, else None."""
    shade = str(fields.get("shade", "")).strip().lower() in ("1", "true")
    given = {name: floats(key, str(fields[key]))[0] for key, name in _LIGHT.items() if key in fields} if shade else {}
    return preset_lighting(what, shade, given)


def _of_json(parsed: dict[str, Any], what: str) -> TransferFunction:
    properties = parsed["volumeProperties"]
    first = properties[0] if isinstance(properties, list) and properties else None
    first = first if isinstance(first, dict) else {}
    components = first.get("components")
    if not isinstance(components, list) or not components or not isinstance(components[0], dict):
        raise DataError("volumeProperties; expected a list of objects with components")
    component = components[0]
    opacity = [(_x(p), number("scalarOpacity y", p.get("y")), *_bend(p)) for p in _points(component, "scalarOpacity")]
    key = "rgbTransferFunction" if "rgbTransferFunction" in component else "grayTransferFunction"
    points = _points(component, key)
    if key == "rgbTransferFunction":
        colors = [rgb(f"{key} color", p.get("color")) for p in points]
    else:
        colors = [(grey, grey, grey) for grey in (number(f"{key} y", p.get("y")) for p in points)]
    if not isinstance(component[key].get("hsvWrap", True), bool):
        raise DataError(f"{key} hsvWrap: {component[key]['hsvWrap']!r}; expected true or false")
    bends, more = np.array([_bend(p) for p in points]), component[key]
    space = str(more.get("colorSpace", "RGB"))
    gradient = component.get("gradientOpacity") and not component.get("disableGradientOpacity")
    slopes = [p.get("y") for p in _points(component, "gradientOpacity")] if gradient else []
    lighting = component.get("lighting")
    light = {**(lighting if isinstance(lighting, dict) else {}), "shade": component.get("shade")}
    _warn_unused(what, any(y != 1 for y in slopes))
    distance = number("scalarOpacityUnitDistance", component.get("scalarOpacityUnitDistance", UNIT_DISTANCE))
    return TransferFunction(
        "volume property",
        PiecewiseOpacity(*np.array(opacity).T),
        ColorMap(
            np.array([_x(p) for p in points]),
            np.array(colors),
            bends[:, 0],
            bends[:, 1],
            space=space,
            hsv_wrap=more.get("hsvWrap", True),
            log_scale=bool(more.get("useLogScale", False)),
            nan_color=rgb("nanColor", more.get("nanColor", [0.5, 0.0, 0.0])),
        ),
        distance,
        opacity_unit_label="file" if "scalarOpacityUnitDistance" in component else DEFAULT,
        lighting=_lighting(what, light),
    )


def _points(component: dict[str, Any], key: str) -> list[dict[str, Any]]:
    function = component.get(key)
    points = function.get("points") if isinstance(function, dict) else None
    if not isinstance(points, list) or not points or not all(isinstance(p, dict) for p in points):
        raise DataError(f"{key}; expected an object with points")
    return points


def _x(point: dict[str, Any]) -> float:
    return number("x", point.get("x"))


def _bend(point: dict[str, Any]) -> tuple[float, float]:
    return number("midpoint", point.get("midpoint", 0.5)), number("sharpness", point.get("sharpness", 0.0))
