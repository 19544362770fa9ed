"""Rays through a volume of which only blocks are in memory.

A ray is cut at the faces of pieces, which follow from the volume alone. What a piece shows of a ray composes, front to
back, with what the others do to what a ray through the whole volume sees: the same bytes whatever the blocks.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.dvr.layout import Light
from vvgt_cli.dvr.render import Box as Frame
from vvgt_cli.dvr.render import camera_arrays
from vvgt_cli.errors import DataError
from vvgt_cli.field.digests import digest
from vvgt_cli.field.grid import Boxes, piece_edge
from vvgt_cli.field.parts import Parts
from vvgt_cli.field.reader import Box
from vvgt_cli.files import atomic_write
from vvgt_cli.volume.stored import give_back

SUFFIX = ".rays.npy"
RAY = np.dtype([("ray", np.int32), ("rgba", np.float32, 4)])  # one of a bundle, and what a piece shows of it
LONGEST = 1.0  # voxels of a segment, which ends within a voxel of its piece
HALO, LIT_HALO = 1, 2  # voxels around a block that are read with it


class Bundle(NamedTuple):
    """Rays of one picture.

    Attributes:
        camera: in the box frame.
        step: between samples, voxels.
        pixels: (n, 2) int64 columns and rows.
        offsets: (m, 2) places of each pixel's rays, from its centre.
    """

    camera: Camera
    step: float
    pixels: np.ndarray
    offsets: np.ndarray

    def __len__(self) -> int:
        return len(self.pixels) * len(self.offsets)


@dataclass(frozen=True)
class RayFile:
    """Bundles in a file beside the parts, where every worker finds them.

    Attributes:
        path: of the file.
        kind: of the parts that they leave: the same rays have the same.
    """

    path: str
    kind: str

    @classmethod
    def of(cls, bundles: Sequence[Bundle], frame: Frame, blocks: Boxes, parts: Parts) -> RayFile:
        """Write them; ``frame`` is the volume's, which is cut into ``blocks``.

        Raises:
            DataError: the system refuses.
        """
        arrays: dict[str, np.ndarray] = {}
        for k, bundle in enumerate(bundles):
            eye, basis, lens = camera_arrays(frame, bundle.camera)
            step = min(bundle.step, LONGEST)
            arrays[f"camera{k}"] = np.concatenate([eye, basis.ravel(), lens, [step]])
            arrays[f"pixels{k}"] = bundle.pixels.astype(np.int32)
            arrays[f"offsets{k}"] = bundle.offsets
        name = f"rays-{digest(blocks, *arrays.values())[:16]}"
        path = parts.folder / f"{name}.npz"
        if not path.is_file():
            with atomic_write(path, overwrite=True) as temporary, open(temporary, "wb") as stream:
                np.savez(stream, allow_pickle=False, **arrays)
        return cls(str(path), name)

    def bundles(self) -> list[Cast]:
        """As kernels take them, read once a process.

        Raises:
            DataError: the file is damaged, or gone.
        """
        return _read(self.path)


class Cast(NamedTuple):
    """A `Bundle` as kernels take it."""

    eye: np.ndarray
    basis: np.ndarray
    lens: np.ndarray
    step: float
    pixels: np.ndarray
    offsets: np.ndarray


@lru_cache(maxsize=2)
def _read(path: str) -> list[Cast]:
    try:
        with np.load(path) as found:
            out = []
            for k in range(len(found.files) // 3):
                numbers = found[f"camera{k}"]
                pixels = np.ascontiguousarray(found[f"pixels{k}"], np.int64)
                basis = np.ascontiguousarray(numbers[3:12].reshape(3, 3))
                out.append(Cast(numbers[:3], basis, numbers[12:16], float(numbers[16]), pixels, found[f"offsets{k}"]))
            return out
    except Exception as error:  # whatever zipfile and numpy raise
        raise DataError(f"{path}: cannot be read ({error}); run the same command again") from error


def pieces_of(dims: tuple[int, int, int]) -> Boxes:
    """A volume cut into pieces."""
    edge = piece_edge(dims)
    return Boxes(dims, (edge, edge, edge))


def leave_rays(rays: RayFile, block: Box, number: int, blocks: Boxes, light: Light | None, parts: Parts) -> None:
    """Cast all rays through the pieces of block ``number``, and leave what they show.

    Args:
        rays: of what pictures.
        block: with `HALO` voxels around it, or `LIT_HALO`.
        number, blocks: which it is; blocks are of whole pieces.
        light: that falls on the volume, None for none.
        parts: where it goes, as a part of the rays' own kind.
    """
    pieces, halo, kind = pieces_of(blocks.dims), HALO if light is None else LIT_HALO, rays.kind
    lo, hi = blocks.at(number)
    table: list[tuple[int, int, int]] = []  # piece, bundle, rays
    found: list[np.ndarray] = []
    for piece in _within(pieces, lo, hi):
        first, last = pieces.at(piece)
        for k, seen in _piece_rays(rays, block.part(first - halo, last + halo), first, last, blocks.dims, light):
            table.append((piece, k, len(seen)))
            found.append(seen)
    with atomic_write(parts.path(kind, number, SUFFIX), overwrite=True) as temporary, open(temporary, "wb") as stream:
        np.save(stream, np.concatenate(found) if found else np.empty(0, RAY))
    parts.save(kind, number, table=np.array(table, np.int64).reshape(-1, 3))


def _within(boxes: Boxes, lo: np.ndarray, hi: np.ndarray) -> Iterator[int]:
    """Numbers of the boxes from voxel ``lo`` to ``hi`` (3,), which are faces of some."""
    nx, ny, _ = boxes.shape
    a, b = lo // boxes.edge, -(-hi // np.array(boxes.edge))
    for k, j, i in itertools.product(*(range(int(p), int(q)) for p, q in zip(a[::-1], b[::-1], strict=True))):
        yield (k * ny + j) * nx + i


def _piece_rays(
    rays: RayFile, box: Box, lo: np.ndarray, hi: np.ndarray, dims: tuple[int, int, int], light: Light | None
) -> Iterator[tuple[int, np.ndarray]]:
    """Of the piece from voxel ``lo`` to ``hi`` (3,): number of a bundle, and those of its rays that show something."""
    from vvgt_cli.dvr.bricks import brick_ranges, empty_distance

    empty = empty_distance(brick_ranges(box.values), box.optics)
    if empty.all():
        return
    faces = np.stack([
        np.where(lo == 0, -np.inf, lo - 0.5), np.where(hi == dims, np.inf, hi - 0.5), np.array(dims, np.float64)
    ])  # fmt: skip
    begin = box.begin.astype(np.float64)
    cast = _caster(box, empty, None if light is None else light._replace(origin=begin))
    for k, bundle in enumerate(rays.bundles()):
        near = meeting(bundle, lo - 0.5, hi - 0.5)
        if not len(near):
            continue
        seen = np.zeros((len(near), len(bundle.offsets), 4), np.float32)
        pixels = bundle.pixels if len(near) == len(bundle.pixels) else bundle.pixels[near]
        cast(faces, begin, *bundle[:4], pixels, bundle.offsets, seen)
        shown = np.flatnonzero(seen[..., 3])
        if len(shown):
            each, out = len(bundle.offsets), np.empty(len(shown), RAY)
            out["ray"] = near[shown // each] * each + shown % each
            out["rgba"] = seen.reshape(-1, 4)[shown]
            yield k, out


def _caster(box: Box, empty: np.ndarray, light: Light | None) -> Callable[..., None]:
    """The kernel of a box's kind, with what it reads of it."""
    from functools import partial

    from vvgt_cli.dvr import march

    if box.texels is None:
        kernel = march.cast_segments if light is None else march.cast_lit_segments
    else:
        kernel = march.cast_grid_segments if light is None else march.cast_lit_grid_segments
    return partial(kernel, box.voxels, box.optics, box.texels, empty, light)


def meeting(cast: Cast, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Places (n,) int64, ascending, of the pixels of a bundle that may meet the box from ``lo`` to ``hi`` (3,), voxels.

    Those within the rectangle around the picture of the box's corners; all, where a corner is not in front of the eye.
    """
    corners = np.array(list(itertools.product(*zip(lo, hi, strict=True))), np.float64) - cast.eye
    across, down, ahead = np.linalg.solve(cast.basis.T, corners.T)
    if ahead.min() <= 1e-6 * np.abs(ahead).max():
        return np.arange(len(cast.pixels))
    edge, lens = 1.0, cast.lens  # a pixel's own width, and what rounding moves
    x, y = across / ahead / lens[0] + lens[2] - 0.5, down / ahead / lens[1] + lens[3] - 0.5
    column, row = cast.pixels.T
    inside = (column >= x.min() - edge) & (column <= x.max() + edge) & (row >= y.min() - edge) & (row <= y.max() + edge)
    result: np.ndarray = np.flatnonzero(inside)
    return result


def composed(rays: RayFile, parts: Parts, numbers: Sequence[int], dims: tuple[int, int, int]) -> Generator[np.ndarray]:
    """What whole rays see, (n, m, 4) float64 premultiplied, bundle by bundle, from what blocks ``numbers`` have left.

    Raises:
        DataError: a part is missing or damaged.
    """
    pieces, bundles, kind = pieces_of(dims), rays.bundles(), rays.kind
    shown: list[dict[int, tuple[int, slice]]] = [{} for _ in bundles]
    held: dict[int, np.ndarray] = {}
    for number in numbers:
        path = parts.path(kind, number, SUFFIX)
        offset = 0
        for piece, k, count in parts.load(kind, number)["table"].tolist():
            shown[k][piece] = number, slice(offset, offset + count)
            offset += count
        if offset:
            held[number] = _mapped(path, offset)
    for bundle, found in zip(bundles, shown, strict=True):
        each = len(bundle.offsets)
        color, through = np.zeros((len(bundle.pixels) * each, 3)), np.ones(len(bundle.pixels) * each)
        for piece in front_to_back(pieces, bundle.eye, list(found)):
            number, part = found[piece]
            ray, rgba = held[number]["ray"][part], held[number]["rgba"][part]
            color[ray] += through[ray, None] * rgba[:, :3]
            through[ray] *= 1.0 - rgba[:, 3]
        for number in {number for number, _ in found.values()}:
            give_back(held[number])
        yield np.concatenate([color, 1 - through[:, None]], axis=1).reshape(-1, each, 4)


def _mapped(path: os.PathLike[str], count: int) -> np.ndarray:
    """The rays of a part, left in their file."""
    try:
        found: np.ndarray = np.load(path, mmap_mode="r")
        if found.dtype == RAY and len(found) == count:
            return found
        error: object = f"{len(found)} rays for {count}"
    except (OSError, ValueError, EOFError) as problem:
        error = problem
    raise DataError(f"{path}: damaged ({error}); remove the block's files and run the same command again")


def front_to_back(pieces: Boxes, eye: np.ndarray, numbers: Sequence[int]) -> list[int]:
    """``numbers`` of pieces so that of two that a ray from ``eye`` (3,), voxels, meets, the nearer comes first.

    Along a ray every index goes one way only, away from the eye's.
    """
    edge = np.array(pieces.edge)
    own = np.floor((eye + 0.5) / edge)
    nx, ny, _ = pieces.shape
    which = np.array(sorted(numbers), np.int64)
    index = np.stack([which % nx, which // nx % ny, which // (nx * ny)], axis=-1).reshape(-1, 3)
    order = np.argsort(np.abs(index - own).sum(axis=1), kind="stable")
    return [int(number) for number in which[order]]
