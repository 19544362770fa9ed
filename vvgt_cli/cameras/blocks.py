"""Blocks of pixels that stand for a large picture: errors are measured there for what a small one costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BLOCK = 16  # pixels along an edge: the tile of the ray caster and of the splatter
ENOUGH = 625  # blocks: as many as a picture of 400 px has
FEW = 250  # blocks that tell the better of two results, and from where one looks worst
GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class Blocks:
    """Some of the blocks that tile a picture from its upper left corner.

    Attributes:
        width, height: of the picture in pixels.
        numbers: (n,) int64 blocks in row-major order of ceil(width / 16) a row; all lie wholly inside.
    """

    width: int
    height: int
    numbers: np.ndarray

    def mask(self) -> np.ndarray:
        """(height, width) bool: pixels of the blocks."""
        rows, across = -(-self.height // BLOCK), -(-self.width // BLOCK)
        chosen = np.zeros(rows * across, bool)
        chosen[self.numbers] = True
        wide = chosen.reshape(rows, across).repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)
        return np.ascontiguousarray(wide[: self.height, : self.width])  # as kernels are compiled for

    def pick(self, image: np.ndarray) -> np.ndarray:
        """The blocks of an image (h, w, c) below each other: (16 n, 16, c)."""
        across = -(-self.width // BLOCK)
        top, left = self.numbers // across * BLOCK, self.numbers % across * BLOCK
        inside = np.arange(BLOCK)
        picked = image[top[:, None, None] + inside[:, None], left[:, None, None] + inside]  # (n, 16, 16, c)
        return picked.reshape(-1, BLOCK, image.shape[2])


def spread_blocks(width: int, height: int, shift: int = 0, enough: int = ENOUGH) -> Blocks | None:
    """About ``enough`` blocks on a lattice over the picture; None where that would be nearly all of it.

    Every s-th block of the first row, and from row to row the golden part of s further, so that no line or column of
    the picture is left out; ``shift`` takes others of the s sets (of other views, say), as many.
    """
    rows, across = height // BLOCK, width // BLOCK
    every = round(rows * across / enough)
    if every < 2:
        return None
    row, column = np.divmod(np.arange(rows * across), across)
    place = (column + round(GOLDEN * every) * row + shift) % every
    kept = np.sort(np.argsort(place, kind="stable")[: rows * across // every])
    return Blocks(width, height, (row * -(-width // BLOCK) + column)[kept])
