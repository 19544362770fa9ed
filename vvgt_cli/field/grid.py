"""The division of a volume: blocks that are read, tiles of cells that are stored, coarse grids for marching.

A tile is a cube of at most 64 base cells along each axis, a block a box of whole tiles. A tile's data depend only on
the volume and the base cells, so all results are the same to the byte whatever the blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

TILE_BITS = 6  # a tile has at most 2^6 base cells along its edge
TILE_VOXELS = 7  # and 2^7 voxels, unless that is fewer than 2^3 cells: blocks of whole tiles must fit in memory
FEWEST_BITS = 3
PIECES = 8  # along the longest axis, at whose faces rays are cut; their edge is a power of two voxels
SMALLEST_PIECE, LARGEST_PIECE = 16, 128
Triple = tuple[int, int, int]


@dataclass(frozen=True)
class Boxes:
    """A volume of ``dims`` voxels divided into boxes of ``edge`` voxels, both (x, y, z); numbered with x fastest."""

    dims: Triple
    edge: Triple

    @property
    def shape(self) -> Triple:
        """Number of boxes along each axis."""
        nx, ny, nz = (-(-n // e) for n, e in zip(self.dims, self.edge, strict=True))
        return nx, ny, nz

    def __len__(self) -> int:
        """Return the number of boxes."""
        return math.prod(self.shape)

    def at(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the first voxel (3,) of a box and the end of its range, exclusive, int64."""
        lo = self.index(np.int64(number)) * np.array(self.edge, np.int64)
        return lo, np.minimum(lo + self.edge, self.dims)

    def index(self, numbers: np.ndarray | np.int64) -> np.ndarray:
        """Return the indices (..., 3) int64, x first, of boxes by number."""
        return np.stack(np.unravel_index(numbers, self.shape[::-1])[::-1], axis=-1)


@dataclass(frozen=True)
class CellGrid:
    """The base cells of a volume, and the coarser grids derived from them.

    Attributes:
        blocks: the boxes that are read, each of whole tiles.
        exponent: a cell's edges are 2^exponent voxels, (x, y, z).
        half, step: half extents and voxel edges of the volume, as in `vvgt_cli.dvr.Scene`.
        march: cells of the visibility march are 2^march times as wide.
        field: cells of the opacity field are 2^field times as wide.
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
        """Size of the volume in voxels, (3,)."""
        return np.array(self.blocks.dims, np.int64)

    @property
    def cell(self) -> np.ndarray:
        """Edges of a base cell in voxels, (3,)."""
        return 2.0 ** np.array(self.exponent)

    @property
    def cell_edge(self) -> np.ndarray:
        """Edges of a base cell in unit-frame lengths, (3,)."""
        return self.cell * np.array(self.step)

    @property
    def tile_cells(self) -> int:
        """Number of base cells along the edge of a tile."""
        return 1 << self.bits

    @property
    def tile(self) -> np.ndarray:
        """Edges of a tile in voxels, (3,)."""
        return np.round(self.tile_cells * self.cell).astype(np.int64)

    def tiles(self, number: int) -> np.ndarray:
        """Return the indices (n, 3) int64, (x, y, z), of the tiles in a block."""
        lo, hi = self.blocks.at(number)
        first, last = lo // self.tile, -(-hi // self.tile)
        local = np.argwhere(np.ones((last - first)[::-1]))[:, ::-1]
        return local + first

    def coarse_shape(self, wider: int) -> np.ndarray:
        """Return the size (3,), x first, of the grid of cells 2^``wider`` times as wide."""
        return np.ceil(self.dims / (self.cell * 2.0**wider)).astype(np.int64)


def tile_bits(exponent: np.ndarray, least: int) -> int:
    """Return `CellGrid.bits` for cells of 2^``exponent`` (3,) voxels, with at least 2^``least`` along a tile's edge."""
    return max(min(TILE_BITS, TILE_VOXELS - int(exponent.max())), FEWEST_BITS, least)


def piece_edge(dims: Triple) -> int:
    """Return the edge in voxels of the pieces that rays are cut into, which is independent of the blocks."""
    edge = SMALLEST_PIECE
    while edge < LARGEST_PIECE and edge * PIECES < max(dims):
        edge *= 2
    return edge
