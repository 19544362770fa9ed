"""Trees of OpenVDB files, configuration 5-4-3: a root, nodes of 32^3 and 16^3 children or tiles, leaves of 8^3 voxels.

Layout as readTopology and readBuffers have it in openvdb/tree/RootNode.h, InternalNode.h, LeafNode.h, LeafNodeBool.h
and LeafNodeMask.h, and readCompressedValues in openvdb/io/Compression.h. Every count is one of bits in masks that are
in the file, so that memory stays within some hundred times the file; it is compared with the free memory as it grows.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.resources import free_memory
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.openvdb.archive import TYPES
from vvgt_cli.volume.openvdb.codec import ACTIVE_MASK, Cursor, read_block

LEAF, LOWER, UPPER = 8, 128, 4096  # voxels along the edge
_MASK = LEAF**3 // 8  # bytes
_CHUNK = 4096  # leaves whose masks are unpacked at once


@dataclass(frozen=True)
class Node:
    """An inner node, or the root's tile (one entry).

    Attributes:
        origin: (3,) int64 its first voxel (x, y, z).
        step: voxels along one of its entries.
        values: (n, n, n, ...) of the tiles, by x, y, z.
        active: (n, n, n) bool, tiles that are active.
        child: (n, n, n) bool, entries that are no tiles.
    """

    origin: np.ndarray
    step: int
    values: np.ndarray
    active: np.ndarray
    child: np.ndarray


@dataclass
class Tree:
    """A tree as it is in the file.

    Attributes:
        background: (c,) value of all that is in no node.
        nodes: root's tiles, then inner nodes, each after its parent.
        origins: (n, 3) int64 first voxels of the leaves (x, y, z).
        masks: (n, 64) uint8, active voxels of the leaves: bit z of byte 8 x + y.
        leaves: (n, 8, 8, 8, ...) values by x, y, z.
    """

    background: np.ndarray
    nodes: list[Node] = field(default_factory=list)
    origins: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    masks: np.ndarray = field(default_factory=lambda: np.zeros((0, _MASK), np.uint8))
    leaves: np.ndarray = field(default_factory=lambda: np.zeros(0))


class TreeReader:
    """A reader of one tree, which checks sizes before it allocates."""

    def __init__(self, cursor: Cursor, kind: str, half: bool, compression: int) -> None:
        """Take a cursor behind the grid's transform; ``kind`` is a key of `TYPES`."""
        code, components = TYPES[kind]
        self.cursor, self.kind, self.compression = cursor, kind, compression
        self.dtype = np.dtype(code)
        self.stored = np.dtype("<f2") if half and self.dtype.kind == "f" else self.dtype
        self.shape = (components,) if components > 1 else ()
        self.room = free_memory()

    def read(self) -> Tree:
        """Read the tree; raise DataError if it is cut short, damaged, or larger than the free memory."""
        (buffers,) = self.cursor.unpack("i")
        if buffers != 1:
            raise self.cursor.bad(f"a tree of {buffers} buffers where one is expected")
        self.background = self.minus = self.one()
        self.minus = ~self.background if self.dtype.kind == "b" else -self.background
        tree = Tree(self.background)
        tiles, children = self.cursor.unpack("II")
        for _ in range(tiles):
            origin, value = self.corner(), self.one()
            active = np.full((1, 1, 1), self.cursor.unpack("?")[0])
            self.spend(400)
            values = value.reshape(1, 1, 1, *self.shape)
            tree.nodes.append(Node(origin, UPPER, values, active, np.zeros((1, 1, 1), bool)))
        origins: list[np.ndarray] = []
        masks: list[np.ndarray] = []
        for _ in range(children):
            upper = self.node(self.corner(), UPPER // LOWER, LOWER)
            tree.nodes.append(upper)
            for entry in np.argwhere(upper.child):
                lower = self.node(upper.origin + entry * LOWER, LOWER // LEAF, LEAF)
                tree.nodes.append(lower)
                entries = np.argwhere(lower.child)
                origins.append(lower.origin + entries * LEAF)
                masks.append(np.frombuffer(self.cursor.take(len(entries) * _MASK), np.uint8).reshape(-1, _MASK))
                self.spend(len(entries) * 100)
        if origins:
            tree.origins, tree.masks = np.concatenate(origins), np.concatenate(masks)
        tree.leaves = self.leaves(tree.masks)
        return tree

    def spend(self, n: int) -> None:
        """Count ``n`` bytes of memory, so that many small things do not add up to more than there is."""
        if self.room is not None:
            self.room -= n
            if self.room < 0:
                raise DataError(f"{self.cursor.name}: the tree's nodes alone do not fit the free memory")

    def corner(self) -> np.ndarray:
        """Read the origin of a child or tile of the root."""
        origin = np.array(self.cursor.unpack("3i"), np.int64)
        if (origin % UPPER).any():
            raise self.cursor.bad(f"a node at {origin.tolist()}, which is no multiple of {UPPER}")
        return origin

    def one(self) -> np.ndarray:
        """Read one value, (c,)."""
        return self.numbers(self.cursor.take(self.dtype.itemsize * max(sum(self.shape), 1)), self.dtype)

    def numbers(self, data: bytes | memoryview, dtype: np.dtype) -> np.ndarray:
        """Convert bytes to values in native order and full precision."""
        if dtype.kind == "b":
            return np.asarray(np.frombuffer(data, np.uint8) != 0)
        return np.frombuffer(data, dtype).astype(self.dtype.newbyteorder("="))

    def bits(self, n: int) -> np.ndarray:
        """Read a mask of ``n`` bits, (n,) bool."""
        return np.unpackbits(np.frombuffer(self.cursor.take(n // 8), np.uint8), bitorder="little").view(bool)

    def node(self, origin: np.ndarray, width: int, step: int) -> Node:
        """Read masks and tiles of an inner node of ``width`` entries along its edge."""
        n = width**3
        cube = (width, width, width)
        child, active = self.bits(n), self.bits(n)
        values = self.values(n, active, int(active.sum()))
        self.spend(values.nbytes + 2 * n)
        return Node(
            origin, step, values.reshape(*cube, *self.shape), (active & ~child).reshape(cube), child.reshape(cube)
        )

    def values(self, n: int, active: np.ndarray, count: int) -> np.ndarray:
        """Read ``n`` values of a node, (n, ...); the file may lack those that are not ``active``.

        ``count`` is how many are. The byte before the values says how to restore the others: openvdb/io/Compression.h.
        """
        (code,) = self.cursor.unpack("B")
        if code > 6:
            raise self.cursor.bad(f"a node with code {code} of its inactive values; expected 0 to 6")
        off = self.background if code == 0 else self.minus
        second, choice = self.background, None
        if code in (2, 4, 5):
            off = self.one()
        if code == 5:
            second = self.one()
        if code in (3, 4, 5):
            choice = self.bits(n).reshape(n, *(1 for _ in self.shape))
        kept = count if self.compression & ACTIVE_MASK and code != 6 else n
        need = kept * self.stored.itemsize * max(sum(self.shape), 1)
        halved = self.stored != self.dtype
        data = b"" if halved and not kept else read_block(self.cursor, need, self.compression)
        stored = self.numbers(data, self.stored).reshape(kept, *self.shape)
        if kept == n:
            return stored
        out = np.empty((n, *self.shape), stored.dtype)
        out[:] = off if choice is None else np.where(choice, second, off)
        out[active] = stored
        return out

    def leaves(self, masks: np.ndarray) -> np.ndarray:
        """Read the values of all leaves, (n, 8, 8, 8, ...)."""
        n = len(masks)
        cube = (n, LEAF, LEAF, LEAF)
        if self.kind in ("bool", "mask"):  # mask again, origin, and for bool the values as bits
            check_memory(n * LEAF**3, self.cursor.name)
            size = _MASK + 12 + (_MASK if self.kind == "bool" else 0)
            rows = np.frombuffer(self.cursor.take(n * size), np.uint8).reshape(n, size)
            bits = masks if self.kind == "mask" else rows[:, -_MASK:]
            return np.unpackbits(bits, axis=1, bitorder="little").view(bool).reshape(cube)
        need = n * LEAF**3 * self.dtype.itemsize * max(sum(self.shape), 1)
        if n * (_MASK + 1) > len(self.cursor.data) - self.cursor.at:
            raise self.cursor.bad(f"{n} leaves are declared, {len(self.cursor.data) - self.cursor.at} bytes are left")
        check_memory(need, self.cursor.name)
        out = np.empty((n, LEAF**3, *self.shape), self.dtype.newbyteorder("="))
        for first in range(0, n, _CHUNK):
            active = np.unpackbits(masks[first : first + _CHUNK], axis=1, bitorder="little").view(bool)
            for k, count in enumerate(active.sum(axis=1).tolist()):
                self.cursor.take(_MASK)
                out[first + k] = self.values(LEAF**3, active[k], count)
        return out.reshape(*cube, *self.shape)
