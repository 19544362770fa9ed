"""Streamed SOG: spatial nodes in levels, in files of SOG images with `lod-meta.json`.

The format is that of PlayCanvas 2.23.3 (`scene/gsplat-unified/gsplat-octree.js`, `gsplat-lod-table.js`) and
splat-transform 3.7.0 (`writers/write-lod.ts`). A node is a tile of the pyramid (`vvgt_cli.closed_form.pyramid`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vvgt_cli.conversion.cut import Levels, StoredGaussians
from vvgt_cli.conversion.level_selection import CutErrors
from vvgt_cli.errors import UsageError
from vvgt_cli.field.digests import digest
from vvgt_cli.files import atomic_write, linked, write_bytes
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.formats.page_file import upright
from vvgt_cli.gaussians.formats.sog import IMAGES, META, images_of, webp
from vvgt_cli.gaussians.formats.splats import Splats, joined, morton_order, splats_of
from vvgt_cli.gaussians.formats.streamed import level_files, remove_files
from vvgt_cli.gaussians.frames import transform
from vvgt_cli.gaussians.header import comment_lines
from vvgt_cli.score.record import Run, plain
from vvgt_cli.version import VERSION

if TYPE_CHECKING:
    from vvgt_cli.field.blocked import Pass

# Scale of the unit frame. The engine shows level 0 within 5 (`lodBaseDistance`) and level 1 within 15, so that the
# whole is seen in level 1 from where `vvgt render --orbit` begins, at 3 in the unit frame.
SCALE = 4.0
NEAREST = 5 / SCALE  # distance in the unit frame up to which level 0 is shown; each further level three times as far


def write_levels(
    run: Run, run_pass: Pass, levels: Levels, output: str, overwrite: bool, ply: PlyOptions, stage: str = "write"
) -> None:
    """Write the files and, last, the manifest; complete files of an interrupted run, or of an earlier call, are kept.

    Args:
        run: gets the stage, the number of Gaussians and the bytes.
        run_pass: runs the pass over the files.
        levels: what to write.
        output: path of the manifest.
        overwrite: replace an existing one.
        ply: layout of the file, with its place, and its certificate once there is one.
        stage: name of the stage.

    Raises:
        UsageError: the frame is not the unit frame.
    """
    if ply.frame != "unit":
        raise UsageError(f"-o {output}: levels need distances in the unit frame; remove --frame")
    cut, stored, errors, choices = levels.cut, levels.stored, levels.errors, levels.choices
    target, counts = Path(output), stored.field("counts")
    before, folder = level_files(target), target.absolute().parent
    parts, places = divide(counts)
    axes, options = np.array(cut.plan.axes).reshape(3, 3), replace(upright(cut.plan.ply), comments=False)
    task = WrittenFiles(stored, parts, folder, axes, SCALE, replace(options, sh_degree=cut.plan.degree))
    with run.stage(stage) as record, atomic_write(target, overwrite) as temporary:
        task.forget_changed()
        if stage == "write":
            linked(target).unlink(missing_ok=True)  # of another run, whose files are replaced
        run_pass(task, stage)
        spreads = stored.field("spreads")
        facts = _levels(task, counts, spreads, errors, choices)
        rows = zip(*task.bounds(len(counts)), places, spreads, strict=True)
        nodes = [_node(*row) | errors.facts(k, choices[k].tolist()) for k, row in enumerate(rows)]
        manifest = _manifest(ply, cut.plan.size, facts, task.names, nodes)
        temporary.write_text(json.dumps(plain(manifest), separators=(",", ":")))
        total = sum(level["bytes"] for level in facts)
        record.note = f"{output}: {len(nodes)} nodes, {len(parts)} files, {total / 1e6:.1f} MB; Gaussians "
        record.note += ", ".join(f"{level['gaussians']:,}" for level in facts)
        if not levels.removed and facts[0]["gaussians"] < cut.plan.budget // 2:
            record.note += f", no more: {cut.pyramid.base} cells suffice for the screen and {cut.plan.budget} Gaussians"
    remove_files(set(before) - set(level_files(target)))
    run.report.gaussians, run.report.bytes = facts[0]["gaussians"], total


def _node(low: np.ndarray, high: np.ndarray, lods: list[dict[str, int]], spreads: np.ndarray) -> dict[str, Any]:
    """Return the entry of a node."""
    return {
        "bound": {"min": low.tolist(), "max": high.tolist()},
        "lods": {str(k): place for k, place in enumerate(lods)},
        "spreads": [SCALE * float(np.sqrt(square / weight)) for weight, square in spreads],
    }


def _levels(
    task: WrittenFiles, counts: np.ndarray, spreads: np.ndarray, errors: CutErrors, choices: np.ndarray
) -> list[dict[str, Any]]:
    """Return what the manifest says of each level."""
    rows = []
    for k, sums in enumerate(spreads.sum(axis=0)):
        own = [number for number, part in enumerate(task.parts) if part.level == k]
        rows.append(
            {
                "gaussians": int(counts[:, k].sum()),
                "bytes": sum(task.size(number) for number in own),
                "files": len(own),
                "spread": SCALE * float(np.sqrt(sums[1] / sums[0])),
                "rms": errors.rms(choices[:, k]),
            }
        )
    return rows


def _manifest(
    ply: PlyOptions, size: int, levels: list[dict[str, Any]], names: Sequence[str], nodes: list[dict[str, Any]]
) -> dict[str, Any]:
    low = np.min([node["bound"]["min"] for node in nodes], axis=0)
    high = np.max([node["bound"]["max"] for node in nodes], axis=0)
    comments = [line.removeprefix("comment ") for line in comment_lines(upright(ply))]
    return {
        "version": 1,
        "asset": {"generator": f"vvgt {VERSION}"},
        "count": sum(level["gaussians"] for level in levels),
        "counts": [level["gaussians"] for level in levels],
        "lodLevels": len(levels),
        "lodErrors": True,
        "filenames": list(names),
        "tree": {"bound": {"min": low.tolist(), "max": high.tolist()}, "children": nodes},
        "vvgt": {"schema": 1, "scale": SCALE, "size": size, "levels": levels, "comments": comments},
    }


A_FILE = 1 << 17  # Gaussians in a file, except for those of its last node
REACH = 2.0  # standard deviations from the centres to the bounds of a node


class FilePart(NamedTuple):
    """The content of a file: a level of the nodes from ``begin`` to ``end``, and the file's number in that level."""

    level: int
    number: int
    begin: int
    end: int


def divide(counts: np.ndarray) -> tuple[tuple[FilePart, ...], list[list[dict[str, int]]]]:
    """Divide the levels of nodes among files.

    Args:
        counts: (nodes, levels) numbers of Gaussians.

    Returns:
        The files, in the order in which their first nodes come; and for each node, by level, its file, offset and
        count.
    """
    parts: list[FilePart] = []
    for level in range(counts.shape[1]):
        begin, rows, number = 0, 0, 0
        for node, count in enumerate(counts[:, level].tolist(), 1):
            rows += count
            if rows >= A_FILE or node == len(counts):
                parts.append(FilePart(level, number, begin, node))
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
        gaussians: Gaussians of all nodes, box frame.
        parts: content of the files.
        folder: folder of the manifest.
        axes: (3, 3) turn into the frame of the file.
        scale: scale from the unit frame.
        options: layout of the Gaussians.
    """

    gaussians: StoredGaussians
    parts: tuple[FilePart, ...]
    folder: Path
    axes: np.ndarray
    scale: float
    options: PlyOptions

    @property
    def kind(self) -> str:
        """Kind of the results."""
        return f"written-{digest(self.gaussians.kind, str(self.folder))[:16]}"

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
        for gaussians in self.gaussians.level(part.level, part.begin, part.end):
            splats = self._splats(gaussians)
            reach = REACH * np.exp(splats.log_scales.max(axis=1, keepdims=True))
            lows.append((splats.means - reach).min(axis=0))
            highs.append((splats.means + reach).max(axis=0))
            waiting.append(splats.take(morton_order(splats.means)))
        size = _written(target, joined(waiting))
        written = np.array([size, target.stat().st_mtime_ns])
        self.gaussians.store.save(self.kind, number, size=written, lows=np.array(lows), highs=np.array(highs))

    def _splats(self, gaussians: Gaussians) -> Splats:
        splats = splats_of(transform(gaussians, self.axes), self.options)
        larger = splats.log_scales + np.float32(math.log(self.scale))
        return replace(splats, means=splats.means * np.float32(self.scale), log_scales=larger)

    def forget_changed(self) -> None:
        """Forget files that are missing, or were changed since this run wrote them."""
        store = self.gaussians.store
        done = [number for number in range(len(self)) if not store.missing(self.kind, [number])]
        for number in done:
            target = self.folder / self.names[number]
            written = int(store.load(self.kind, number, names=("size",))["size"][1])
            if not target.is_file() or target.stat().st_mtime_ns != written:
                store.path(self.kind, number).unlink()

    def size(self, number: int) -> int:
        """Return the bytes of a written file."""
        return int(self.gaussians.store.load(self.kind, number, names=("size",))["size"][0])

    def bounds(self, nodes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest corners (nodes, 3) of all nodes, over their levels."""
        low, high = np.full((nodes, 3), np.inf), np.full((nodes, 3), -np.inf)
        for number, part in enumerate(self.parts):
            corners, own = self.gaussians.store.load(self.kind, number), slice(part.begin, part.end)
            low[own] = np.minimum(low[own], corners["lows"])
            high[own] = np.maximum(high[own], corners["highs"])
        return low, high


def _written(target: Path, splats: Splats) -> int:
    """Write the images and then `meta.json`, and return their bytes."""
    images, meta = images_of(splats)
    target.parent.mkdir(exist_ok=True)
    for name in IMAGES:
        if f"{name}.webp" not in images:  # of earlier levels, which had harmonics
            target.with_name(f"{name}.webp").unlink(missing_ok=True)
    size = sum(write_bytes(target.with_name(name), webp(image), overwrite=True) for name, image in images.items())
    return size + write_bytes(target, json.dumps(meta, separators=(",", ":")).encode(), overwrite=True)
