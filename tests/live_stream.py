"""The stream of live attributes as a page decodes it."""

from typing import Any

import numpy as np

from vvgt_cli.gaussians.formats.live import ROW


def from_bytes(stream: np.ndarray, facts: dict[str, Any]) -> np.ndarray:
    """Decode bytes and facts to `Gaussians.live`, (K, 9 to 11) float32, as a page does."""
    layers, (first, last) = facts["layers"], facts["log_lengths"]
    row = stream[:, ROW] + 256 * stream[:, ROW + 1].astype(np.int64)
    rows = np.array([layer["row"] for layer in layers])
    number = np.searchsorted(rows, row, side="right") - 1
    lo, hi = np.array([layer["values"] for layer in layers])[number].T
    share = stream.astype(np.float64) / 255
    value = lo + (hi - lo) * share[:, 0]
    spread = np.where(hi > lo, hi - lo, 1.0) * facts["widest"] * share[:, 1] ** facts["bend"]
    length = np.exp(first + (last - first) * share[:, 2])
    gradient, axis = (stream[:, 3:6].astype(np.float64) - 128) / 127, (stream[:, 6:9].astype(np.float64) - 128) / 127
    labelled = any(layer["labels"] for layer in layers) or len(layers) > 1
    columns = [value, spread, length, axis, gradient, *([row - rows[number]] if labelled else [])]
    found: np.ndarray = np.column_stack([*columns, *([number] if len(layers) > 1 else [])]).astype(np.float32)
    return found
