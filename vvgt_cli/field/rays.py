"""Rays through a volume in blocks.

Rays are cut at the faces of pieces, which depend only on the volume. The colours that a ray sees in each piece are
composited front to back, so the result is the same to the byte whatever the blocks.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vvgt_cli.dvr.layout import Light
from vvgt_cli.errors import DataError
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.field.digests import digest
from vvgt_cli.field.grid import Boxes, piece_edge
from vvgt_cli.field.reader import VoxelBox
from vvgt_cli.files import write_arrays
from vvgt_cli.volume.stored import give_back

SUFFIX = ".rays.npy"
RAY = np.dtype([("ray", np.int32), ("rgba", np.float32, 4)])  # number of a ray in its bundle, and its colour in a piece
LONGEST = 1.0  # step in voxels, so that the last one ends within a voxel of its piece
HALO = 2  # voxels around a block that are read with it: the sample before its first, and for normals


class Bundle(NamedTuple):
    """Rays of one picture, as kernels take them.

    Attributes:
        eye, basis, lens: `camera_arrays` of the camera.
        step: distance between samples in voxels, at most `LONGEST`.
        pixels: (n, 2) int64 columns and rows.
        offsets: (m, 2) offsets of each pixel's rays from its centre.
    """

    eye: np.ndarray
    basis: np.ndarray
    lens: np.ndarray
    step: float
    pixels: np.ndarray
    offsets: np.ndarray


@dataclass(frozen=True)
class RayFile:
    """Bundles in a file in the block store, where every worker finds them.

    Attributes:
        path: path of the file.
        kind: kind of the results, which is the same for the same rays.
    """

    path: str
    kind: str

    @classmethod
    def of(cls, bundles: Sequence[Bundle], blocks: Boxes, store: BlockStore) -> RayFile:
        """Write bundles of rays through a volume that is divided into ``blocks``, or raise DataError."""
        arrays: dict[str, np.ndarray] = {}
        for k, bundle in enumerate(bundles):
            arrays[f"camera{k}"] = np.concatenate([bundle.eye, bundle.basis.ravel(), bundle.lens, [bundle.step]])
            arrays[f"pixels{k}"] = bundle.pixels.astype(np.int32)
            arrays[f"offsets{k}"] = bundle.offsets
        name = f"rays-{digest(blocks, *arrays.values())[:16]}"
        path = store.folder / f"{name}.npz"
        if not path.is_file():
            write_arrays(path, arrays)
        return cls(str(path), name)

    def bundles(self) -> list[Bundle]:
        """Return the bundles, read once per process; raise DataError if they are damaged or missing."""
        return _read(self.path)


@lru_cache(maxsize=2)
def _read(path: str) -> list[Bundle]:
    try:
        with np.load(path) as arrays:
            out = []
            for k in range(len(arrays.files) // 3):
                numbers = arrays[f"camera{k}"]
                pixels = np.ascontiguousarray(arrays[f"pixels{k}"], np.int64)
                basis = np.ascontiguousarray(numbers[3:12].reshape(3, 3))
                out.append(
                    Bundle(numbers[:3], basis, numbers[12:16], float(numbers[16]), pixels, arrays[f"offsets{k}"])
                )
            return out
    except Exception as error:  # zipfile and numpy raise many types
        raise DataError(f"{path}: cannot be read ({error}); run the same command again") from error


def pieces_of(dims: tuple[int, int, int]) -> Boxes:
    """Return a volume's division into pieces."""
    edge = piece_edge(dims)
    return Boxes(dims, (edge, edge, edge))


def save_rays(
    rays: RayFile, block: VoxelBox, number: int, blocks: Boxes, light: Light | None, store: BlockStore
) -> None:
    """Cast all rays through the pieces of block ``number`` of ``blocks``, and save what they see.

    ``block`` has `HALO` voxels around it.
    """
    pieces, kind = pieces_of(blocks.dims), rays.kind
    lo, hi = blocks.at(number)
    table: list[tuple[int, int, int]] = []  # piece, bundle, rays
    results: list[np.ndarray] = []
    for piece in _within(pieces, lo, hi):
        first, last = pieces.at(piece)
        for k, seen in _piece_rays(rays, block.part(first - HALO, last + HALO), first, last, blocks.dims, light):
            table.append((piece, k, len(seen)))
            results.append(seen)
    write_arrays(store.path(kind, number, SUFFIX), np.concatenate(results) if results else np.empty(0, RAY))
    store.save(kind, number, table=np.array(table, np.int64).reshape(-1, 3))


def _within(boxes: Boxes, lo: np.ndarray, hi: np.ndarray) -> list[int]:
    """Return the numbers of the boxes from voxel ``lo`` to ``hi`` (3,), which lie on faces of boxes."""
    (i, j, k), (x, y, z) = lo // boxes.edge, -(-hi // np.array(boxes.edge))
    numbers: list[int] = np.arange(len(boxes)).reshape(boxes.shape[::-1])[k:z, j:y, i:x].ravel().tolist()
    return numbers


def _piece_rays(
    rays: RayFile, box: VoxelBox, lo: np.ndarray, hi: np.ndarray, dims: tuple[int, int, int], light: Light | None
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield, for the piece from voxel ``lo`` to ``hi`` (3,), bundle numbers and the rays that see anything."""
    empty = box.empty()
    if empty.all():
        return
    cast = caster(box, empty, lo, hi, dims, light)
    for k, bundle in enumerate(rays.bundles()):
        near = meeting(bundle, lo - 0.5, hi - 0.5)
        if not len(near):
            continue
        seen = cast(bundle, near)
        shown = np.flatnonzero(seen[..., 3])
        if len(shown):
            each, out = len(bundle.offsets), np.empty(len(shown), RAY)
            out["ray"] = near[shown // each] * each + shown % each
            out["rgba"] = seen.reshape(-1, 4)[shown]
            yield k, out


def caster(
    box: VoxelBox, empty: np.ndarray, lo: np.ndarray, hi: np.ndarray, dims: tuple[int, int, int], light: Light | None
) -> Callable[[Bundle, np.ndarray], np.ndarray]:
    """Return the function that casts rays through the voxels ``lo`` to ``hi`` (3,) of a volume, and those alone.

    Args:
        box: these voxels and those around them.
        empty: `empty_bricks` of the box.
        lo: first voxel.
        hi: end of the range.
        dims: voxels of the volume, (x, y, z).
        light: lighting of the volume, None for none.

    Returns:
        A function of a bundle and of the indices (n,) of its pixels, which returns what they show, (n, m, 4) float32.
    """
    from functools import partial

    from vvgt_cli.dvr import march

    faces = np.stack([
        np.where(lo == 0, -np.inf, lo - 0.5), np.where(hi == dims, np.inf, hi - 0.5), np.array(dims, np.float64)
    ])  # fmt: skip
    begin = box.begin.astype(np.float64)
    if box.mixture is None:
        kernel = march.cast_segments if light is None else march.cast_lit_segments
    elif box.mixed:
        kernel = march.cast_mixed_segments if light is None else march.cast_lit_mixed_segments
    else:
        kernel = march.cast_grid_segments if light is None else march.cast_lit_grid_segments
    lit = None if light is None else light._replace(origin=begin)
    voxels = box.voxels if box.mixture is None else box.relieved
    bound = partial(kernel, voxels, box.optics, box.mixture, empty, lit, faces, begin)

    def cast(bundle: Bundle, which: np.ndarray) -> np.ndarray:
        seen = np.zeros((len(which), len(bundle.offsets), 4), np.float32)
        pixels = bundle.pixels if len(which) == len(bundle.pixels) else bundle.pixels[which]
        bound(*bundle[:4], pixels, bundle.offsets, seen)
        return seen

    return cast


def meeting(cast: Bundle, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Return the indices (n,) int64, ascending, of pixels whose rays may meet the box ``lo`` to ``hi`` (3,), voxels.

    These are the pixels in the bounding rectangle of the projected corners, or all if a corner is behind the eye.
    """
    corners = np.array(list(itertools.product(*zip(lo, hi, strict=True))), np.float64) - cast.eye
    across, down, ahead = np.linalg.solve(cast.basis.T, corners.T)
    if ahead.min() <= 1e-6 * np.abs(ahead).max():
        return np.arange(len(cast.pixels))
    edge, lens = 1.0, cast.lens  # margin for a pixel's own width and for rounding
    x, y = across / ahead / lens[0] + lens[2] - 0.5, down / ahead / lens[1] + lens[3] - 0.5
    column, row = cast.pixels.T
    inside = (column >= x.min() - edge) & (column <= x.max() + edge) & (row >= y.min() - edge) & (row <= y.max() + edge)
    return np.flatnonzero(inside)


def composed(
    rays: RayFile, store: BlockStore, numbers: Sequence[int], dims: tuple[int, int, int]
) -> Generator[np.ndarray]:
    """Yield the colours of whole rays, (n, m, 4) float64 premultiplied, per bundle, from results of blocks ``numbers``.

    Raises:
        DataError: a result is missing or damaged.
    """
    pieces, bundles, kind = pieces_of(dims), rays.bundles(), rays.kind
    shown: list[dict[int, tuple[int, slice]]] = [{} for _ in bundles]
    mapped: dict[int, np.ndarray] = {}
    for number in numbers:
        offset = 0
        for piece, k, count in store.load(kind, number)["table"].tolist():
            shown[k][piece] = number, slice(offset, offset + count)
            offset += count
        if offset:
            with store.reading(kind, number, SUFFIX) as path:
                mapped[number] = np.load(path, mmap_mode="r")
                if mapped[number].dtype != RAY or len(mapped[number]) != offset:
                    raise ValueError(f"{len(mapped[number])} rays for {offset}")
    for bundle, parts in zip(bundles, shown, strict=True):
        each = len(bundle.offsets)
        color, through = np.zeros((len(bundle.pixels) * each, 3)), np.ones(len(bundle.pixels) * each)
        for piece in front_to_back(pieces, bundle.eye, list(parts)):
            number, part = parts[piece]
            ray, rgba = mapped[number]["ray"][part], mapped[number]["rgba"][part]
            color[ray] += through[ray, None] * rgba[:, :3]
            through[ray] *= 1.0 - rgba[:, 3]
        for number in {number for number, _ in parts.values()}:
            give_back(mapped[number])
        yield np.concatenate([color, 1 - through[:, None]], axis=1).reshape(-1, each, 4)


def front_to_back(pieces: Boxes, eye: np.ndarray, numbers: Sequence[int]) -> list[int]:
    """Sort the ``numbers`` of pieces front to back for all rays from ``eye`` (3,), voxels.

    Along a ray, each index changes in one direction only, away from the eye's.
    """
    edge = np.array(pieces.edge)
    own = np.floor((eye + 0.5) / edge)
    which = np.array(sorted(numbers), np.int64)
    order = np.argsort(np.abs(pieces.index(which) - own).sum(axis=1), kind="stable")
    return [int(number) for number in which[order]]
