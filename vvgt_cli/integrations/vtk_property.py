"""A vtkVolumeProperty as the JSON of 3D Slicer (``.vp.json``), which every command takes as a transfer function.

Nodes keep their midpoints and sharpness, so nothing is sampled; only an opacity on a logarithmic axis is, at
`SAMPLES` a segment. Imports the standard library alone: it runs in ParaView's and 3D Slicer's Python.
"""

from __future__ import annotations

from typing import Any

SPACES = ("RGB", "HSV", "Lab", "Diverging", "Lab/CIEDE2000", "Step", "Prolab")  # by VTK's number
HIGHLIGHT = 4  # VTK's (r . v)^p is as wide as our (n . h)^(4 p): docs/light.md
SAMPLES = 256  # of an opacity on a logarithmic axis, a segment: within 1e-5 of it over a decade
GAP = 1e-9  # of the range, from an end to the value beyond it

Found = tuple[dict[str, Any], list[str]]


def property_json(prop: Any, component: int = 0, scale: float = 1.0) -> Found:
    """Return one component of a volume property as JSON, and notes on what it cannot hold.

    Args:
        prop: vtkVolumeProperty.
        component: number of the component whose functions are taken.
        scale: world length of a unit of the data, where the volume is scaled: opacity is per length of the data.

    Returns:
        A mapping that `vvgt_cli.look.read_transfer_function` reads, and short notes.
    """
    notes: list[str] = []
    if prop.GetColorChannels(component) == 1:
        grays = _nodes(prop.GetGrayTransferFunction(component), 4)
        points = [_point(x, *bend, y=min(max(y, 0.0), 1.0)) for x, y, *bend in grays]
        colors = {"grayTransferFunction": {"points": points}}
    else:
        colors = {"rgbTransferFunction": _colors(prop.GetRGBTransferFunction(component), notes)}
    opacity = _opacity(prop.GetScalarOpacity(component), prop.GetComponentWeight(component), notes)
    shade = bool(prop.GetShade(component))
    lighting = {
        "ambient": prop.GetAmbient(component),
        "diffuse": prop.GetDiffuse(component),
        "specular": prop.GetSpecular(component),
        "specularPower": HIGHLIGHT * prop.GetSpecularPower(component),
    }
    if prop.HasGradientOpacity(component) and not prop.GetDisableGradientOpacity(component):
        slopes = [node[1] for node in _nodes(prop.GetStoredGradientOpacity(component), 4)]
        notes += ["gradient opacity"] if any(slope != 1 for slope in slopes) else []
    if getattr(prop, "GetTransferFunctionMode", int)() == 1:
        notes.append("two-dimensional transfer function")
    if prop.GetInterpolationType() == 0:
        notes.append("nearest-neighbour interpolation (linear instead)")
    if getattr(prop, "GetScatteringAnisotropy", float)() != 0:
        notes.append("scattering anisotropy")
    made = {
        **colors,
        "scalarOpacity": {"points": opacity},
        "scalarOpacityUnitDistance": prop.GetScalarOpacityUnitDistance(component) * scale,
        "shade": shade,
        "lighting": lighting,
    }
    return {"volumeProperties": [{"components": [made]}]}, notes


def _nodes(function: Any, width: int) -> list[list[float]]:
    """Return the nodes of a function of VTK: x, values, midpoint, sharpness."""
    nodes = []
    for k in range(function.GetSize()):
        node = [0.0] * width
        function.GetNodeValue(k, node)
        nodes.append(node)
    return nodes


def _beyond(nodes: list[list[float]], below: list[float] | None, above: list[float] | None) -> list[list[float]]:
    """Add nodes for the values below and above the range; None: that of the end."""
    (first, *_), (last, *_) = nodes[0], nodes[-1]
    gap = GAP * (last - first or abs(last) or 1.0)
    before = [] if below is None else [[first - gap, *below, 0.5, 0.0]]
    return before + nodes + ([] if above is None else [[last + gap, *above, 0.5, 0.0]])


def _point(x: float, middle: float, sharpness: float, **value: Any) -> dict[str, Any]:
    return {"x": x, **value, "midpoint": middle, "sharpness": sharpness}


def _colors(function: Any, notes: list[str]) -> dict[str, Any]:
    """Return a vtkColorTransferFunction, with the keys that our reader adds to 3D Slicer's."""
    below = list(function.GetBelowRangeColor()) if function.GetUseBelowRangeColor() else None
    above = list(function.GetAboveRangeColor()) if function.GetUseAboveRangeColor() else None
    if not function.GetClamping():
        below, above = below or [0.0, 0.0, 0.0], above or [0.0, 0.0, 0.0]
    if function.GetIndexedLookup():
        notes.append("categories (indexed lookup): colours are interpolated")
    nodes = _beyond(_nodes(function, 6), below, above)
    return {
        "points": [_point(n[0], *n[4:], color=[min(max(c, 0.0), 1.0) for c in n[1:4]]) for n in nodes],
        "colorSpace": SPACES[function.GetColorSpace()],
        "hsvWrap": bool(function.GetHSVWrap()),
        "useLogScale": function.GetScale() == 1,
        "nanColor": list(function.GetNanColor()),
    }


def _opacity(function: Any, weight: float, notes: list[str]) -> list[dict[str, Any]]:
    """Return the points of an opacity function; opacity without clamping is 0 outside."""
    nodes = _nodes(function, 4)
    if getattr(function, "GetUseLogScale", int)() and nodes[0][0] > 0:
        nodes = [
            [x, function.GetValue(x), 0.5, 0.0]
            for a, b in ((nodes[n][0], nodes[n + 1][0]) for n in range(len(nodes) - 1))
            for x in (a * (b / a) ** (k / SAMPLES) for k in range(SAMPLES + 1))
        ] or nodes
    outside = None if function.GetClamping() else [0.0]
    values = [y * weight for _, y, *_ in nodes]
    if min(values) < 0 or max(values) > 1:
        notes.append(f"opacity from {min(values):g} to {max(values):g} (clipped to 0 to 1)")
    return [_point(x, *bend, y=min(max(y * weight, 0.0), 1.0)) for x, y, *bend in _beyond(nodes, outside, outside)]
