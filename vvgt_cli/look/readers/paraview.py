"""Presets of ParaView: JSON, as "Export" in the preset dialogue writes it and vtk.js has it, and colour-map XML.

vtk.js: ParaView Glance, VolView. XML, which older ParaViews exported and colour-map sites still offer:
``<ColorMaps><ColorMap name space indexedLookup><Point x o r g b/> ... <NaN r g b/>``. ``o`` is opacity; a map whose
points all have the same one says nothing of opacity and gets a linear ramp, as a preset without opacity does.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, naming
from vvgt_cli.look.function import SPACES, ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.readers.fields import Elements, attribute, rgb, table
from vvgt_cli.volume.components import listed

PRESET_KEYS = ("RGBPoints", "IndexedColors", "ColorSpace")
RAMP = " (opacity not in the file: linear ramp)"  # behind the name of a function
LISTED = 60  # names in an error
UNUSED = ("IndexedColors", "UseAboveRangeColor", "UseBelowRangeColor")
# other names in files: of VTK, of older ParaViews' presets and XML
OTHER_NAMES = {"ciede2000": "Lab/CIEDE2000", "cielab": "Lab", "wrapped": "HSV", "wrapped hsv": "HSV", "hsvwrap": "HSV"}
SPACE_OF = {name.lower(): name for name in SPACES} | OTHER_NAMES


def matches(parsed: Any) -> bool:
    """Return whether it is a preset, an array of presets, or XML with a ColorMap."""
    if isinstance(parsed, Elements):
        return any(tag == "colormap" for tag, _ in parsed.items)
    presets = parsed if isinstance(parsed, list) else [parsed]
    return bool(presets) and all(isinstance(p, dict) and any(k in p for k in PRESET_KEYS) for p in presets)


def read(parsed: Any, what: str, pick: str = "") -> TransferFunction:
    """Return one preset as a `TransferFunction` on data values.

    ``RGBPoints`` is flat (x, r, g, b), ``Points`` flat (x, opacity, midpoint, sharpness), ``OpacityPoints`` of vtk.js
    flat (x, opacity). Without either (opacity was not exported) it is a linear ramp from 0 to 1 over the range, and the
    name says so. HSV takes the short way round only with ``HSVWrap``: ParaView writes it where it is not 0.

    Raises:
        DataError: several presets and no ``pick``, a categorical preset, an indexed map, or an invalid field.
    """
    presets = _of_xml(parsed, what) if isinstance(parsed, Elements) else parsed
    preset = choose(presets if isinstance(presets, list) else [presets], what, pick)
    if preset.get("indexed"):
        raise DataError(f"{what}: an indexed colour map (indexedLookup); expected one over a range of values")
    if "RGBPoints" not in preset:
        raise DataError(
            f"{what}: a categorical preset (IndexedColors, no RGBPoints); expected one over a range of values (with "
            "Annotations it is a table for --labels)"
        )
    colors = table(f"{what}: RGBPoints", preset["RGBPoints"], 4, "x, r, g, b")
    stated = str(preset.get("ColorSpace", "RGB")).lower()
    if stated not in SPACE_OF:
        raise DataError(f"{what}: ColorSpace {preset['ColorSpace']!r}; expected one of {', '.join(SPACES)}")
    if unused := [key for key in UNUSED if preset.get(key)]:
        warnings.warn(f"{what}: {', '.join(unused)} not used; colours come from RGBPoints alone", stacklevel=2)
    name = str(preset.get("Name") or "").strip() or "ParaView preset"
    if "OpacityPoints" in preset:
        opacity_nodes = table(f"{what}: OpacityPoints", preset["OpacityPoints"], 2, "x, opacity")
    elif preset.get("Points") is not None:
        opacity_nodes = table(f"{what}: Points", preset["Points"], 4, "x, opacity, midpoint, sharpness")
    else:
        opacity_nodes = np.array([[colors[:, 0].min(), 0.0], [colors[:, 0].max(), 1.0]])
        name += RAMP
    nan_color = rgb(f"{what}: NanColor", preset["NanColor"]) if "NanColor" in preset else (0.5, 0.0, 0.0)
    with naming(what):
        return TransferFunction(
            name,
            PiecewiseOpacity(*opacity_nodes.T),
            ColorMap(
                colors[:, 0],
                colors[:, 1:],
                space=SPACE_OF[stated],
                hsv_wrap=bool(preset.get("HSVWrap", "wrap" in stated)),
                log_scale=bool(preset.get("UseLogScale", False)),
                nan_color=nan_color,
            ),
        )


def _of_xml(parsed: Elements, what: str) -> list[dict[str, Any]]:
    """Return the colour maps of an XML file as presets, those that are ``indexed`` marked."""
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
    for preset in presets:
        if len(set(preset["Points"][1::4])) < 2:
            del preset["Points"]
    return presets


def choose(presets: list[dict[str, Any]], what: str, pick: str) -> dict[str, Any]:
    """Return the preset that ``pick`` names, or the only one."""
    names = [str(p.get("Name", "")) for p in presets]
    has = listed(list(map(repr, names)), ", ", LISTED)
    if pick:
        if pick not in names:
            raise DataError(f"{what}: no preset {pick!r}; it has {has}")
        return presets[names.index(pick)]
    if len(presets) > 1:
        raise DataError(f"{what}: {len(presets)} presets, {has}; pick one as FILE#NAME")
    return presets[0]
