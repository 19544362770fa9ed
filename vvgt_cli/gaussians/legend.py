"""The legend of a look, stored in a file: the function's nodes over the range of values, or the labels."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.labels import LabelTable

MOST_NODES, MOST_LABELS, LONGEST = 32, 24, 2500  # nodes, labels, characters: space in a header is limited


def legend_text(tf: object, lo: float, hi: float, unit: str, quantity: str = "") -> str | None:
    """Return one line of JSON: value range, unit, quantity, nodes (value, opacity, colour); or labels (name, colour).

    Args:
        tf: function on data values or label table; anything else has no legend, and None is returned.
        lo: smallest value.
        hi: largest value.
        unit: unit of the values, "" if unknown.
        quantity: what the values are, "" if unknown.
    """
    if isinstance(tf, LabelTable):
        shown = [label for label in tf.labels if label.opacity > 0]
        rows = [[label.name, _hex(label.color)] for label in shown[:MOST_LABELS]]
        while len(text := json.dumps({"labels": rows, "of": len(shown)})) > LONGEST:
            rows.pop()
        return text
    if not isinstance(tf, TransferFunction):
        return None
    places = np.unique(np.concatenate([[lo, hi], tf.opacity_nodes.x, tf.color_map.x]).clip(lo, hi))
    if len(places) > MOST_NODES or tf.color_map.space != "RGB":
        places = np.linspace(lo, hi, MOST_NODES) if hi > lo else np.array([lo])
    nodes: list[list[Any]] = []
    for x in places.tolist():
        below, above = (_node(tf, x, np.nextafter(x, side)) for side in (-np.inf, np.inf))
        nodes += [above] if x <= lo or below == above else [below] if x >= hi else [below, above]  # both at a step
    return json.dumps({"values": [lo, hi], "unit": unit, "quantity": quantity, "nodes": nodes})


def _node(tf: TransferFunction, x: float, beside: float) -> list[Any]:
    at = np.array([beside])
    return [float(f"{x:.6g}"), round(float(tf.opacity(at)[0]), 4), _hex(tf.color(at)[0].tolist())]


def _hex(rgb: Any) -> str:
    return "".join(f"{round(255 * min(max(float(c), 0.0), 1.0)):02x}" for c in rgb)


def checked(text: str) -> str:
    """Check that a text is a legend, and return it.

    Raises:
        ValueError: the text is not a legend.
    """
    found = json.loads(text)
    if not isinstance(found, dict) or not ("nodes" in found or "labels" in found):
        raise ValueError(text)
    return text
