"""Gaussians of a folder of streamed SOG: those of one level, or those that the engine shows a camera.

`FOLDER`, `FOLDER/lod-meta.json` and either of them with `#LEVEL` after it name the finest or another level; `#view`
that of each node which PlayCanvas 2.23.3 shows (`scene/gsplat-unified/gsplat-octree-instance.js`, `gsplat-budget-balancer.js`).
"""  # noqa: E501

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians.formats.sog_images import splats_in
from vvgt_cli.gaussians.formats.splats import A_ROW, Splats, joined
from vvgt_cli.gaussians.formats.streamed import MANIFEST, nodes_of, placed, read_manifest
from vvgt_cli.resources import free_memory

BASE, TIMES = 5.0, 3.0  # distance at which level 1 begins, and each further one: `lodBaseDistance`, `lodMultiplier`
FIELD = 45.0  # degrees of view for which those are; others count as nearer or farther
VIEW = "view"


def split_name(name: str | Path) -> tuple[Path, str | None] | None:
    """The manifest that a name stands for and what is after "#"; None for names of anything else."""
    place, mark, chosen = str(name).rpartition("#")
    for path, after in ((str(name), None), (place, chosen)) if mark else ((str(name), None),):
        if Path(path).name == MANIFEST:
            return Path(path), after
        if path and (Path(path) / MANIFEST).is_file():
            return Path(path) / MANIFEST, after
    return None


def by_view(name: str | Path) -> Path | None:
    """The manifest, where a name asks for what a viewer shows each camera."""
    found = split_name(name)
    return found[0] if found is not None and found[1] == VIEW else None


@dataclass
class StreamedLevels:
    """What a manifest has.

    Attributes:
        path: of it.
        scale: by which lengths are larger than in a `.ply` of the same Gaussians.
        count: of levels.
    """

    path: Path

    def __post_init__(self) -> None:
        self._manifest = read_manifest(self.path)
        self._nodes = nodes_of(self._manifest, self.path)
        self.count = int(self._manifest["lodLevels"])
        about, self.scale = placed(self._manifest)
        self._comments = about.comments
        self._shown: dict[tuple[int, int, int], Splats] = {}  # by file, offset, count: of the last view

    def level(self, chosen: str | None) -> Splats:
        """The Gaussians of a level by its number, None for the finest; of nodes without it the next finer one.

        Raises:
            UsageError: no such level.
            DataError: a file is missing or damaged, or memory does not hold them.
        """
        if chosen is not None and (not chosen.isdecimal() or int(chosen) >= self.count):
            raise UsageError(f"{self.path}#{chosen}: expected a level from 0 to {self.count - 1}, or render's #{VIEW}")
        return self._taken([int(chosen or 0)] * len(self._nodes))

    def seen_from(self, eye: np.ndarray, field: float) -> Splats:
        """Those that the engine shows an eye (3,), in the frame of a `.ply`, with ``field`` degrees of view.

        Raises:
            DataError: nodes without bounds, or as `level`.
        """
        try:
            bounds = np.array([[node["bound"]["min"], node["bound"]["max"]] for node in self._nodes], np.float64)
            apart = np.linalg.norm(np.clip(eye * self.scale, bounds[:, 0], bounds[:, 1]) - eye * self.scale, axis=1)
        except (KeyError, TypeError, ValueError):
            raise DataError(f"{self.path}: nodes without bounds; expected the engine's: give a level, #0") from None
        seen = apart * math.tan(math.radians(field / 2)) / math.tan(math.radians(FIELD / 2))
        levels = np.floor(1 + np.log(np.maximum(seen, 1e-9) / BASE) / math.log(TIMES))
        return self._taken(np.clip(levels, 0, self.count - 1).astype(int).tolist())

    def _taken(self, levels: Sequence[int]) -> Splats:
        places = []
        for node, level in zip(self._nodes, levels, strict=True):
            held = {int(key): place for key, place in node["lods"].items()}
            own = [key for key in held if key <= level]
            places += [held[max(own) if own else min(held)]] if held else []
        free, rows = free_memory(), sum(place["count"] for place in places)
        if free is not None and A_ROW * rows > free:
            need = A_ROW * rows / 2**30
            raise DataError(f"{self.path}: {rows:,} Gaussians take about {need:.1f} GiB; try a coarser level, as #1")
        if not places:
            raise DataError(f"{self.path}: its nodes have no Gaussians; expected streamed SOG")
        keys = [(place["file"], place["offset"], place["count"]) for place in places]
        self._shown = {key: self._shown[key] for key in keys if key in self._shown}
        missing = sorted(set(keys) - self._shown.keys())
        for file, some in groupby(missing, lambda key: key[0]):
            self._read(file, list(some))
        whole, smaller = joined([self._shown[key] for key in keys]), np.float32(self.scale)
        return replace(
            whole,
            means=whole.means / smaller,
            log_scales=whole.log_scales - np.log(smaller),
            comments=self._comments,
        )

    def _read(self, file: int, keys: list[tuple[int, int, int]]) -> None:
        """Keep what is asked for of a file."""
        name = self.path.parent / self._manifest["filenames"][file]
        try:
            meta = json.loads(name.read_bytes())
            found = splats_in(meta, lambda image: (name.parent / Path(image).name).read_bytes(), str(name))
        except FileNotFoundError as error:
            raise DataError(f"{self.path}: {error.filename} is missing; expected the whole folder") from None
        except (OSError, ValueError) as error:
            text = " ".join(str(error).split())[:200]
            raise DataError(f"{name}: damaged ({text}); expected SOG's {name.name}") from None
        for key in keys:
            _, offset, count = key
            if offset + count > len(found):
                raise DataError(
                    f"{self.path}: a node has rows to {offset + count} of file {file}, which has {len(found)}"
                )
            self._shown[key] = found.take(np.arange(offset, offset + count))
