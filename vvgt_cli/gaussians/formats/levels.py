"""Reading streamed SOG: the Gaussians of one level, or those that the engine shows to a camera.

`FOLDER` and `FOLDER/lod-meta.json` name the finest level, with `#LEVEL` appended another one; `#view` selects the level
of each node as PlayCanvas 2.23.3 does (`scene/gsplat-unified/gsplat-octree-instance.js`, `gsplat-budget-balancer.js`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians.formats.sog import splats_in
from vvgt_cli.gaussians.formats.splats import ROW_BYTES, Splats, joined
from vvgt_cli.gaussians.formats.streamed import MANIFEST, nodes_of, placed, read_manifest
from vvgt_cli.resources import free_memory

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
    """

    path: Path

    def __post_init__(self) -> None:
        """Read the manifest."""
        self._manifest = read_manifest(self.path)
        self._nodes = nodes_of(self._manifest, self.path)
        self.count = int(self._manifest["lodLevels"])
        about, self.scale = placed(self._manifest)
        self._comments = about.comments
        self._cached: dict[tuple[int, int, int], Splats] = {}  # by file, offset, count: those of the last view

    def level(self, chosen: str | None) -> Splats:
        """Read the Gaussians of a level, None for the finest; nodes without it use their next finer one.

        Raises:
            UsageError: there is no such level.
            DataError: a file is missing or damaged, or the Gaussians do not fit in memory.
        """
        if chosen is not None and (not chosen.isdecimal() or int(chosen) >= self.count):
            raise UsageError(f"{self.path}#{chosen}: expected a level from 0 to {self.count - 1}, or #{VIEW} in render")
        return self._at_levels([int(chosen or 0)] * len(self._nodes))

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
            whole, means=whole.means / smaller, log_scales=whole.log_scales - np.log(smaller), comments=self._comments
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
