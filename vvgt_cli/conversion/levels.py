"""Streamed SOG: levels of spatial nodes, chosen by measured errors, in files of SOG images with `lod-meta.json`.

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

from vvgt_cli.errors import UsageError
from vvgt_cli.field.digests import digest
from vvgt_cli.files import atomic_write
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.formats.page_file import upright
from vvgt_cli.gaussians.formats.sog import IMAGES, META, images_of, webp
from vvgt_cli.gaussians.formats.splats import Splats, joined, morton_order, splats_of
from vvgt_cli.gaussians.formats.streamed import level_files, remove_files
from vvgt_cli.gaussians.frames import transform
from vvgt_cli.gaussians.header import comment_lines
from vvgt_cli.gaussians.rules import INRIA, Rule
from vvgt_cli.score.record import Run, plain
from vvgt_cli.version import VERSION

if TYPE_CHECKING:
    from vvgt_cli.conversion.parts import Levels, StoredGaussians
    from vvgt_cli.field.blocked import Pass

CUTS = 10
STEP = 4.0  # factor of the score from a cut to the next: a cell's grows as the fourth power of its edge
FEWER = 9  # ratio of Gaussians of a level to the next: three times the edge, on a surface
MAX_LEVELS = 6
LEAST_PRICE, HALVINGS = 1e-12, 60  # price of a Gaussian in squared error, and steps of its bisection
FIELDS = ("counts", "squares", "energies", "pixels")
FEWEST = 4  # mean Gaussians of a node below which no further level is made
SEEN_FROM = ((0.62, 0.54, 0.57), (-0.59, 0.71, -0.38), (0.46, -0.33, -0.82))  # directions along no axis
VIEW_PIXELS = 96  # along an edge of the views by which cuts are compared, more than the cells of a tile
AWAY, MARGIN = 30.0, 1.1  # distance of the camera, and half the field of view, in radii of the node


@dataclass(frozen=True)
class CutErrors:
    """Errors and sizes of the cuts of N nodes; the first cut of each node is the finest.

    Attributes:
        thresholds: (CUTS,) thresholds of scores.
        counts: (N, CUTS) numbers of Gaussians.
        squares: (N, CUTS) squared differences from the finest, RGBA.
        energies: (N,) squared values of the finest.
        pixels: (N,) pixels that the finest covers.
    """

    thresholds: np.ndarray
    counts: np.ndarray
    squares: np.ndarray
    energies: np.ndarray
    pixels: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        """Return (N, CUTS) root mean square errors of a channel over the pixels that a node covers."""
        found: np.ndarray = np.sqrt(self.squares / np.maximum(4 * self.pixels, 1)[:, None])
        return found

    def at_price(self, price: float) -> np.ndarray:
        """Return (N,) cuts with the least sum of squared error and ``price`` per Gaussian."""
        costs = (self.squares + price * self.counts)[:, ::-1]
        found: np.ndarray = costs.shape[1] - 1 - costs.argmin(axis=1)
        return found

    def for_count(self, count: float) -> np.ndarray:
        """Return (N,) cuts of least total squared error with at most ``count`` Gaussians, by one price for all.

        One more Gaussian then lowers the error equally in every node (Shoham and Gersho 1988).
        """
        low, high = LEAST_PRICE, float(self.squares.max(initial=0)) + 1.0  # at the latter the coarsest everywhere
        if self.total(self.at_price(high)) > count or self.total(self.at_price(low)) <= count:
            return self.at_price(high if self.total(self.at_price(high)) > count else low)
        for _ in range(HALVINGS):
            middle = math.sqrt(low * high)
            low, high = (low, middle) if self.total(self.at_price(middle)) <= count else (middle, high)
        return self.at_price(high)

    def total(self, choice: np.ndarray) -> int:
        """Return the number of Gaussians of a choice of cuts."""
        return int(self.counts[np.arange(len(choice)), choice].sum())

    def rms(self, choice: np.ndarray) -> float:
        """Return the root mean square error of a choice of cuts over all nodes."""
        squares = self.squares[np.arange(len(choice)), choice].sum()
        return math.sqrt(squares / max(4 * self.pixels.sum(), 1))

    def levels(self, removed: int = 0) -> list[np.ndarray]:
        """Return the cuts (N,) of each level: the finest, then the best with a ninth of the Gaussians before.

        Args:
            removed: Gaussians that the finest has fewer than the budget, since more would be faint. The next level has
                a ninth of the budget all the same, or the finest again.
        """
        found = [np.zeros(len(self.counts), np.int64)]
        before = self.total(found[0]) + removed
        while len(found) < MAX_LEVELS and before >= FEWEST * len(self.counts):
            further = self.for_count(before / FEWER)
            count = self.total(further)
            if 2 * count > before:
                break
            found.append(further)
            before = count
        return found

    def facts(self, row: int, choice: list[int]) -> dict[str, Any]:
        """Return relative squared errors of a node's levels, as splat-transform's `errors`, and RMS errors."""
        energy = max(float(self.energies[row]), 1e-30)
        relative = [float(self.squares[row, index] / energy) for index in choice]
        return {"errors": relative, "rms": [float(self.errors[row, index]) for index in choice]}


def errors_of(nodes: Sequence[Sequence[Gaussians]], rule: str | Rule) -> dict[str, np.ndarray]:
    """Return the fields of `CutErrors` of nodes, each with its cuts, the finest first, drawn by ``rule``."""
    squares, energies, pixels = zip(*(level_errors(cuts, rule) for cuts in nodes), strict=True)
    counts = [[len(gaussians) for gaussians in cuts] for cuts in nodes]
    return dict(zip(FIELDS, map(np.array, (counts, squares, energies, pixels)), strict=True))


def level_errors(cuts: Sequence[Gaussians], rule: str | Rule = INRIA) -> tuple[np.ndarray, float, int]:
    """Measure the RGBA error of each cut of a node, coarser ones later, against the first, drawn by ``rule``.

    Returns:
        (n,) squared differences summed over the pixels of all views, never less than those of a finer cut; the
        squared values of the finest; the number of pixels that it covers.
    """
    from vvgt_cli.cameras.sets import look_at
    from vvgt_cli.splat import render

    finest = cuts[0]
    low, high = finest.means.min(axis=0).astype(np.float64), finest.means.max(axis=0).astype(np.float64)
    middle, widest = (low + high) / 2, float(np.exp(finest.log_scales.max()))
    radius = float(np.linalg.norm(high - low)) / 2 + widest
    field = float(np.degrees(2 * np.arctan(MARGIN / AWAY)))
    squares, covered, differences = 0.0, 0, np.zeros(len(cuts))
    for direction in SEEN_FROM:
        eye = middle + AWAY * radius * np.array(direction) / np.linalg.norm(direction)
        camera = look_at(eye, target=tuple(middle), width=VIEW_PIXELS, height=VIEW_PIXELS, fov=field)
        drawn = [render(cut, camera, rule).astype(np.float64) for cut in cuts]
        covered += int((drawn[0][..., 3] > 1 / 255).sum())
        squares += float((drawn[0] ** 2).sum())
        differences += [float(((picture - drawn[0]) ** 2).sum()) for picture in drawn]
    return np.maximum.accumulate(differences), squares, covered


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
    found = []
    for k, sums in enumerate(spreads.sum(axis=0)):
        own = [number for number, part in enumerate(task.parts) if part.level == k]
        found.append(
            {
                "gaussians": int(counts[:, k].sum()),
                "bytes": sum(task.size(number) for number in own),
                "files": len(own),
                "spread": SCALE * float(np.sqrt(sums[1] / sums[0])),
                "rms": errors.rms(choices[:, k]),
            }
        )
    return found


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
            found, own = self.gaussians.store.load(self.kind, number), slice(part.begin, part.end)
            low[own] = np.minimum(low[own], found["lows"])
            high[own] = np.maximum(high[own], found["highs"])
        return low, high


def _written(target: Path, splats: Splats) -> int:
    """Write the images and then `meta.json`, and return their bytes."""
    images, meta = images_of(splats)
    target.parent.mkdir(exist_ok=True)
    for name in IMAGES:
        if f"{name}.webp" not in images:  # of earlier levels, which had harmonics
            target.with_name(f"{name}.webp").unlink(missing_ok=True)
    size = sum(_put(target.with_name(name), webp(image)) for name, image in images.items())
    return size + _put(target, json.dumps(meta, separators=(",", ":")).encode())


def _put(path: Path, content: bytes) -> int:
    with atomic_write(path, overwrite=True) as temporary:
        temporary.write_bytes(content)
    return len(content)
