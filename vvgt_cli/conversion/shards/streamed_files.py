"""The files of a streamed SOG: Gaussians of neighbouring nodes in one level, as SOG images in a folder."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.files import atomic_write
from vvgt_cli.gaussians.formats.sog_images import IMAGES, META, images_of, webp
from vvgt_cli.gaussians.formats.splats import Splats, joined, morton_order
from vvgt_cli.gaussians.formats.streamed import read_manifest

A_FILE = 1 << 17  # Gaussians in a file, except for those of its last node


@dataclass
class Level:
    """The state of writing a level.

    Attributes:
        number: number of the level, 0 the finest.
        waiting: Gaussians for the next file.
        rows: number of waiting Gaussians.
        files: number of files written.
        gaussians, bytes: totals so far.
        spread: sums over Gaussians of opacity x area of their cells, and of that x variance within.
    """

    number: int
    waiting: list[Splats] = field(default_factory=list)
    rows: int = 0
    files: int = 0
    gaussians: int = 0
    bytes: int = 0
    spread: np.ndarray = field(default_factory=lambda: np.zeros(2))


class Files:
    """The files of all levels; ``names`` are those of their `meta.json` in the manifest.

    ``store`` records, under ``kind``, the bytes and time of each complete file, which is then not written again unless
    another run has changed it.
    """

    def __init__(self, folder: Path, store: BlockStore, kind: str) -> None:
        """Start without files."""
        self._folder, self._store, self._kind = folder, store, kind
        store.prepare(kind)
        self.names: list[str] = []
        self._begun: dict[int, int] = {}  # number of the name of each level's next file

    def add(self, level: Level, splats: Splats) -> dict[str, int]:
        """Add the Gaussians of a node to the next file of a level, and return their place."""
        if level.number not in self._begun:
            self._begun[level.number] = len(self.names)
            self.names.append(f"{level.number}_{level.files}/{META}")
        place = {"file": self._begun[level.number], "offset": level.rows, "count": len(splats)}
        level.waiting.append(splats.take(morton_order(splats.means)))
        level.rows += len(splats)
        level.gaussians += len(splats)
        if level.rows >= A_FILE:
            self.write(level)
        return place

    def write(self, level: Level) -> None:
        """Write the waiting Gaussians, if any."""
        if not level.rows:
            return
        number = self._begun.pop(level.number)
        target = self._folder / self.names[number]
        level.bytes += self._kept(number, target) or self._made(number, target, joined(level.waiting))
        level.waiting, level.rows, level.files = [], 0, level.files + 1

    def _kept(self, number: int, target: Path) -> int:
        """Return the bytes of a file that this run wrote before an interruption, else 0."""
        if not target.is_file() or self._store.missing(self._kind, [number]):
            return 0
        size, written = self._store.load(self._kind, number)["size"].tolist()
        return int(size) if written == target.stat().st_mtime_ns else 0

    def _made(self, number: int, target: Path, splats: Splats) -> int:
        size = _written(target, splats)
        self._store.save(self._kind, number, size=np.array([size, target.stat().st_mtime_ns]))
        return size

    def remove_others(self, before: Sequence[str]) -> None:
        """Remove the files of an earlier manifest, ``before``, that this one does not name."""
        for name in set(before) - set(self.names):
            path = self._folder / name
            for file in (path, *(path.with_name(f"{image}.webp") for image in IMAGES)):
                file.unlink(missing_ok=True)
            with suppress(OSError):  # it holds other files
                path.parent.rmdir()


def files_of(manifest: Path) -> list[str]:
    """List the files of a manifest; none where it is missing or damaged."""
    try:
        return list(read_manifest(manifest)["filenames"])
    except (DataError, OSError):
        return []


def _written(target: Path, splats: Splats) -> int:
    """Write the images and then `meta.json`, and return their bytes."""
    images, meta = images_of(splats)
    target.parent.mkdir(exist_ok=True)
    size = sum(_put(target.with_name(name), webp(image)) for name, image in images.items())
    return size + _put(target, json.dumps(meta, separators=(",", ":")).encode())


def _put(path: Path, content: bytes) -> int:
    with atomic_write(path, overwrite=True) as temporary:
        temporary.write_bytes(content)
    return len(content)
