"""Where neighbouring pixels differ: which pixels need more rays."""

from __future__ import annotations

import numpy as np

from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations


@inlined()
def _difference(image: np.ndarray, row: int, col: int, i: int, j: int) -> float:
    """Return the largest difference of pixels (row, col) and (i, j) of ``image`` (h, w, c) in any channel."""
    most = 0.0
    for channel in range(image.shape[2]):
        most = max(most, abs(image[row, col, channel] - image[i, j, channel]))
    return most


@parallel_kernel("f4:3 b1:2 f4:2")
def _contrast(thread: ThreadSlice, image: np.ndarray, known: np.ndarray, out: np.ndarray) -> None:
    """Write `contrast` of ``image`` (h, w, c) into ``out`` (h, w); ``known`` (h, w) bool."""
    height, width = out.shape
    for row in iterations(thread, height):
        for col in range(width):
            most = 0.0
            if not known[row, col]:
                out[row, col] = most
                continue
            for i in range(max(row - 1, 0), min(row + 2, height)):
                for j in range(max(col - 1, 0), min(col + 2, width)):
                    if known[i, j]:
                        most = max(most, _difference(image, row, col, i, j))
            out[row, col] = most


def contrast(image: np.ndarray, known: np.ndarray | None = None) -> np.ndarray:
    """Return each pixel's largest difference from its 8 neighbours, (h, w), in any channel of an image (h, w, c).

    ``known`` (h, w) bool: pixels that have been rendered; others differ from nothing.
    """
    out = np.empty(image.shape[:2], image.dtype)
    _contrast(image, np.ones(image.shape[:2], bool) if known is None else known, out)
    return out
