"""What a page needs to show Gaussians that carry values under any function: bytes of each, and facts as JSON has them.

Eight bytes a Gaussian, two textures of RGBA8U, in the order of the file:

| byte | holds |
| --- | --- |
| 0 | value m: (m - lo) / (hi - lo) * 255 |
| 1 | spread s: (s / (hi - lo) / widest)^(1 / bend) * 255, a column of the table over 255 times its columns less one |
| 2 | log L: (log L - l0) / (l1 - l0) * 255 |
| 4, 5, 6 | direction in which values rise, as long as the share r that it explains: 128 + 127 times x, y, z |
| 3, 7 | of a label map the row of the label, its low and its high byte; else 0 |
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vvgt_cli.gaussians.live import BEND, FLAT, LENGTH, MEANS, NODES, SHARP, SPREAD, SPREADS, THINNEST, VALUE, WIDEST
from vvgt_cli.gaussians.live_facts import GRADIENT, ROW, LiveFacts
from vvgt_cli.gaussians.types import Gaussians

BYTES = 8


def live_bytes(gaussians: Gaussians, facts: LiveFacts, logs: tuple[float, float] | None = None) -> np.ndarray:
    """(K, 8) uint8 of Gaussians that carry values; directions are in the frame that these are in.

    ``logs``: `log_lengths` of all that are in one page; None: their own.
    """
    assert gaussians.live is not None
    live, width = gaussians.live.astype(np.float64), (facts.hi - facts.lo) or 1.0
    first, last = logs or log_lengths([gaussians])
    out = np.zeros((len(live), BYTES), np.uint8)
    out[:, 0] = _byte((live[:, VALUE] - facts.lo) / width)
    out[:, 1] = _byte((live[:, SPREAD] / width / WIDEST).clip(0, 1) ** (1 / BEND))
    out[:, 2] = _byte((np.log(live[:, LENGTH]) - first) / ((last - first) or 1.0))
    out[:, 4:7] = np.rint(128 + 127 * live[:, GRADIENT].clip(-1, 1))
    if facts.labels:
        row = live[:, ROW].astype(np.int64)
        out[:, 3], out[:, 7] = row & 255, row >> 8
    return out


def live_json(clouds: Sequence[Gaussians], facts: LiveFacts, unit_distance: float) -> dict[str, Any]:
    """Facts beside the bytes, plain values.

    Args:
        clouds: that the bytes are of.
        facts: of their values.
        unit_distance: unit-frame length that the opacity of the function in ``facts`` is per.
    """
    labels = [{"number": e.number, "name": e.name, "rgb": list(e.color), "opacity": e.opacity} for e in facts.labels]
    return {
        "labels": labels,
        "values": [facts.lo, facts.hi],
        "unit": facts.unit,
        "histogram": list(facts.histogram),
        "function": facts.baked(),
        "unit_distance": unit_distance,
        "log_lengths": list(log_lengths(clouds)),
        "widest": WIDEST,
        "bend": BEND,
        "table": [MEANS, SPREADS],
        "nodes": NODES,
        "thinnest": THINNEST,
        "opaque": [SHARP, FLAT],
    }


def from_bytes(stream: np.ndarray, facts: dict[str, Any]) -> np.ndarray:
    """(K, 6) or (K, 7) float32 of bytes and facts: what a page makes of them, and `Gaussians.live` holds."""
    (lo, hi), (first, last) = facts["values"], facts["log_lengths"]
    share = stream.astype(np.float64) / 255
    value = lo + (hi - lo) * share[:, 0]
    spread = ((hi - lo) or 1.0) * facts["widest"] * share[:, 1] ** facts["bend"]
    length = np.exp(first + (last - first) * share[:, 2])
    gradient = (stream[:, 4:7].astype(np.float64) - 128) / 127
    row = stream[:, 3] + 256.0 * stream[:, 7]
    carried = [value, spread, length, gradient, *([row] if facts["labels"] else [])]
    found: np.ndarray = np.column_stack(carried).astype(np.float32)
    return found


def log_lengths(clouds: Sequence[Gaussians]) -> tuple[float, float]:
    """Logs of the shortest and the longest."""
    logs = [np.log(cloud.live[:, LENGTH].astype(np.float64)) for cloud in clouds if cloud.live is not None]
    return min(float(some.min()) for some in logs), max(float(some.max()) for some in logs)


def _byte(share: np.ndarray) -> np.ndarray:
    """Of shares in [0, 1]."""
    found: np.ndarray = np.rint(share.clip(0, 1) * 255).astype(np.uint8)
    return found
