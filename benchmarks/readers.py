"""What the readers of docs/formats.md do with files that other programs wrote: place, blocks, series, processor time.

``python benchmarks/readers.py [--edge 256] [--format NAME]... [-o FILE.csv]``

Every row of `ROWS` names the library that writes a file of edge^3 int16 (smooth, with noise) on a grid of steps
(0.5, 0.7, 1.1) from (12, -34, 56), and what reads it without vvgt. Both run in a process of their own, libraries
imported beforehand, with the file in the page cache; the median of three. `place` is the largest distance of a corner
voxel (of the box, where a mesh is resampled) from where it was written; `whole`: every voxel as it was written. Prints
a table in Markdown.
"""

from __future__ import annotations

import argparse
import csv
import os
import statistics
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.volume import ReadOptions, Volume, read_volume
from vvgt_cli.volume.readers import READERS
from vvgt_cli.volume.stored import is_file_backed, planes, read_block

SPACING, ORIGIN = (0.5, 0.7, 1.1), (12.0, -34.0, 56.0)
LPS = (-1.0, -1.0, 1.0)  # what is written along left and posterior is given along right and anterior
TIMES = 3


@dataclass(frozen=True)
class Row:
    """A format.

    Attributes:
        name, by: of the format, and what wrote the file.
        reader: its name in `READERS`.
        write: folder and values (z, y, x) to the path that is opened.
        alone: the path to all values, by the library that wrote it or by another; None where there is none.
        signs, origin: where voxels are expected: each axis of the grid's as written or reversed, its first voxel.
        spacing: of its voxels.
        options: of `ReadOptions`.
        placed: it says where voxels are.
        cells: values are those of cells; else of points, between which a resampled grid lies.
        steps: its reader's time steps are of this format, too.
        most: voxels along an edge, at most (text and meshes).
    """

    name: str
    by: str
    reader: str
    write: Callable[[Path, np.ndarray], Path]
    alone: Callable[[Path], Any] | None
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)
    origin: tuple[float, float, float] = ORIGIN
    spacing: tuple[float, float, float] = SPACING
    options: dict[str, Any] = field(default_factory=dict)
    placed: bool = True
    cells: bool = False
    steps: bool = True
    most: int = 1 << 12


def values_of(edge: int) -> np.ndarray:
    """(z, y, x) int16: a ball of 0 to 1000 with noise of three bits."""
    line = np.linspace(-1, 1, edge)
    ball = np.exp(-3 * (line[:, None, None] ** 2 + line[:, None] ** 2 + line**2)) * 1000
    return (ball + np.random.default_rng(1).integers(0, 8, ball.shape)).astype(np.int16)


def world() -> np.ndarray:
    """(4, 4): index (i, j, k, 1) to the place of a voxel."""
    affine = np.diag([*SPACING, 1.0])
    affine[:3, 3] = ORIGIN
    return affine


def expected(row: Row) -> np.ndarray:
    """(4, 4) of where the row's voxels are."""
    affine = np.diag([*row.spacing, 1.0])
    affine[:3, 3] = row.origin
    return np.diag([*row.signs, 1.0]) @ affine


def order_of(volume: Volume) -> list[int]:
    """Axis of the world, 0 to 2, along which each index axis lies: a file of z fastest is given as it is stored."""
    return [int(axis) for axis in np.abs(volume.axes).argmax(axis=0)]


def corners(low: float, dims: Sequence[int]) -> np.ndarray:
    """(4, 8) homogeneous indices of the corners of a grid, from ``low`` on, and as far inside the last voxels."""
    ends = np.array(np.meshgrid(*[(low, n - 1 - low) for n in dims])).reshape(3, -1)
    return np.vstack([ends, np.ones(8)])


def off(volume: Volume, row: Row, edge: int) -> float:
    """Largest distance of a corner voxel, of a resampled volume of a corner of its box, from where it was written."""
    if "resampled" in volume.name:  # its box is that of the cells
        given = corners(-0.5, volume.dims)
        written = corners(-0.5 if row.cells else 0.0, (edge,) * 3)
        return float(np.linalg.norm(volume.affine @ given - expected(row) @ written, axis=0).max())
    moved = volume.affine - expected(row)[:, [*order_of(volume), 3]]
    return float(np.linalg.norm(moved @ corners(0.0, volume.dims), axis=0).max())


def read_all(path: Path, row: Row) -> Volume:
    """Read it, and every value of it."""
    volume = read_volume(str(path), ReadOptions(**row.options))
    sum(int(plane[0, 0] != 0) for plane in planes(volume))
    return volume


def seconds(call: Callable[[], object]) -> float:
    """Processor time of a call in a fork, with the processes that it starts; the median of `TIMES`."""
    found = []
    for _ in range(TIMES):
        child = os.fork()
        if not child:
            status = 1
            try:
                warnings.simplefilter("ignore")
                call()
                status = 0
            finally:
                os._exit(status)
        _, status, used = os.wait4(child, 0)
        if status:
            raise RuntimeError(f"a reader ended with status {status}")
        found.append(used.ru_utime + used.ru_stime)
    return statistics.median(found)


def measured(row: Row, edge: int) -> dict[str, Any]:
    """The figures of a row."""
    edge = min(edge, row.most)
    values = values_of(edge)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = row.write(Path(folder), values)
        volume = read_all(path, row)  # whatever it imports is there now
        values = values.transpose([2 - axis for axis in order_of(volume)[::-1]])
        whole = volume.data.shape == values.shape and bool(
            (volume.data[:] * volume.slope + volume.intercept == values).all()
        )
        stored = read_volume(str(path), ReadOptions(stored=True, **row.options))
        blocks = is_file_backed(stored)
        if blocks and whole:
            lo, hi = np.array([1, 2, 3]), np.array([edge // 2, edge // 2 + 1, edge // 2 + 2])
            part = read_block(stored, lo, hi) * stored.slope + stored.intercept
            whole = bool((part == values[3 : hi[2], 2 : hi[1], 1 : hi[0]]).all())
        alone = row.alone
        if alone is not None:
            alone(path)
        takes = next(r for r in READERS if r.name == row.reader).takes
        return {
            "format": row.name,
            "written by": row.by,
            "edge": edge,
            "whole": "yes" if whole else "resampled" if "resampled" in volume.name else "no",
            "blocks": "yes" if blocks else "no",
            "series": "yes" if row.steps and "time" in takes else "files",
            "place": f"{off(volume, row, edge):.4f}" if row.placed else "",
            "seconds": f"{seconds(lambda: read_all(path, row)):.2f}",
            "library": "" if alone is None else f"{seconds(lambda: alone(path)):.2f}",
        }


def table(rows: list[dict[str, Any]]) -> str:
    """In Markdown."""
    keys = list(rows[0])
    lines = [keys, ["---"] * len(keys), *([str(row[key]) for key in keys] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main(arguments: list[str] | None = None) -> None:
    """See the module."""
    from readers_rows import ROWS

    parser = argparse.ArgumentParser()
    parser.add_argument("--edge", type=int, default=256, help="voxels along each axis")
    parser.add_argument("--format", action="append", help="by name; all without")
    parser.add_argument("-o", type=Path, help="CSV")
    options = parser.parse_args(arguments)
    rows = []
    for row in ROWS:
        if not options.format or row.name in options.format:
            rows.append(measured(row, options.edge))
            print(rows[-1], flush=True)
    print(table(rows))
    if options.o:
        with open(options.o, "w", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
