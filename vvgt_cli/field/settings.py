"""Options of a run in blocks, and block sizes that fit in memory."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vvgt_cli.errors import UsageError
from vvgt_cli.field.grid import TILE_VOXELS, Boxes, CellGrid, Triple, piece_edge, tile_bits
from vvgt_cli.resources import free_memory
from vvgt_cli.volume import Volume
from vvgt_cli.volume.stored import Stored

LARGEST, SMALLEST = 256, 16  # voxels along the edge of a block; larger ones are no faster
SHARED = 256  # edge for shards, whatever the memory of their nodes: all must agree
MAX_FIELD = 1 << 24  # cells of the opacity field
BLOCK_SHARE = 0.3  # of a worker's memory that a block's voxels may take; a conversion takes as much again
MUCH = 1 << 27  # voxels from which several processes are quicker than one
MANY = 3_000_000  # Gaussians above which they are refined region by region: fewer fit in memory with their cells
A_WORKER = 1 << 30  # bytes of memory of a worker
EACH = 4  # blocks for each worker, so that none waits long for the last
HALOS = 4  # voxels along an edge that are read with a block, two on each side
COUNTED = 3  # extra bytes per voxel of types whose values are counted
ALWAYS = 300 << 20  # bytes of each process: libraries, coarse grids, a tile's tree, a batch of Gaussians


@dataclass(frozen=True)
class BlockOptions:
    """Options for processing a volume in blocks.

    Attributes:
        size: edge of a block in voxels; None chooses it by free memory.
        workers: number of processes; None chooses it by processors, memory and work.
        scheduler: "local", "slurm" or the address of a Dask scheduler; None runs without Dask.
        shard: index (from 1) and count of a job array; None processes all blocks.
        level: resolution level of a multi-resolution file, or "full"; None chooses the one that matches the screen.
    """

    size: int | None = None
    workers: int | None = None
    scheduler: str | None = None
    shard: tuple[int, int] | None = None
    level: int | str | None = None

    def __post_init__(self) -> None:
        """Check the block size."""
        if self.size is not None and (self.size < SMALLEST or self.size & (self.size - 1)):
            raise UsageError(f"--blocks {self.size}: expected auto, or a power of two of at least {SMALLEST}")


def worker_count(options: BlockOptions, voxels: int, gaussians: int, threads: int, block: int = 0) -> int:
    """Return the number of processes: as many as threads where there is much to do and memory for each.

    Processes on blocks of their own are quicker than threads within each kernel (docs/cluster.md). ``block`` is the
    number of bytes of the smallest block.
    """
    if options.workers is not None or options.scheduler is not None or options.shard is not None:
        return options.workers or 1
    if voxels < MUCH and gaussians <= MANY:
        return 1
    free = free_memory()
    if free is None:
        return max(threads, 1)
    return max(min(threads, int(free // A_WORKER), int((free - ALWAYS) // (ALWAYS + block))), 1)


def block_edge(volume: Volume, options: BlockOptions, voxel: int | None = None) -> int:
    """Return the edge of a block in voxels; in mapped files it is that across rows, which are read whole.

    ``voxel`` is the number of bytes per voxel, by default that of the volume's type.

    Raises:
        UsageError: not even the smallest block fits in memory.
    """
    free = free_memory()
    if options.size is not None or free is None or options.shard is not None:
        return options.size or SHARED
    tiles = len(Boxes(volume.dims, shape_of(volume, 1 << TILE_VOXELS)))  # a block has one or more
    workers = min(options.workers or 1, tiles) if options.scheduler in (None, "local") else 1
    beside = ALWAYS // 2 if workers > 1 else 0  # what this process keeps, whose libraries are in memory already
    room = BLOCK_SHARE * max(free - ALWAYS * workers - beside, 0) / workers
    edge = LARGEST
    while edge > SMALLEST and block_bytes(volume, edge, voxel) > room:
        edge //= 2
    while edge > 1 << TILE_VOXELS and workers > 1 and len(Boxes(volume.dims, shape_of(volume, edge))) < EACH * workers:
        edge //= 2
    whole = max(edge, 1 << TILE_VOXELS)  # whole tiles are integrated at a time
    need = workers * (block_bytes(volume, whole, voxel) + ALWAYS) + beside
    if need > free:
        each, fewer = (f" in {workers} workers", "; or take fewer --workers") if workers > 1 else ("", "")
        raise UsageError(
            f"blocks of {whole} voxels{each} and the coarse grids need about {need >> 20} MiB of memory, {free >> 20} "
            f"MiB are free; give the job {(need - free >> 20) + 1} MiB more{fewer}"
        )
    return edge


def block_bytes(volume: Volume, edge: int, voxel: int | None = None) -> int:
    """Return the bytes that a block takes during integration; ``voxel`` as in `block_edge`."""
    sizes = [min(e + HALOS, n) for e, n in zip(shape_of(volume, edge), volume.dims, strict=True)]
    one = volume.data.dtype.itemsize
    beside = 0 if volume.data.dtype == np.float32 else 4 if one > 2 else COUNTED
    return math.prod(sizes) * (voxel or one + beside)


def shape_of(volume: Volume, edge: int) -> Triple:
    """Return the size of a block in voxels (x, y, z); contiguous rows of a mapped file are read whole."""
    if isinstance(volume.data, Stored):
        return edge, edge, edge
    across = 1 << max(math.ceil(math.log2(max(volume.dims[0], 2))), 4)
    return max(across, edge), edge, edge


def cell_grid(volume: Volume, exponent: np.ndarray, edge: int, march: int, least: int = 1) -> CellGrid:
    """Return the grid of base cells of 2^``exponent`` (3,) voxels, in blocks of about ``edge`` voxels.

    Blocks are made of whole tiles, ray pieces and cubes of ``least`` voxels, all powers of two.
    """
    from vvgt_cli.closed_form.moments import blocks
    from vvgt_cli.closed_form.surface_offset import field_coarsening

    frame = volume.unit_frame()
    step = np.array(frame.step)
    field = field_coarsening(2.0**exponent * step, np.array(frame.half), MAX_FIELD)
    bits = tile_bits(exponent, max(march, field, int(blocks(exponent)[1].max()).bit_length() - 1))
    tile = np.round(2.0 ** (exponent + bits)).astype(np.int64)
    whole = np.maximum(tile, max(piece_edge(volume.dims), least))
    x, y, z = (int(t * max(w // t, 1)) for t, w in zip(whole, shape_of(volume, edge), strict=True))
    i, j, k = (int(e) for e in exponent)
    return CellGrid(Boxes(volume.dims, (x, y, z)), (i, j, k), frame.half, frame.step, march, field, bits)
