"""A tree's active bounding box as a `BrickArray`: leaves stay as they are, tiles become one value a brick."""

from __future__ import annotations

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.components import select_component
from vvgt_cli.volume.openvdb.bricks import EDGE, BrickArray, brick_grid
from vvgt_cli.volume.openvdb.tree import Node, Tree


def bounding_box(tree: Tree, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Find the first and last active voxel, (3,) int64 each (x, y, z).

    Raises:
        DataError: none is active.
    """
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
) -> BrickArray:
    """Lay out the voxels ``lo`` to ``hi`` (3,) (x, y, z), both included; of vectors one component.

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
    fill = _choose(fill, component, source, label)
    cubes = bricks.reshape(-1, EDGE, EDGE, *bricks.shape[4:])
    bricks = _choose(cubes, component, source, label).reshape(-1, EDGE, EDGE, EDGE)
    z, y, x = (int(v) for v in (lo - first * EDGE)[::-1])
    return BrickArray(fill, which, bricks, (z, y, x), [int(b - a) + 1 for a, b in zip(lo[::-1], hi[::-1], strict=True)])


def _choose(values: np.ndarray, component: int | str | None, source: str, label: str) -> np.ndarray:
    return select_component(values, component, source, label=label)[0]


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
