"""The curve between two nodes that vtkPiecewiseFunction and vtkColorTransferFunction share."""

from __future__ import annotations

import numpy as np

from vvgt_cli.errors import DataError

MIDPOINT_MARGIN = 1e-5  # VTK keeps midpoints this far from the ends of the segment
LINEAR_BELOW = 0.01  # sharpness below which a segment is linear
STEP_ABOVE = 0.99  # sharpness above which a colour (not an opacity) is a step at the midpoint


def bend(s: np.ndarray, midpoint: np.ndarray) -> np.ndarray:
    """Move position s in [0, 1] of a segment so that ``midpoint`` lands on 0.5, (n,) -> (n,)."""
    m = np.clip(midpoint, MIDPOINT_MARGIN, 1 - MIDPOINT_MARGIN)
    result: np.ndarray = np.where(s < m, 0.5 * s / m, 0.5 + 0.5 * (s - m) / (1.0 - m))
    return result


def compress(s: np.ndarray, sharpness: np.ndarray) -> np.ndarray:
    """Press bent positions s in [0, 1] towards the ends of the segment, power 1 + 10 sharpness, (n,) -> (n,)."""
    power = 1.0 + 10.0 * sharpness
    low = 0.5 * np.power(2.0 * np.minimum(s, 0.5), power)
    high = 1.0 - 0.5 * np.power(2.0 * (1.0 - np.maximum(s, 0.5)), power)
    return np.where(s < 0.5, low, np.where(s > 0.5, high, s))


def hermite_weight(s: np.ndarray, sharpness: np.ndarray) -> np.ndarray:
    """Weight w of the right node, value ``(1 - w) y1 + w y2``, for compressed s (n,) -> (n,).

    The cubic Hermite curve with both tangents ``(1 - sharpness)(y2 - y1)`` is affine in the two
    values, so one weight serves opacity and every colour component.
    """
    s2 = s * s
    s3 = s2 * s
    result: np.ndarray = -2 * s3 + 3 * s2 + (1.0 - sharpness) * (2 * s3 - 3 * s2 + s)
    return result


def sorted_nodes(what: str, x: np.ndarray, *columns: np.ndarray) -> list[np.ndarray]:
    """Check node arrays and sort them by x as VTK does (stable: equal x keep their order).

    Args:
        what: name of the function for messages.
        x: (n,) node positions, n >= 1.
        columns: arrays of n rows.

    Raises:
        DataError: no node, lengths that differ, a value that is not finite.
    """
    arrays = [np.asarray(a, dtype=np.float64) for a in (x, *columns)]
    count = arrays[0].shape[0] if arrays[0].ndim == 1 else -1
    if count < 1:
        raise DataError(f"{what}: no nodes; expected at least one")
    for a in arrays:
        if a.shape[0] != count:
            raise DataError(f"{what}: {count} node positions but {a.shape[0]} values; expected as many")
        if not np.isfinite(a).all():
            raise DataError(f"{what}: a node is not finite; expected numbers")
    order = np.argsort(arrays[0], kind="stable")
    return [a[order] for a in arrays]


def unit_interval(what: str, field: str, values: np.ndarray) -> None:
    """Raise DataError unless all of ``values`` lie in [0, 1]."""
    bad = (values < 0) | (values > 1)
    if bad.any():
        raise DataError(f"{what}: {field} {values[bad].flat[0]:g}; expected a number in [0, 1]")
