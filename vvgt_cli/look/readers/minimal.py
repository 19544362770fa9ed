"""Our own minimal JSON transfer function.

An object with these keys, and no others::

    {
      "name": "bone",                        optional
      "range": [0, 4095],                    optional: see below
      "points": [{"x": 0.2, "rgb": [1, 1, 1], "opacity": 0.5}, ...],
      "color_space": "RGB",                  optional: a ParaView ColorSpace
      "hsv_wrap": true,                      optional: false: HSV does not go the short way round the hue circle
      "opacity_unit_distance": 1.5,          optional: world length that the opacities are per, or "mean-spacing"
      "opacity_unit_share": 0.004,           optional: the same as a share of the box's longest edge; not both
      "otherwise": {"range": ..., "points"}  optional: for data that are not in Hounsfield units
      "lighting": {"ambient": 0.1, "diffuse": 0.7, "specular": 0.2, "specular_power": 10}
    }                                        optional: a head-light with these coefficients, or VTK's

``x`` is a data value without ``range``; in [0, 1] from one end of ``"range": [lo, hi]`` to the other; with ``"range":
"percentile"``, the fraction of the voxels that lie below (0.5 is the median), with ``"foreground"`` that of the voxels
in front of the background; with ``"sigma"``, standard deviations above the mean; with ``"mean"``, multiples of
the mean of the values above 0 in front of the background. A point carries ``rgb`` (three numbers
in [0, 1]), ``opacity`` (in [0, 1]) or both; at least one point carries each. Between points both are linear; beyond the
ends they are constant. ``{"name": ..., "iso": [0.03, "3sigma,#88aaff"]}`` are isosurfaces
(`vvgt_cli.look.isosurfaces`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError, naming
from vvgt_cli.look.function import BY, PER_VOXEL, ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.isosurfaces import isosurfaces
from vvgt_cli.look.lighting import COEFFICIENTS, Lighting, preset_lighting
from vvgt_cli.look.readers.fields import number, rgb

KEYS = {"name", "range", "points", "color_space", "hsv_wrap", "opacity_unit_distance", "opacity_unit_share"}
KEYS |= {"lighting", "otherwise"}
RANGES = [domain for domain in BY if domain != "level"]
POINT_KEYS = {"x", "rgb", "opacity"}


def matches(parsed: Any) -> bool:
    """Return whether parsed JSON is an object with points or levels."""
    return isinstance(parsed, dict) and ("points" in parsed or "iso" in parsed)


def read(parsed: dict[str, Any], what: str, pick: str = "") -> TransferFunction:
    """Return the function that the object describes; raise DataError for a ``pick``, unknown keys or invalid fields."""
    if pick:
        raise DataError(f"{what}: holds one function, no presets; omit #{pick}")
    if "iso" in parsed:
        try:
            return isosurfaces(parsed["iso"] if set(parsed) <= {"iso", "name"} else (), str(parsed.get("name") or ""))
        except (UsageError, TypeError) as error:
            raise DataError(f"{what}: {error}; expected {{'iso': [LEVEL, ...]}}, and perhaps a name") from None
    unknown = sorted(set(parsed) - KEYS)
    if unknown:
        raise DataError(f"{what}: unknown key {unknown[0]!r}; expected {', '.join(sorted(KEYS))}")
    opacities, colors = _points(parsed["points"], what)
    domain, lo, hi = _range(parsed.get("range"), what)
    distance = parsed.get("opacity_unit_distance")
    label = PER_VOXEL if distance == PER_VOXEL else "file"
    space = str(parsed.get("color_space", "RGB"))
    if distance is not None and label == "file":
        distance = number(f"{what}: opacity_unit_distance", distance)
    share = parsed.get("opacity_unit_share")
    if share is not None and (distance is not None or not 0 < number(f"{what}: opacity_unit_share", share) <= 1):
        raise DataError(f"{what}: opacity_unit_share {share}; expected above 0 to 1, without opacity_unit_distance")
    otherwise, wrap = _otherwise(parsed, what), parsed.get("hsv_wrap", True)
    if not isinstance(wrap, bool):
        raise DataError(f"{what}: hsv_wrap {wrap!r}; expected true or false")
    (xo, y), (xc, c) = zip(*opacities, strict=True), zip(*colors, strict=True)
    with naming(what):
        if domain == "data" and hi > lo:
            if min(xo + xc) < 0 or max(xo + xc) > 1:
                raise DataError(f"points x in [{min(xo + xc):g}, {max(xo + xc):g}]; with a range expected x in [0, 1]")
            xo, xc = (tuple(lo + (hi - lo) * np.array(x)) for x in (xo, xc))
        return TransferFunction(
            str(parsed.get("name") or "").strip() or "transfer function",
            PiecewiseOpacity(np.array(xo), np.array(y)),
            ColorMap(np.array(xc), np.array(c), space=space, hsv_wrap=wrap),
            distance if label == "file" else None,
            domain,
            share,
            label,
            lighting=_lighting(parsed.get("lighting"), what),
            otherwise=otherwise,
        )


def _otherwise(parsed: dict[str, Any], what: str) -> TransferFunction | None:
    """Return the function for data that are not in Hounsfield units: other points and range, all else the same."""
    inner = parsed.get("otherwise")
    if inner is None:
        return None
    if not isinstance(inner, dict) or not set(inner) <= {"range", "points"} or "points" not in inner:
        raise DataError(f"{what}: otherwise; expected an object of range and points")
    outer = {key: value for key, value in parsed.items() if key not in ("otherwise", "range", "points")}
    return read(outer | inner, f"{what}: otherwise")


def _lighting(value: Any, what: str) -> Lighting | None:
    if value is None:
        return None
    if not isinstance(value, dict) or not set(value) <= set(COEFFICIENTS):
        raise DataError(f"{what}: lighting; expected an object of {', '.join(COEFFICIENTS)}, any or none")
    return preset_lighting(what, True, {key: number(f"{what}: lighting.{key}", v) for key, v in value.items()})


def _range(value: Any, what: str) -> tuple[str, float, float]:
    """Return the domain of the points and the range that they are fractions of ((0, 0): none)."""
    if value is None:
        return "data", 0.0, 0.0
    if value in RANGES:
        return str(value), 0.0, 0.0
    if not isinstance(value, list) or len(value) != 2:
        raise DataError(f"{what}: range {value!r}; expected [lo, hi] or one of {', '.join(RANGES)}")
    lo, hi = (number(f"{what}: range", v) for v in value)
    if not lo < hi:
        raise DataError(f"{what}: range [{lo:g}, {hi:g}]; expected lo below hi")
    return "data", lo, hi


def _points(value: Any, what: str) -> tuple[list[tuple[float, float]], list[tuple[float, tuple[float, float, float]]]]:
    """Return (x, opacity) and (x, rgb) of the points."""
    if not isinstance(value, list) or not value or not all(isinstance(p, dict) for p in value):
        raise DataError(f"{what}: points; expected a list of objects with x, rgb and opacity")
    opacities, colors = [], []
    for i, point in enumerate(value):
        here = f"{what}: points[{i}]"
        unknown = sorted(set(point) - POINT_KEYS)
        if unknown:
            raise DataError(f"{here}: unknown key {unknown[0]!r}; expected x, rgb, opacity")
        if "x" not in point or len(point) < 2:
            raise DataError(
                f"{here}: has {', '.join(sorted(point)) or 'nothing'}; expected x with rgb or opacity or both"
            )
        x = number(f"{here}.x", point["x"])
        if "opacity" in point:
            opacities.append((x, number(f"{here}.opacity", point["opacity"])))
        if "rgb" in point:
            colors.append((x, rgb(f"{here}.rgb", point["rgb"])))
    for missing, rows in (("opacity", opacities), ("rgb", colors)):
        if not rows:
            raise DataError(f"{what}: no point has {missing}; expected at least one")
    return opacities, colors
