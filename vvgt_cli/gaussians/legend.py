"""What a file says of its look for a legend: the function's nodes over the range of values, or the labels."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.labels import LabelTable

MOST_NODES, MOST_LABELS, LONGEST = 32, 24, 2500  # nodes, labels, characters: a header has little room


def legend_text(tf: object, lo: float, hi: float, unit: str) -> str | None:
    """One line of JSON: values, unit and nodes (value, opacity, colour), or labels (name, colour) of how many.

    Args:
        tf: on data values; of what is neither a function nor a table of labels there is no legend.
        lo, hi: range of the values.
        unit: of the values, "" where it is not known.
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
        nodes += [above] if x <= lo or below == above else [below] if x >= hi else [below, above]  # of a step both
    return json.dumps({"values": [lo, hi], "unit": unit, "nodes": nodes})


def _node(tf: TransferFunction, x: float, beside: float) -> list[Any]:
    at = np.array([beside])
    return [float(f"{x:.6g}"), round(float(tf.opacity(at)[0]), 4), _hex(tf.color(at)[0].tolist())]


def _hex(rgb: Any) -> str:
    return "".join(f"{round(255 * min(max(float(c), 0.0), 1.0)):02x}" for c in rgb)


def checked(text: str) -> str:
    """The text, if it is a legend's.

    Raises:
        ValueError: it is none.
    """
    found = json.loads(text)
    if not isinstance(found, dict) or not ("nodes" in found or "labels" in found):
        raise ValueError(text)
    return text
