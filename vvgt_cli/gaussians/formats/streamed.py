"""Streamed SOG: `lod-meta.json`, as PlayCanvas' engine reads it and vvgt adds to it, and the Gaussians of its levels.

`FOLDER` and `FOLDER/lod-meta.json` name the finest level, with `#LEVEL` appended another one; `#view` selects the level
of each node as PlayCanvas 2.23.3 does (`scene/gsplat-unified/gsplat-octree-instance.js`, `gsplat-budget-balancer.js`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import groupby, product
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians.formats.sog import IMAGES, META, splats_in
from vvgt_cli.gaussians.formats.splats import ROW_BYTES, Splats, gaussians_of, joined
from vvgt_cli.gaussians.header import CERTIFICATE
from vvgt_cli.resources import free_memory

MANIFEST = "lod-meta.json"
_LARGEST = 1 << 28  # bytes of a manifest
_MOST_LEVELS = 64


def is_streamed(path: str | Path | None) -> bool:
    """Return whether a file name is that of a manifest."""
    return path is not None and Path(path).name == MANIFEST


@contextmanager
def folder_of(output: str | Path | None) -> Iterator[None]:
    """Make the folder of a manifest, not of other files; if the block leaves it empty, remove it again."""
    folder = Path(output or "").absolute().parent
    created = is_streamed(output) and not folder.exists() and folder.parent.is_dir()
    if created:
        folder.mkdir(exist_ok=True)  # another shard may have made it meanwhile
    try:
        yield
    finally:
        if created:
            with suppress(OSError):
                folder.rmdir()


def level_files(path: str | Path) -> list[Path]:
    """List the files that a manifest names and that exist; none where it is missing, damaged or another file."""
    try:
        names = read_manifest(path)["filenames"] if is_streamed(path) else []
    except DataError:
        return []
    files = [Path(path).parent / name for name in names]
    files = [file for meta in files for file in (meta, *(meta.with_name(f"{image}.webp") for image in IMAGES))]
    return [file for file in files if file.is_file()]


def remove_files(files: Iterable[Path]) -> None:
    """Remove files, and folders that they leave empty."""
    for file in files:
        file.unlink(missing_ok=True)
        with suppress(OSError):  # it holds other files
            file.parent.rmdir()


def read_manifest(path: str | Path) -> dict[str, Any]:
    """Read a manifest with what the engine needs (levels, files, nodes in the tree), or raise DataError."""
    path = Path(path)
    try:
        if path.stat().st_size > _LARGEST:
            raise DataError(f"{path}: more than {_LARGEST >> 20} MiB; expected a manifest of streamed SOG")
        manifest = json.loads(path.read_bytes())
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); expected a manifest of streamed SOG") from None
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not JSON ({' '.join(str(error).split())[:200]}); expected streamed SOG") from None
    levels = manifest.get("lodLevels") if isinstance(manifest, dict) else None
    files = manifest.get("filenames") if isinstance(manifest, dict) else None
    if type(levels) is not int or not 0 < levels <= _MOST_LEVELS or not isinstance(files, list):
        raise DataError(f"{path}: no lodLevels from 1 to {_MOST_LEVELS} or no filenames; expected streamed SOG")
    for name in files:
        parts = name.split("/") if isinstance(name, str) else []
        if not parts or parts[-1] != META or any(part in ("", ".", "..") or "\\" in part for part in parts):
            raise DataError(f"{path}: names {name!r:.80}; expected files FOLDER/{META} next to it")
    for node in nodes_of(manifest, path):
        for level, place in node["lods"].items():
            numbers = [place.get(key) if isinstance(place, dict) else None for key in ("file", "offset", "count")]
            whole = [number for number in numbers if type(number) is int and number >= 0]
            if len(whole) < 3 or not level.isdecimal() or int(level) >= levels or whole[0] >= len(files):
                raise DataError(
                    f"{path}: a node has {place!r:.80} in level {level!r:.20}; expected file, offset and count of "
                    f"{levels} levels and {len(files)} files"
                )
    assert isinstance(manifest, dict)
    return manifest


def nodes_of(manifest: dict[str, Any], path: str | Path) -> list[dict[str, Any]]:
    """Return the nodes that have levels, in the order of the tree; raise DataError if it is not valid."""
    nodes, waiting = [], [manifest.get("tree")]
    while waiting:
        node = waiting.pop()
        if isinstance(node, dict) and isinstance(node.get("lods"), dict):
            nodes.append(node)
        elif isinstance(node, dict) and isinstance(node.get("children"), list):
            waiting += reversed(node["children"])
        else:
            raise DataError(f"{path}: its tree has {node!r:.80}; expected nodes with children or lods")
    return nodes


def facts_of(path: str | Path) -> dict[str, Any]:
    """Return the summary for `vvgt info`: Gaussians and nodes per level; bytes, errors, certificate of our own."""
    manifest = read_manifest(path)
    nodes, ours = nodes_of(manifest, path), manifest.get("vvgt")
    facts = ours.get("levels") if isinstance(ours, dict) else None
    levels = []
    for level in range(manifest["lodLevels"]):
        places = [node["lods"][str(level)] for node in nodes if str(level) in node["lods"]]
        row = {"level": level, "nodes": len(places), "gaussians": sum(place["count"] for place in places)}
        if isinstance(facts, list) and level < len(facts) and isinstance(facts[level], dict):
            row |= {key: facts[level].get(key) for key in ("files", "bytes", "rms", "spread")}
        levels.append(row)
    asset, (_, header) = manifest.get("asset"), gaussians_of(placed(manifest)[0], str(path))
    return {
        "written_by": asset.get("generator") if isinstance(asset, dict) else None,
        "files": len(manifest["filenames"]),
        "nodes": len(nodes),
        "levels": levels,
        **({} if header.certificate is None else {"certificate": header.certificate.facts()}),
    }


def placed(manifest: dict[str, Any]) -> tuple[Splats, float]:
    """Return placeholder Gaussians with the file's comments, for the page's initial camera, and the frame's scale."""
    ours = manifest.get("vvgt")
    ours = ours if isinstance(ours, dict) else {}
    scale, lines = ours.get("scale"), ours.get("comments")
    comments = tuple(str(line) for line in lines) if isinstance(lines, list) else ()
    tree = manifest["tree"].get("bound")
    corners = np.array([[-1.0] * 3, [1.0] * 3])
    if not comments and isinstance(tree, dict):
        with suppress(KeyError, TypeError, ValueError):
            corners = np.array([tree["min"], tree["max"]], np.float64).reshape(2, 3)
    empty = np.zeros((2, 3), np.float32)
    turned = np.tile(np.array([1, 0, 0, 0], np.float32), (2, 1))
    splats = Splats(corners.astype(np.float32), empty, turned, empty[:, 0], empty, np.zeros((2, 0, 3)), comments)
    return splats, float(scale) if comments and isinstance(scale, (int, float)) and 0 < scale < 1e6 else 1.0


def corners(manifest: dict[str, Any]) -> np.ndarray:
    """Return the corners (N, 3) of the nodes' boxes, in the coordinates of the files; none if a node has no box."""
    with suppress(KeyError, TypeError, ValueError):
        boxes = [[node["bound"]["min"], node["bound"]["max"]] for node in nodes_of(manifest, MANIFEST)]
        ends = np.array(boxes, np.float64).reshape(-1, 2, 3)
        places: np.ndarray = np.concatenate([ends[:, list(end), range(3)] for end in product((0, 1), repeat=3)])
        return places if np.isfinite(places).all() else places[:0]
    return np.empty((0, 3))


BASE, TIMES = 5.0, 3.0  # distance at which level 1 begins, and factor per level: `lodBaseDistance`, `lodMultiplier`
FIELD = 45.0  # field of view in degrees that these refer to; distances are scaled for others
VIEW = "view"


def split_name(name: str | Path) -> tuple[Path, str | None] | None:
    """Return the manifest that a name refers to, and the text after "#" or None; None for other names."""
    place, mark, chosen = str(name).rpartition("#")
    for path, after in ((str(name), None), (place, chosen)) if mark else ((str(name), None),):
        if Path(path).name == MANIFEST:
            return Path(path), after
        if path and (Path(path) / MANIFEST).is_file():
            return Path(path) / MANIFEST, after
    return None


def by_view(name: str | Path) -> Path | None:
    """Return the manifest if a name ends in `#view`, else None."""
    parts = split_name(name)
    return parts[0] if parts is not None and parts[1] == VIEW else None


@dataclass
class StreamedLevels:
    """The levels of a manifest.

    Attributes:
        path: path of the manifest.
        scale: factor of lengths relative to a `.ply` of the same Gaussians.
        count: number of levels.
        comments: comments of all levels together.
    """

    path: Path

    def __post_init__(self) -> None:
        """Read the manifest."""
        self._manifest = read_manifest(self.path)
        self._nodes = nodes_of(self._manifest, self.path)
        self.count = int(self._manifest["lodLevels"])
        about, self.scale = placed(self._manifest)
        self.comments = about.comments
        self._cached: dict[tuple[int, int, int], Splats] = {}  # by file, offset, count: those of the last view

    def level(self, chosen: str | None) -> Splats:
        """Read the Gaussians of a level, None for the finest; nodes without it use their next finer one.

        They have no certificate, which describes all levels together.

        Raises:
            UsageError: there is no such level.
            DataError: a file is missing or damaged, or the Gaussians do not fit in memory.
        """
        if chosen is not None and (not chosen.isdecimal() or int(chosen) >= self.count):
            raise UsageError(f"{self.path}#{chosen}: expected a level from 0 to {self.count - 1}, or #{VIEW} in render")
        one = self._at_levels([int(chosen or 0)] * len(self._nodes))
        return replace(one, comments=tuple(line for line in one.comments if line.split()[1:2] != [CERTIFICATE]))

    def seen_from(self, eye: np.ndarray, field: float) -> Splats:
        """Read the Gaussians that the engine shows from ``eye`` (3,), in the frame of a `.ply`, with ``field`` degrees.

        Raises:
            DataError: nodes have no bounds; see also `level`.
        """
        try:
            bounds = np.array([[node["bound"]["min"], node["bound"]["max"]] for node in self._nodes], np.float64)
            distances = np.linalg.norm(np.clip(eye * self.scale, bounds[:, 0], bounds[:, 1]) - eye * self.scale, axis=1)
        except (KeyError, TypeError, ValueError):
            raise DataError(f"{self.path}: nodes without bounds; expected bounds: choose a level, as #0") from None
        seen = distances * math.tan(math.radians(field / 2)) / math.tan(math.radians(FIELD / 2))
        levels = np.floor(1 + np.log(np.maximum(seen, 1e-9) / BASE) / math.log(TIMES))
        return self._at_levels(np.clip(levels, 0, self.count - 1).astype(int).tolist())

    def _at_levels(self, levels: Sequence[int]) -> Splats:
        """Read the Gaussians of each node at its own level."""
        places = []
        for node, level in zip(self._nodes, levels, strict=True):
            files = {int(key): place for key, place in node["lods"].items()}
            own = [key for key in files if key <= level]
            places += [files[max(own) if own else min(files)]] if files else []
        free, rows = free_memory(), sum(place["count"] for place in places)
        if free is not None and ROW_BYTES * rows > free:
            need = ROW_BYTES * rows / 2**30
            raise DataError(f"{self.path}: {rows:,} Gaussians take about {need:.1f} GiB; try a coarser level, as #1")
        if not places:
            raise DataError(f"{self.path}: its nodes have no Gaussians; expected streamed SOG")
        keys = [(place["file"], place["offset"], place["count"]) for place in places]
        self._cached = {key: self._cached[key] for key in keys if key in self._cached}
        missing = sorted(set(keys) - self._cached.keys())
        for file, some in groupby(missing, lambda key: key[0]):
            self._read(file, list(some))
        whole, smaller = joined([self._cached[key] for key in keys]), np.float32(self.scale)
        return replace(
            whole, means=whole.means / smaller, log_scales=whole.log_scales - np.log(smaller), comments=self.comments
        )

    def _read(self, file: int, keys: list[tuple[int, int, int]]) -> None:
        """Read the requested rows of a file into the cache."""
        name = self.path.parent / self._manifest["filenames"][file]
        try:
            meta = json.loads(name.read_bytes())
            splats = splats_in(meta, lambda image: (name.parent / Path(image).name).read_bytes(), str(name))
        except FileNotFoundError as error:
            raise DataError(f"{self.path}: {error.filename} is missing; expected the whole folder") from None
        except (OSError, ValueError) as error:
            text = " ".join(str(error).split())[:200]
            raise DataError(f"{name}: damaged ({text}); expected SOG's {name.name}") from None
        for key in keys:
            _, offset, count = key
            if offset + count > len(splats):
                raise DataError(
                    f"{self.path}: a node has rows to {offset + count} of file {file}, which has {len(splats)}"
                )
            self._cached[key] = splats.take(np.arange(offset, offset + count))
