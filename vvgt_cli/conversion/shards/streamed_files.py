"""The files of a streamed SOG: Gaussians of neighbouring nodes in one level, as SOG images in a folder."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vvgt_cli.conversion.shards.regions import Made
from vvgt_cli.errors import DataError
from vvgt_cli.field.digests import digest
from vvgt_cli.files import atomic_write
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.formats.sog_images import IMAGES, META, images_of, webp
from vvgt_cli.gaussians.formats.splats import Splats, joined, morton_order, splats_of
from vvgt_cli.gaussians.formats.streamed import read_manifest
from vvgt_cli.gaussians.frames import transform

A_FILE = 1 << 17  # Gaussians in a file, except for those of its last node
REACH = 2.0  # standard deviations from the centres to the bounds of a node


class Part(NamedTuple):
    """The content of a file: a level of the nodes from ``begin`` to ``end``, and the file's number in that level."""

    level: int
    number: int
    begin: int
    end: int


def divide(counts: np.ndarray) -> tuple[tuple[Part, ...], list[list[dict[str, int]]]]:
    """Divide the levels of nodes among files.

    Args:
        counts: (nodes, levels) numbers of Gaussians.

    Returns:
        The files, in the order in which their first nodes come; and for each node, by level, its file, offset and
        count.
    """
    parts: list[Part] = []
    for level in range(counts.shape[1]):
        begin, rows, number = 0, 0, 0
        for node, count in enumerate(counts[:, level].tolist(), 1):
            rows += count
            if rows >= A_FILE or node == len(counts):
                parts.append(Part(level, number, begin, node))
                begin, rows, number = node, 0, number + 1
    parts.sort(key=lambda part: (part.begin, part.level))
    places: list[list[dict[str, int]]] = [[{} for _ in range(counts.shape[1])] for _ in range(len(counts))]
    for file, part in enumerate(parts):
        offset = 0
        for node in range(part.begin, part.end):
            count = int(counts[node, part.level])
            places[node][part.level] = {"file": file, "offset": offset, "count": count}
            offset += count
    return tuple(parts), places


@dataclass(frozen=True)
class WrittenFiles:
    """The task of writing each file of all levels.

    The store records its bytes and time, by which a later run recognises it, and the bounds of its nodes.

    Attributes:
        made: Gaussians of all nodes, box frame.
        parts: content of the files.
        folder: folder of the manifest.
        axes: (3, 3) turn into the frame of the file.
        scale: scale from the unit frame.
        options: layout of the Gaussians.
    """

    made: Made
    parts: tuple[Part, ...]
    folder: Path
    axes: np.ndarray
    scale: float
    options: PlyOptions

    @property
    def kind(self) -> str:
        """Kind of the results."""
        return f"written-{digest(self.made.kind, str(self.folder))[:16]}"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the files' `meta.json` in the manifest."""
        return tuple(f"{part.level}_{part.number}/{META}" for part in self.parts)

    def __len__(self) -> int:
        """Return the number of files."""
        return len(self.parts)

    def __call__(self, number: int) -> None:
        """Write file ``number``."""
        part, target = self.parts[number], self.folder / self.names[number]
        lows, highs, waiting = [], [], []
        for gaussians in self.made.level(part.level, part.begin, part.end):
            splats = self._splats(gaussians)
            reach = REACH * np.exp(splats.log_scales.max(axis=1, keepdims=True))
            lows.append((splats.means - reach).min(axis=0))
            highs.append((splats.means + reach).max(axis=0))
            waiting.append(splats.take(morton_order(splats.means)))
        size = _written(target, joined(waiting))
        written = np.array([size, target.stat().st_mtime_ns])
        self.made.store.save(self.kind, number, size=written, lows=np.array(lows), highs=np.array(highs))

    def _splats(self, gaussians: Gaussians) -> Splats:
        splats = splats_of(transform(gaussians, self.axes), self.options)
        larger = splats.log_scales + np.float32(math.log(self.scale))
        return replace(splats, means=splats.means * np.float32(self.scale), log_scales=larger)

    def forget_changed(self) -> None:
        """Forget files that are missing, or were changed since this run wrote them."""
        store = self.made.store
        done = [number for number in range(len(self)) if not store.missing(self.kind, [number])]
        for number in done:
            target = self.folder / self.names[number]
            written = int(store.load(self.kind, number, names=("size",))["size"][1])
            if not target.is_file() or target.stat().st_mtime_ns != written:
                store.path(self.kind, number).unlink()

    def size(self, number: int) -> int:
        """Return the bytes of a written file."""
        return int(self.made.store.load(self.kind, number, names=("size",))["size"][0])

    def bounds(self, nodes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest corners (nodes, 3) of all nodes, over their levels."""
        low, high = np.full((nodes, 3), np.inf), np.full((nodes, 3), -np.inf)
        for number, part in enumerate(self.parts):
            found, own = self.made.store.load(self.kind, number), slice(part.begin, part.end)
            low[own] = np.minimum(low[own], found["lows"])
            high[own] = np.maximum(high[own], found["highs"])
        return low, high


def remove_others(folder: Path, before: Sequence[str], names: Sequence[str]) -> None:
    """Remove the files of an earlier manifest, ``before``, that this one does not name."""
    for name in set(before) - set(names):
        path = folder / name
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
