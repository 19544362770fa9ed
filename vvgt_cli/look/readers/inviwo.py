"""Inviwo transfer functions (``.itf``): ``<Points><Point><pos content/><rgba x y z w/></Point> ...`` with a mask.

Positions are fractions of the data range (``type`` 0) or data values (1). Values outside of ``maskMin`` to ``maskMax``
are transparent. Opacity is per reference step, which Inviwo's shaders have at 1/150 of the volume's edge
(REF_SAMPLING_INTERVAL); of a box that is no cube it is taken as 1/150 of the longest edge.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, naming
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.readers.fields import Elements, attribute

REFERENCE_STEP = 1 / 150


def matches(parsed: Any) -> bool:
    """Return whether it is Inviwo's XML with points."""
    return isinstance(parsed, Elements) and parsed.root.startswith("inviwo")


def read(parsed: Elements, what: str, pick: str = "") -> TransferFunction:
    """Return the function of the file; versions before 2, with ``dataPoints`` and positions x and y, are read too.

    Raises:
        DataError: no points, an invalid field, ``pick`` of a preset by name.
    """
    if pick:
        raise DataError(f"{what}: holds one function, no presets; omit #{pick}")
    places, colors, facts = [], [], {"maskmin": 0.0, "maskmax": 1.0, "type": 0.0}
    for tag, attributes in parsed.items:
        if tag in facts:
            facts[tag] = attribute(f"{what}: {tag}", attributes, "content")
        elif tag == "pos":
            places.append(attribute(f"{what}: pos", attributes, "content" if "content" in attributes else "x"))
        elif tag == "rgba":
            colors.append([attribute(f"{what}: rgba", attributes, key) for key in "xyzw"])
    if not places or len(places) != len(colors):
        raise DataError(f"{what}: {len(places)} positions and {len(colors)} colours; expected points with both")
    with naming(what):
        nodes, rgba = np.array(places), np.array(colors)
        masked = _masked(PiecewiseOpacity(nodes, rgba[:, 3]), facts["maskmin"], facts["maskmax"], facts["type"] == 0)
        return TransferFunction(
            "Inviwo transfer function",
            masked,
            ColorMap(nodes, rgba[:, :3]),
            domain="data" if facts["type"] else "fraction",
            opacity_unit_share=REFERENCE_STEP,
        )


def _masked(opacity: PiecewiseOpacity, lo: float, hi: float, fraction: bool) -> PiecewiseOpacity:
    """Cut the opacity to zero outside [lo, hi]; a mask of the whole range changes nothing."""
    if (lo <= 0 and hi >= 1) if fraction else (lo, hi) == (0, 1):  # the defaults, which are fractions
        return opacity
    if not lo < hi:
        raise DataError(f"mask from {lo:g} to {hi:g}; expected two ascending numbers")
    inside = (opacity.x > lo) & (opacity.x < hi)
    low, high = opacity(np.array([lo, hi]))
    x, y = [lo, lo, *opacity.x[inside], hi, hi], [0.0, low, *opacity.y[inside], high, 0.0]
    if fraction:  # a mask to the end of the range cuts nothing there
        first, last = int(lo <= 0), len(x) - int(hi >= 1)
        x, y = x[first:last], y[first:last]
    return PiecewiseOpacity(np.array(x), np.array(y))
