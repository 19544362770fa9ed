"""OpenVDB ``.vdb``, format versions 222 to 225: the active bounding box of one grid, bit for bit as OpenVDB reads it.

A tree's active bounding box is kept as those 8^3 bricks that vary (leaves, as they are), beside one value for every
other brick (tiles). Its slabs are put together when they are asked for, or all of it once, in memory that takes no page
where all is zero.
"""

from __future__ import annotations

import math
import mmap
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.components import choose, listed, select_component
from vvgt_cli.volume.openvdb.archive import TYPES, Grid, read_grid_head, read_header
from vvgt_cli.volume.openvdb.codec import Cursor
from vvgt_cli.volume.openvdb.tree import Node, Tree, TreeReader
from vvgt_cli.volume.reading import ReadOptions, Slices, Stored, Volume, check_memory, placed, printable, volume_name

LOOKS = dict.fromkeys(("density", "smoke"), "smoke") | dict.fromkeys(("flame", "flames", "temperature", "heat"), "fire")
EDGE = 8  # voxels along a brick
MAX_VOXELS = 1 << 36  # 4096^3: the box alone, not what is in it, decides how long a walk through it takes


def choose_grid(grids: list[Grid], wanted: str | None, source: str) -> Grid:
    """Choose the grid of a name; without one "density", the only grid of scalars, or else the only grid.

    Raises:
        UsageError: no such grid, or several and no choice.
        DataError: a grid that cannot be read.
    """
    how = "choose one with --grid NAME"
    if wanted is None:
        fits = [g for g in grids if g.readable and g.components == 1] or grids
        densities = [g for g in fits if g.name == "density"]
        if len(fits) > len(densities) == 1:
            fits = densities
            others = listed([g.label for g in grids if g is not fits[0]])
            warnings.warn(
                f"{source}: grid density; --grid, or a --layer with array=, takes another: {others}", stacklevel=3
            )
        names = [g.label for g in fits]
    else:
        fits, names = grids, [g.label for g in grids]
        if wanted not in names:
            names, how = [g.name for g in grids], how + " (name one with its number, NAME[0], where several share it)"
    grid = fits[choose(names, list(map(str, grids)), wanted, source, "grid", how, "--grid")]
    if not grid.readable:
        kinds = ", ".join(TYPES)
        raise DataError(f"{source}: grid {grid}; expected values of type {kinds} in a tree 5-4-3")
    return grid


def read_tree(cursor: Cursor, grids: list[Grid], grid: Grid) -> Tree:
    """Read a grid's tree, or that it shares, the cursor behind the grid's transform, or raise DataError."""
    if grid.parent:
        owner = next((g for g in grids if not g.parent and g.unique == grid.parent), None)
        if owner is None or owner.kind != grid.kind:
            raise DataError(f"{cursor.name}: grid {grid} shares the tree of {grid.parent!r}, which is not in the file")
        grid = owner
    cursor.seek(grid.start)
    compression, half, _ = read_grid_head(cursor)
    return TreeReader(cursor, grid.kind, grid.half or half, compression).read()


def read_vdb(path: Path, options: ReadOptions) -> Volume:
    """Read a grid: all voxels of its active bounding box, tiles and background filled in.

    Spacing, direction and origin come from the grid's transform.
    """
    with open(path, "rb") as file:
        # not closed here: an error on its way up still holds views of it
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    cursor = Cursor(memoryview(mapped), str(path))
    grids = read_header(cursor)
    grid = choose_grid(grids, options.array, str(path))
    cursor.seek(grid.start)
    transform = read_grid_head(cursor)[2]
    tree = read_tree(cursor, grids, grid)
    lo, hi = bounding_box(tree, f"{path}: grid {grid}")
    values: Any = brick_array(tree, lo, hi, options.component, str(path), f"grid {grid.label!r}")
    if not (options.stored or options.packed):
        values = laid_out(values)
    origin = lo @ transform[:3] + transform[3]
    facts = {"quantity": printable(grid.name), "preset": LOOKS.get(grid.name, "")}
    return placed(values, transform[:3], origin, options, volume_name(path), **facts)


def bounding_box(tree: Tree, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Find the first and last active voxel, (3,) int64 each (x, y, z); raise DataError if none is active."""
    lo, hi = [], []
    for node in tree.nodes:
        for axis in range(3):
            if axis == 0 and not node.active.any():
                break
            where = np.flatnonzero(node.active.any(axis=tuple({0, 1, 2} - {axis})))
            ends = node.origin[axis] + np.array([where[0], where[-1] + 1]) * node.step
            lo.append((axis, int(ends[0])))
            hi.append((axis, int(ends[1]) - 1))
    used = np.flatnonzero(tree.masks.any(axis=1))
    if len(used):
        bytes_xy = tree.masks[used].reshape(-1, 8, 8)  # by x, y: bit z
        by_z = np.unpackbits(np.bitwise_or.reduce(bytes_xy, axis=(1, 2))[:, None], axis=1, bitorder="little")
        marks: list[np.ndarray] = [np.any(bytes_xy, axis=2), np.any(bytes_xy, axis=1), by_z.view(bool)]
        for axis, on in enumerate(marks):
            first = on.argmax(axis=1)
            last = EDGE - 1 - on[:, ::-1].argmax(axis=1)
            lo.append((axis, int((tree.origins[used, axis] + first).min())))
            hi.append((axis, int((tree.origins[used, axis] + last).max())))
    if not lo:
        raise DataError(f"{name}: the grid has no active voxel; expected at least one")
    return (
        np.array([min(v for a, v in lo if a == axis) for axis in range(3)], np.int64),
        np.array([max(v for a, v in hi if a == axis) for axis in range(3)], np.int64),
    )


def brick_array(
    tree: Tree, lo: np.ndarray, hi: np.ndarray, component: int | str | None, source: str, label: str
) -> Stored:
    """Wrap the voxels ``lo`` to ``hi`` (3,) (x, y, z), both included; of vectors one component.

    Raises:
        DataError: more than the free memory, or a box that is too large.
        UsageError: vectors and no component chosen.
    """
    tail = tree.background.shape if len(tree.background) > 1 else ()
    first, count = brick_grid(lo, hi, tree.background.nbytes, source)
    shape = tuple(int(n) for n in count[::-1])
    fill = np.empty((*shape, *tail), tree.background.dtype)
    fill[...] = tree.background if tail else tree.background[0]
    which = np.full(shape, -1, np.int32)
    for node in tree.nodes:
        _paint(fill, node, first, tree.background)
    place = (tree.origins // EDGE - first)[:, ::-1]  # z, y, x
    inside = ((place >= 0) & (place < shape)).all(axis=1)
    rows = np.flatnonzero(inside)
    which[tuple(place[rows].T)] = rows
    bricks = tree.leaves
    if not tail:
        fill, bricks = fill[..., None], bricks[..., None]
    fill, _ = select_component(fill, component, source, label=label)
    cubes, _ = select_component(bricks.reshape(-1, EDGE, EDGE, *bricks.shape[4:]), component, source, label=label)
    bricks = cubes.reshape(-1, EDGE, EDGE, EDGE)
    z0, y0, x0 = (int(v) for v in (lo - first * EDGE)[::-1])

    @lru_cache(maxsize=1)  # as slabs are thinner than bricks
    def layer(at: int) -> np.ndarray:
        """Return the values (8, 8 by, 8 bx) of one layer of bricks."""
        by, bx = which.shape[1:]
        out = np.empty((EDGE, by, EDGE, bx, EDGE), fill.dtype)
        out[:] = fill[at][None, :, None, :, None]
        j, i = np.nonzero(which[at] >= 0)
        # bricks are (n, x, y, z); indices apart put n first: (n, z, y, x)
        out[:, j, :, i, :] = bricks[which[at, j, i]].transpose(0, 3, 2, 1)
        return out.reshape(EDGE, by * EDGE, bx * EDGE)

    def read(slices: Slices) -> np.ndarray:
        z, y, x = slices
        out = np.empty([max(s.stop - s.start, 0) for s in slices], fill.dtype)
        k = z.start
        while k < z.stop:
            at, inside = divmod(k + z0, EDGE)
            n = min(EDGE - inside, z.stop - k)
            box = layer(at)[inside : inside + n, y0 + y.start : y0 + y.stop, x0 + x.start : x0 + x.stop]
            out[k - z.start : k - z.start + n] = box
            k += n
        return out

    shape = tuple(int(b - a) + 1 for a, b in zip(lo[::-1], hi[::-1], strict=True))
    return Stored(read, fill.dtype, shape, (EDGE, *shape[1:]), source, in_file=False)


def laid_out(values: Stored) -> np.ndarray:
    """Return the values in memory, read-only; pages are taken only where something differs from zero.

    Raises:
        DataError: more than the free memory.
    """
    check_memory(values.nbytes, f"{' x '.join(map(str, reversed(values.shape)))} voxels laid out")
    out = _blank(values.shape, values.dtype)
    for z in range(0, len(values), EDGE):
        slab = values[z : z + EDGE]
        rows = slab.view(np.uint8).any(axis=2)  # bytes, not values: minus zero is something
        out[z : z + EDGE][rows] = slab[rows]
    out.flags.writeable = False
    return out


def _paint(fill: np.ndarray, node: Node, first: np.ndarray, background: np.ndarray) -> None:
    """Write a node's tiles into the bricks (z, y, x, ...) that they cover."""
    corner = node.origin // EDGE - first  # in bricks, x, y, z
    size = np.array(fill.shape[2::-1])  # x, y, z
    width = node.step // EDGE  # bricks along a tile
    n = len(node.child)
    begin = np.maximum(-corner // width, 0)  # tiles that overlap the bricks
    end = np.minimum(-((corner - size) // width), n)
    if (begin >= end).any():
        return
    part = tuple(slice(int(b), int(e)) for b, e in zip(begin, end, strict=True))
    values, child = node.values[part], node.child[part]
    if width == 1:
        x, y, z = (corner + begin).tolist()
        dx, dy, dz = child.shape
        # children are painted too, with values of no meaning: they are leaves, which come before the fill
        fill[z : z + dz, y : y + dy, x : x + dx] = values.swapaxes(0, 2)
        return
    same = values.view(np.uint8).reshape(*child.shape, -1) == background.view(np.uint8)
    for entry in np.argwhere(~child & ~same.all(axis=-1)):
        at = corner + (begin + entry) * width
        x0, y0, z0 = np.maximum(at, 0).tolist()
        x1, y1, z1 = np.minimum(at + width, size).tolist()
        fill[z0:z1, y0:y1, x0:x1] = values[tuple(entry)]


def brick_grid(lo: np.ndarray, hi: np.ndarray, itemsize: int, source: str) -> tuple[np.ndarray, np.ndarray]:
    """Return first brick and number of bricks, (3,) each, of voxels ``lo`` to ``hi`` (3,), both included.

    Raise DataError if the grid is too large.
    """
    size = [int(b) - int(a) + 1 for a, b in zip(lo, hi, strict=True)]
    if math.prod(size) > MAX_VOXELS:
        raise DataError(
            f"{source}: active voxels span {' x '.join(map(str, size))}; expected no more than 4096^3 in all; crop or "
            "resample the grid first"
        )
    first = np.asarray(lo, np.int64) // EDGE
    count = np.asarray(hi, np.int64) // EDGE - first + 1
    n = [int(c) for c in count]
    # the tables, and two layers of bricks laid out as slabs are put together
    check_memory(math.prod(n) * (itemsize + 4) + 2 * n[0] * n[1] * EDGE**3 * itemsize, source)
    return first, count


def _blank(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Make zeros in private anonymous memory of small pages: one row that is written must not take 2 MiB."""
    if not (hasattr(mmap, "MAP_PRIVATE") and hasattr(mmap, "MADV_NOHUGEPAGE")):
        return np.zeros(shape, dtype)
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | getattr(mmap, "MAP_NORESERVE", 0)
    memory = mmap.mmap(-1, max(math.prod(shape) * dtype.itemsize, 1), flags=flags)
    memory.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(memory, dtype, math.prod(shape)).reshape(shape)
