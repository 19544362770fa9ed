"""ParaView preset JSON: an array of presets, as "Export" in the preset dialogue writes it."""

from __future__ import annotations

from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.look.colormap import SPACES, ColorMap
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.opacity import PiecewiseOpacity
from vvgt_cli.look.readers.fields import named, rgb, table

PRESET_KEYS = ("RGBPoints", "IndexedColors", "ColorSpace")
LISTED, LONGEST = 60, 1000  # names, characters of them, in an error
SPACE_OF = {name.lower().replace("-", ""): name for name in SPACES} | {"ciede2000": "Lab/CIEDE2000"}


def matches(parsed: Any) -> bool:
    """Whether parsed JSON is a preset or an array of presets."""
    presets = parsed if isinstance(parsed, list) else [parsed]
    return bool(presets) and all(isinstance(p, dict) and any(k in p for k in PRESET_KEYS) for p in presets)


def read(parsed: Any, what: str, pick: str = "") -> TransferFunction:
    """One preset as a `TransferFunction` on data values.

    ``RGBPoints`` is flat (x, r, g, b), ``Points`` flat (x, opacity, midpoint, sharpness). A preset without
    ``Points`` (opacity was not exported) gets a linear ramp from 0 to 1 over its range, and its name says so.

    Raises:
        DataError: several presets and no ``pick``, a categorical preset, a field that is not what it must be.
    """
    preset = choose(parsed if isinstance(parsed, list) else [parsed], what, pick)
    if "RGBPoints" not in preset:
        raise DataError(
            f"{what}: a categorical preset (IndexedColors, no RGBPoints); expected one over a range of values"
        )
    colors = table(f"{what}: RGBPoints", preset["RGBPoints"], 4, "x, r, g, b")
    space = SPACE_OF.get(str(preset.get("ColorSpace", "RGB")).lower())
    if space is None:
        raise DataError(f"{what}: ColorSpace {preset['ColorSpace']!r}; expected one of {', '.join(SPACES)}")
    name = str(preset.get("Name", "")).strip() or "ParaView preset"
    points = preset.get("Points")
    if points is None:
        ends = np.array([colors[:, 0].min(), colors[:, 0].max()])
        opacity_nodes = np.column_stack([ends, [0.0, 1.0], [0.5, 0.5], [0.0, 0.0]])
        name += " (opacity not in the file: linear ramp)"
    else:
        opacity_nodes = table(f"{what}: Points", points, 4, "x, opacity, midpoint, sharpness")
    nan_color = rgb(f"{what}: NanColor", preset["NanColor"]) if "NanColor" in preset else (0.5, 0.0, 0.0)
    try:
        return TransferFunction(
            name,
            PiecewiseOpacity(*opacity_nodes.T),
            ColorMap(
                colors[:, 0],
                colors[:, 1:],
                space=space,
                hsv_wrap=bool(preset.get("HSVWrap", space == "HSV")),
                log_scale=bool(preset.get("UseLogScale", False)),
                nan_color=nan_color,
            ),
        )
    except DataError as error:
        raise named(what, error) from error


def choose(presets: list[dict[str, Any]], what: str, pick: str) -> dict[str, Any]:
    names = [str(p.get("Name", "")) for p in presets]
    if pick:
        if pick not in names:
            raise DataError(f"{what}: no preset {pick!r}; it has {_listed(names)}")
        return presets[names.index(pick)]
    if len(presets) > 1:
        raise DataError(f"{what}: {len(presets)} presets, {_listed(names)}; pick one as FILE#NAME")
    return presets[0]


def _listed(names: list[str]) -> str:
    shown = ", ".join(repr(n) for n in names[:LISTED])
    return shown[:LONGEST] + (", ..." if len(names) > LISTED or len(shown) > LONGEST else "")
