"""OpenVDB ``.vdb``, format versions 222 to 224: the active bounding box of one grid, bit for bit as OpenVDB reads it.

Read here because no wheel of OpenVDB exists; its own Python module, where a system has it, reads fewer types.
"""

from __future__ import annotations

import mmap
from pathlib import Path

from vvgt_cli.errors import DataError
from vvgt_cli.volume.components import choose
from vvgt_cli.volume.openvdb.archive import TYPES, Grid, read_grid_head, read_header
from vvgt_cli.volume.openvdb.cursor import Cursor
from vvgt_cli.volume.openvdb.layout import bounding_box, brick_array
from vvgt_cli.volume.openvdb.tree import Tree, TreeReader
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import volume_name
from vvgt_cli.volume.types import Volume


def choose_grid(grids: list[Grid], wanted: str | None, source: str) -> Grid:
    """Choose the grid of a name; without one the only grid of scalars, else the only grid.

    Raises:
        UsageError: no such grid, or several and no choice.
        DataError: a grid that cannot be read.
    """
    how = "choose one with --grid NAME"
    if wanted is None:
        found = [g for g in grids if g.readable and g.components == 1] or grids
        names = [g.label for g in found]
    else:
        found, names = grids, [g.label for g in grids]
        if wanted not in names:
            names, how = [g.name for g in grids], how + " (name one with its number, NAME[0], where several share it)"
    grid = found[choose(names, list(map(str, grids)), wanted, source, "grid", how, "--grid")]
    if not grid.readable:
        kinds = ", ".join(TYPES)
        raise DataError(f"{source}: grid {grid}; expected values of type {kinds} in a tree 5-4-3")
    return grid


def read_tree(cursor: Cursor, grids: list[Grid], grid: Grid) -> Tree:
    """Read the tree of a grid, or of the grid that it shares it with; the cursor stands behind the grid's transform.

    Raises:
        DataError: damage, or no such other grid.
    """
    if grid.parent:
        owner = next((g for g in grids if not g.parent and g.unique == grid.parent), None)
        if owner is None or owner.kind != grid.kind:
            raise DataError(f"{cursor.name}: grid {grid} shares the tree of {grid.parent!r}, which is not in the file")
        cursor.seek(owner.start)
        grid = owner
    else:
        cursor.seek(grid.start)
    compression, half, _ = read_grid_head(cursor)
    return TreeReader(cursor, grid.kind, grid.half or half, compression).read()


def read_vdb(path: Path, options: ReadOptions) -> Volume:
    """Read a grid: all voxels of its active bounding box, tiles and background filled in.

    Spacing, direction and origin come from the grid's transform.

    Raises:
        DataError: a version, tree or transform that cannot be read, damage, no active voxel, or more than the memory.
        UsageError: several grids, or components of vectors, and none chosen.
    """
    with open(path, "rb") as file:
        # not closed here: an error on its way up still holds views of it
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    cursor = Cursor(memoryview(mapped), str(path))
    grids = read_header(cursor)
    grid = choose_grid(grids, options.array, str(path))
    cursor.seek(grid.start)
    placement = read_grid_head(cursor)[2]
    tree = read_tree(cursor, grids, grid)
    lo, hi = bounding_box(tree, f"{path}: grid {grid}")
    values = brick_array(tree, lo, hi, options.component, str(path), f"grid {grid.label!r}")
    return Volume(
        values,  # type: ignore[arg-type]  # a BrickArray, which is read where it is indexed
        options.spacing_or(placement.spacing),
        placement.at(lo),
        placement.direction,
        volume_name(path),
    )
