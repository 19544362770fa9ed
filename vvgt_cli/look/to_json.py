"""Writing transfer functions: our minimal JSON and ParaView's preset JSON."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.look.function import BY, PER_VOXEL, ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.isosurfaces import Isosurfaces
from vvgt_cli.look.lighting import COEFFICIENTS


def to_text(tf: TransferFunction, form: str) -> str:
    """Return a placed function's JSON in a ``form``, minimal or paraview; raise DataError if it cannot store it."""
    body = _minimal(tf) if form == "minimal" else _paraview(tf)
    return json.dumps(body, indent=1, allow_nan=False) + "\n"


def _linear(function: PiecewiseOpacity | ColorMap) -> bool:
    """Return whether values between nodes are linear, in their colour space."""
    inner = slice(0, -1)  # the last node's are of no segment
    linear = (function.midpoint[inner] == 0.5) & (function.sharpness[inner] == 0)
    return bool(linear.all())


def _refuse(tf: TransferFunction, what: str, form: str, hint: str) -> DataError:
    return DataError(f"{tf.name}: {what}; {form} cannot store that: {hint}")


def _minimal(tf: TransferFunction) -> dict[str, Any]:
    if not _linear(tf.opacity_nodes) or not _linear(tf.color_map) or tf.color_map.log_scale:
        what = "midpoints, sharpness or a logarithmic scale"
        raise _refuse(tf, what, "the minimal format", "try --format paraview")
    body: dict[str, Any] = {"name": tf.name}
    if isinstance(tf, Isosurfaces):
        return body | {"iso": list(tf.texts)}
    if tf.domain in BY:
        body["range"] = tf.domain
    body["points"] = _points(tf)
    if tf.color_map.space != "RGB":
        body["color_space"] = tf.color_map.space
    if tf.color_map.space == "HSV" and not tf.color_map.hsv_wrap:
        body["hsv_wrap"] = False
    if tf.opacity_unit_distance is not None or tf.opacity_unit_label == PER_VOXEL:
        body["opacity_unit_distance"] = tf.opacity_unit_distance or PER_VOXEL
    if tf.opacity_unit_share is not None:
        body["opacity_unit_share"] = tf.opacity_unit_share
    if tf.otherwise is not None:
        inner = _minimal(tf.otherwise)
        body["otherwise"] = {key: inner[key] for key in ("range", "points") if key in inner}
    if tf.lighting is not None:
        body["lighting"] = {name: getattr(tf.lighting, name) for name in COEFFICIENTS}
    return body


def _points(tf: TransferFunction) -> list[dict[str, Any]]:
    """Return nodes of opacity and of colour; combined if both have the same positions."""
    opacity, color = tf.opacity_nodes, tf.color_map
    if np.array_equal(opacity.x, color.x):
        rows = zip(opacity.x.tolist(), color.rgb.tolist(), opacity.y.tolist(), strict=True)
        return [{"x": x, "rgb": rgb, "opacity": y} for x, rgb, y in rows]
    points: list[dict[str, Any]] = [
        {"x": x, "opacity": y} for x, y in zip(opacity.x.tolist(), opacity.y.tolist(), strict=True)
    ]
    points += [{"x": x, "rgb": rgb} for x, rgb in zip(color.x.tolist(), color.rgb.tolist(), strict=True)]
    return sorted(points, key=lambda point: point["x"])


def _paraview(tf: TransferFunction) -> list[dict[str, Any]]:
    opacity, color = tf.opacity_nodes, tf.color_map
    if tf.opacity_unit_share is not None:
        raise _refuse(
            tf, "its opacity is per a share of the volume's edge", "a ParaView preset", "try --format minimal"
        )
    if tf.domain in BY:
        raise _refuse(tf, f"its nodes are {BY[tf.domain]}", "a ParaView preset", "try --format minimal")
    inner = slice(0, -1)
    if (color.midpoint[inner] != 0.5).any() or (color.sharpness[inner] != 0).any():
        raise _refuse(tf, "midpoints or sharpness of colours", "a ParaView preset", "use the file as it is")
    preset = {
        "Name": tf.name,
        "ColorSpace": color.space,
        "HSVWrap": int(color.hsv_wrap),
        "NanColor": list(color.nan_color),
        "RGBPoints": np.column_stack([color.x, color.rgb]).ravel().tolist(),
        "Points": np.column_stack([opacity.x, opacity.y, opacity.midpoint, opacity.sharpness]).ravel().tolist(),
    }
    if color.log_scale:
        preset["UseLogScale"] = 1
    return [preset]
