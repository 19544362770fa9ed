"""The data with which a page shows Gaussians that carry values under any function: bytes of each, and JSON facts.

There are eleven bytes per Gaussian, three RGBA8U textures, in the order of the file:

| byte | holds |
| --- | --- |
| 0 | value m: (m - lo) / (hi - lo) * 255 |
| 1 | spread s: (s / (hi - lo) / widest)^(1 / bend) * 255, a column of the table scaled to 0 to 255 |
| 2 | log L: (log L - l0) / (l1 - l0) * 255 |
| 3, 4, 5 | gradient direction, with the share r that it explains as its length: 128 + 127 times x, y, z |
| 6, 7, 8 | axis of the normals, with their concentration as its length: the same |
| 9, 10 | row of its look, low and high byte |

Each layer of values has one row, each layer of labels one per label; the rows of a layer follow those of the previous
one.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import numpy as np

from vvgt_cli.gaussians.live import (
    AMOUNT,
    AROUND,
    BEND,
    LENGTH,
    MEANS,
    SHARP,
    SPREAD,
    SPREADS,
    TAIL,
    THINNEST,
    VALUE,
    WIDEST,
)
from vvgt_cli.gaussians.live_facts import AXIS, GRADIENT, LABEL_ROW, LAYER_ID, LiveFacts
from vvgt_cli.gaussians.types import Gaussians

BYTES, ROW = 11, 9  # in all, and the first of the two of the row


def live_bytes(gaussians: Gaussians, facts: LiveFacts, logs: tuple[float, float] | None = None) -> np.ndarray:
    """Return the bytes (K, 11) uint8 of Gaussians that carry values, with directions in the Gaussians' frame.

    ``logs`` are the `log_lengths` of all Gaussians in the page, by default of these.
    """
    assert gaussians.live is not None
    live = gaussians.live.astype(np.float64)
    first, last = logs or log_lengths([gaussians])
    number = live[:, LAYER_ID] if facts.others else np.zeros(len(live))
    lo, width = (np.array(ends)[number.astype(np.int64)] for ends in _ranges(facts.layers))
    out = np.zeros((len(live), BYTES), np.uint8)
    out[:, 0] = _byte((live[:, VALUE] - lo) / width)
    out[:, 1] = _byte((live[:, SPREAD] / width / WIDEST).clip(0, 1) ** (1 / BEND))
    out[:, 2] = _byte((np.log(live[:, LENGTH]) - first) / ((last - first) or 1.0))
    out[:, 3:6] = np.rint(128 + 127 * live[:, GRADIENT].clip(-1, 1))
    out[:, 6:9] = np.rint(128 + 127 * live[:, AXIS].clip(-1, 1))
    row = np.array(_first_rows(facts.layers))[number.astype(np.int64)]
    row += live[:, LABEL_ROW].astype(np.int64) if facts.most_labels else 0
    out[:, ROW], out[:, ROW + 1] = row & 255, row >> 8
    return out


def _ranges(layers: Sequence[LiveFacts]) -> tuple[list[float], list[float]]:
    """Return the smallest value and the range of values of each layer."""
    return [layer.lo for layer in layers], [(layer.hi - layer.lo) or 1.0 for layer in layers]


def _first_rows(layers: Sequence[LiveFacts]) -> list[int]:
    """Return the first row of each layer."""
    return [0, *accumulate(max(len(layer.labels), 1) for layer in layers)][:-1]


def live_json(clouds: Sequence[Gaussians], facts: LiveFacts, unit_distances: Sequence[float]) -> dict[str, Any]:
    """Return the facts beside the bytes, as plain values; ``unit_distances`` are per layer, in the unit frame."""
    rows = zip(facts.layers, _first_rows(facts.layers), unit_distances, strict=True)
    return {
        "layers": [_layer_json(*row) for row in rows],
        "log_lengths": list(log_lengths(clouds)),
        "widest": WIDEST,
        "bend": BEND,
        "table": [MEANS, SPREADS],
        "thinnest": THINNEST,
        "sharp": SHARP,
        "tail": list(TAIL),
        "around": [AROUND, AMOUNT],
    }


def _layer_json(layer: LiveFacts, row: int, unit_distance: float) -> dict[str, Any]:
    return {
        "title": layer.name,
        "row": row,
        "labels": [label.page_entry() for label in layer.labels],
        "values": [layer.lo, layer.hi],
        "unit": layer.unit,
        "quantity": layer.quantity,
        "histogram": list(layer.histogram),
        "name": layer.baked().get("name", ""),
        "unit_distance": unit_distance,
        "grain": layer.grain,
    }


def log_lengths(clouds: Sequence[Gaussians]) -> tuple[float, float]:
    """Return the logs of the shortest and the longest length."""
    logs = [np.log(cloud.live[:, LENGTH].astype(np.float64)) for cloud in clouds if cloud.live is not None]
    return min(float(some.min()) for some in logs), max(float(some.max()) for some in logs)


def _byte(share: np.ndarray) -> np.ndarray:
    """Quantise shares in [0, 1] to uint8."""
    found: np.ndarray = np.rint(share.clip(0, 1) * 255).astype(np.uint8)
    return found
