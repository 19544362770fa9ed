"""ParaView colour-map XML (``.xml``).

``<ColorMaps><ColorMap name space indexedLookup><Point x o r g b/> ... <NaN r g b/>``: older ParaViews exported it, and
colour-map sites still offer it. ``o`` is opacity; a map whose points all have the same one says nothing of opacity and
gets a linear ramp, as a preset without opacity does.
"""

from __future__ import annotations

from typing import Any

from vvgt_cli.errors import DataError
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.readers import paraview
from vvgt_cli.look.readers.fields import Elements, attribute


def matches(parsed: Any) -> bool:
    """Whether it is XML with a ColorMap."""
    return isinstance(parsed, Elements) and any(tag == "colormap" for tag, _ in parsed.items)


def read(parsed: Elements, what: str, pick: str = "") -> TransferFunction:
    """One colour map as a `TransferFunction` on data values.

    Raises:
        DataError: several maps and no ``pick``, an indexed map, a field that is not what it must be.
    """
    presets: list[dict[str, Any]] = []
    for tag, cased in parsed.items:
        attributes = {key.lower(): value for key, value in cased.items()}
        if tag == "colormap":
            indexed = attributes.get("indexedlookup", "false").lower() in ("true", "1")
            about = {"Name": attributes.get("name", ""), "ColorSpace": attributes.get("space", "RGB")}
            presets.append({**about, "RGBPoints": [], "Points": [], "indexed": indexed})
        elif presets and tag in ("above", "below"):
            presets[-1][f"Use{tag.title()}RangeColor"] = 1
        elif presets and (tag == "nan" or (tag == "point" and not presets[-1]["indexed"])):
            here = f"{what}: {presets[-1]['Name'] or 'ColorMap'}: {tag}"
            color = [attribute(here, attributes, key) for key in "rgb"]
            if tag == "nan":
                presets[-1]["NanColor"] = color
                continue
            x, opacity = attribute(here, attributes, "x"), attribute(here, {"o": "1", **attributes}, "o")
            presets[-1]["RGBPoints"] += [x, *color]
            presets[-1]["Points"] += [x, opacity, 0.5, 0.0]
    preset = dict(paraview.choose(presets, what, pick))
    if preset.pop("indexed"):
        raise DataError(f"{what}: an indexed colour map (indexedLookup); expected one over a range of values")
    if len(set(preset["Points"][1::4])) < 2:
        del preset["Points"]
    return paraview.read(preset, what)
