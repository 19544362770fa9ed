"""How a volume is cut: blocks that are read, tiles of cells that are kept, coarse grids that are marched through.

A tile is a cube of base cells, 64 along each axis or fewer where they are wide, a block a box of whole tiles. What is
kept of a tile depends on the volume and the base cells alone, so that everything that follows is the same to the byte
whatever blocks were read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

TILE_BITS = 6  # a tile has at most 2^6 base cells along its edge
TILE_VOXELS = 7  # and 2^7 voxels, where it has 2^3 cells or more: memory holds blocks of whole tiles
FEWEST_BITS = 3
PIECES = 8  # along the longest axis, into which rays are cut; each of a power of two voxels
SMALLEST_PIECE, LARGEST_PIECE = 16, 128
Triple = tuple[int, int, int]


@dataclass(frozen=True)
class Boxes:
    """A volume of ``dims`` voxels cut into boxes of ``edge`` voxels, both (x, y, z); numbered x fastest."""

    dims: Triple
    edge: Triple

    @property
    def shape(self) -> Triple:
        """Boxes along each axis."""
        nx, ny, nz = (-(-n // e) for n, e in zip(self.dims, self.edge, strict=True))
        return nx, ny, nz

    def __len__(self) -> int:
        return math.prod(self.shape)

    def at(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """First voxel (3,) of a box, and that behind its last one, int64."""
        nx, ny, _ = self.shape
        index = np.array([number % nx, number // nx % ny, number // (nx * ny)], np.int64)
        lo = index * np.array(self.edge, np.int64)
        return lo, np.minimum(lo + self.edge, self.dims)


@dataclass(frozen=True)
class CellGrid:
    """The base cells of a volume and what is made of them.

    Attributes:
        blocks: that are read, of whole tiles.
        exponent: a cell's edges are 2^exponent voxels, (x, y, z).
        half, step: of the volume, as `vvgt_cli.dvr.Scene` has them.
        march: the cells that visibility is marched through are 2^march times as wide.
        field: those of the field of opacity, 2^field times.
        bits: a tile has 2^bits base cells along its edge.
    """

    blocks: Boxes
    exponent: Triple
    half: tuple[float, float, float]
    step: tuple[float, float, float]
    march: int
    field: int
    bits: int = TILE_BITS

    @property
    def dims(self) -> np.ndarray:
        """Voxels (3,) of the volume."""
        return np.array(self.blocks.dims, np.int64)

    @property
    def cell(self) -> np.ndarray:
        """Edges (3,) of a base cell, voxels."""
        result: np.ndarray = 2.0 ** np.array(self.exponent)
        return result

    @property
    def cell_edge(self) -> np.ndarray:
        """Edges (3,) of a base cell, unit-frame lengths."""
        result: np.ndarray = self.cell * np.array(self.step)
        return result

    @property
    def tile_cells(self) -> int:
        """Base cells along the edge of a tile."""
        return 1 << self.bits

    @property
    def tile(self) -> np.ndarray:
        """Edges (3,) of a tile, voxels."""
        return np.round(self.tile_cells * self.cell).astype(np.int64)

    def tiles(self, number: int) -> np.ndarray:
        """Numbers (n, 3) int64, (x, y, z), of the tiles in a block."""
        lo, hi = self.blocks.at(number)
        first, last = lo // self.tile, -(-hi // self.tile)
        local = np.argwhere(np.ones((last - first)[::-1]))[:, ::-1]
        result: np.ndarray = local + first
        return result

    def coarse_shape(self, wider: int) -> np.ndarray:
        """Cells (3,) along each axis, x first, of the grid of cells 2^``wider`` times as wide."""
        return np.ceil(self.dims / (self.cell * 2.0**wider)).astype(np.int64)


def tile_bits(exponent: np.ndarray, least: int) -> int:
    """`CellGrid.bits` of cells of 2^``exponent`` (3,) voxels, of which 2^``least`` must lie in one tile."""
    return max(min(TILE_BITS, TILE_VOXELS - int(exponent.max())), FEWEST_BITS, least)


def piece_edge(dims: Triple) -> int:
    """Voxels along the edge of the pieces that rays are cut into: they follow from the volume, not from the blocks."""
    edge = SMALLEST_PIECE
    while edge < LARGEST_PIECE and edge * PIECES < max(dims):
        edge *= 2
    return edge
