"""Blocks of pixels that represent a large picture, so that measuring its error costs as little as for a small one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BLOCK = 16  # pixels along an edge: the tile of the ray caster and the splat renderer
ENOUGH = 625  # blocks: as many as in a picture of 400 px
FEW = 250  # blocks that suffice to compare two results, or to find the worst view of one
GOLDEN = 0.6180339887498949  # multiples of it, modulo 1, are far from each other


@dataclass(frozen=True)
class Blocks:
    """A subset of the blocks that tile a picture from its upper left corner.

    Attributes:
        width, height: size of the picture in pixels.
        numbers: (n,) int64 block numbers, row-major with ceil(width / 16) per row; all blocks lie inside the picture.
    """

    width: int
    height: int
    numbers: np.ndarray

    @classmethod
    def whole(cls, width: int, height: int) -> Blocks:
        """Return all blocks of a picture, those that reach beyond it too."""
        return cls(width, height, np.arange(-(-width // BLOCK) * -(-height // BLOCK)))

    def mask(self) -> np.ndarray:
        """Return the mask (height, width) of the blocks' pixels."""
        rows, across = -(-self.height // BLOCK), -(-self.width // BLOCK)
        chosen = np.zeros(rows * across, bool)
        chosen[self.numbers] = True
        wide = chosen.reshape(rows, across).repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)
        return np.ascontiguousarray(wide[: self.height, : self.width])  # as kernels are compiled for

    def image(self, colors: np.ndarray) -> np.ndarray:
        """Return the picture (h, w, c) float32 with the ``colors`` (n, c) of the pixels of `mask`, zero elsewhere."""
        picture = np.zeros((self.height, self.width, colors.shape[1]), np.float32)
        picture[self.mask()] = colors
        return picture

    def pick(self, image: np.ndarray) -> np.ndarray:
        """Stack the blocks of an image (h, w, c) vertically, (16 n, 16, c)."""
        across = -(-self.width // BLOCK)
        top, left = self.numbers // across * BLOCK, self.numbers % across * BLOCK
        inside = np.arange(BLOCK)
        picked = image[top[:, None, None] + inside[:, None], left[:, None, None] + inside]  # (n, 16, 16, c)
        return picked.reshape(-1, BLOCK, image.shape[2])


def picked(image: np.ndarray, blocks: Blocks | None) -> np.ndarray:
    """Return `Blocks.pick` of an image (h, w, c), or the image itself without blocks."""
    return image if blocks is None else blocks.pick(image)


def drawn_pixels(size: int, enough: int = ENOUGH) -> int:
    """Return how many pixels of a square picture of ``size`` px are drawn: all, or those of `spread_blocks`."""
    blocks = spread_blocks(size, size, enough=enough)
    return size**2 if blocks is None else blocks.numbers.size * BLOCK**2


def spread_blocks(width: int, height: int, shift: int = 0, enough: int = ENOUGH) -> Blocks | None:
    """Return about ``enough`` blocks on a lattice over a picture, None if that is nearly all of it.

    The lattice has every s-th block of a row, shifted from row to row by the golden section of s so that it covers all
    rows and columns; ``shift`` selects one of s disjoint lattices, for example another one per view.
    """
    rows, across = height // BLOCK, width // BLOCK
    every = round(rows * across / enough)
    if every < 2:
        return None
    row, column = np.divmod(np.arange(rows * across), across)
    place = (column + round(GOLDEN * every) * row + shift) % every
    kept = np.sort(np.argsort(place, kind="stable")[: rows * across // every])
    return Blocks(width, height, (row * -(-width // BLOCK) + column)[kept])
