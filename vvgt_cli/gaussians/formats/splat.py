"""`.splat` of antimatter15's viewer, read-only: 32 bytes per Gaussian, in the axes of the `.ply` that it came from.

Centre and linear scales are 3 float32 each; then R, G, B and opacity, and the rotation (w, x, y, z) times 128 plus 128,
are bytes. Colours are display RGB, like ``0.5 + SH_C0 * f_dc``; there are no harmonics.
"""

from __future__ import annotations

from typing import Any, NoReturn

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.splats import Splats
from vvgt_cli.gaussians.opacity import logits_of
from vvgt_cli.gaussians.ply import colors_to_f_dc

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


def read_splat(content: bytes, name: str) -> Splats:
    """Read the columns of a `.splat`, or raise DataError; scales of 0 become -inf, rotations of 0 NaN."""
    if not content or len(content) % _ROW.itemsize:
        raise DataError(f"{name}: {len(content)} bytes; expected a .splat of 32 bytes a Gaussian")
    rows = np.frombuffer(content, _ROW)
    rgba, rotations = rows["rgba"] / np.float32(255), rows["rotation"] / np.float32(128) - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scale"])
        rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    none = np.zeros((len(rows), 0, 3), np.float32)
    return Splats(rows["mean"], log_scales, rotations, logits_of(rgba[:, 3]), colors_to_f_dc(rgba[:, :3]), none)


def refuse(content: Any, name: str) -> NoReturn:
    """Raise the error for formats that cannot be read or written."""
    raise DataError(f"{name}: this format is not supported; expected a .ply: try splat-transform {name} out.ply")
