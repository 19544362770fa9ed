"""The refinement of a cut region by region; a region is a cube of nodes, and a task for any worker."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.conversion.part_descent import PartDescent
from vvgt_cli.conversion.shards.cut import Cut, Node
from vvgt_cli.conversion.shards.level_selection import FIELDS, CutErrors, errors_of
from vvgt_cli.conversion.shards.plan import PLAN
from vvgt_cli.dvr.layout import Light
from vvgt_cli.dvr.render import Box as Frame
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.field.digests import digest
from vvgt_cli.field.grid import CellGrid
from vvgt_cli.field.part import Part
from vvgt_cli.field.reader import Layers, Scalars
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.types import concatenate

if TYPE_CHECKING:
    from vvgt_cli.field.blocked import Blocked
    from vvgt_cli.field.tiled_tree import TiledTree
    from vvgt_cli.score.record import Run

ENOUGH = 1 << 14  # mean Gaussians of a region from which it is not widened
LARGEST = 1 << 28  # bytes of its voxels while they are read


@dataclass(frozen=True)
class RegionDescent:
    """The task of refining the Gaussians of each region.

    Attributes:
        reader, grid, store, light: see `vvgt_cli.field.cells.CellBlocks`.
        descent: options of the descent.
        distances: distance from which each level is seen, unit frame.
        boxes: first voxel of each region, and the end of its range.
        closed: kind of the stored closed form.
        kind: kind of the results.
        measured: whether the errors of the levels are saved, too.
    """

    reader: Scalars | Layers
    grid: CellGrid
    store: BlockStore
    light: Light | None
    descent: PartDescent
    distances: tuple[float, ...]
    boxes: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]
    closed: str
    kind: str
    measured: bool

    def __len__(self) -> int:
        """Return the number of regions."""
        return len(self.boxes)

    def __call__(self, number: int) -> None:
        """Save the refined Gaussians of region ``number``, and the errors of its levels."""
        nodes = loaded(self.store, self.closed, number)
        lo, hi = (np.array(end, np.int64) for end in self.boxes[number])
        frame = Frame(np.array(self.grid.half), np.array(self.grid.step))
        part = Part(self.reader, frame, self.grid.blocks.dims, lo, hi, self.light)
        levels = []
        for k, distance in enumerate(self.distances):
            own = [node.levels[k] for node in nodes]
            refined = self.descent(part, concatenate(own), distance)
            ends = np.cumsum([len(each) for each in own])
            levels.append([refined.take(np.arange(e - len(each), e)) for each, e in zip(own, ends, strict=True)])
        found = [
            Node(list(made), node.spreads, node.normals)
            for made, node in zip(zip(*levels, strict=True), nodes, strict=True)
        ]
        errors = errors_of([node.levels for node in found]) if self.measured else {}
        save(self.store, self.kind, number, found, errors)


def save(store: BlockStore, kind: str, number: int, nodes: Sequence[Node], more: dict[str, np.ndarray]) -> None:
    """Save nodes of one region."""
    arrays: dict[str, np.ndarray] = {
        "counts": np.array([[len(level) for level in node.levels] for node in nodes]),
        "spreads": np.array([node.spreads for node in nodes]),
    }
    if nodes[0].normals is not None:
        arrays["normals"] = np.concatenate([node.normals for node in nodes])
    for k in range(len(nodes[0].levels)):
        whole = concatenate([node.levels[k] for node in nodes]).arrays()
        arrays |= {f"{name}-{k}": array for name, array in whole.items()}
    store.save(kind, number, ".npz", **(more | arrays))


def loaded(store: BlockStore, kind: str, number: int) -> list[Node]:
    """Return the nodes of a region.

    Raises:
        DataError: the file is missing or damaged.
    """
    part = store.load(kind, number)
    counts, made = part["counts"], []
    for k in range(counts.shape[1]):
        named = {name.rpartition("-")[0]: array for name, array in part.items() if name.endswith(f"-{k}")}
        whole, ends = Gaussians(**named), np.cumsum(counts[:, k])
        made.append([whole.take(np.arange(e - n, e)) for n, e in zip(counts[:, k], ends, strict=True)])
    normals: list[Any] = [None] * len(counts)
    if "normals" in part:
        normals = np.split(part["normals"], np.cumsum(counts[:, 0])[:-1])
    rows = zip(zip(*made, strict=True), part["spreads"], normals, strict=True)
    return [Node(list(levels), list(spreads), own) for levels, spreads, own in rows]


@dataclass(frozen=True)
class Refined:
    """A refined cut, in the store.

    Attributes:
        store: store of the regions.
        kind: kind of the results.
        regions: number of regions.
        key: digest of everything that the Gaussians depend on.
    """

    store: BlockStore
    kind: str
    regions: int
    key: str

    def nodes(self) -> Iterator[list[Node]]:
        """Yield the nodes, region by region, in the order of the cut."""
        for number in range(self.regions):
            yield loaded(self.store, self.kind, number)

    def errors(self) -> CutErrors:
        """Return the errors of the refined levels."""
        parts = [self.store.load(self.kind, number, names=FIELDS) for number in range(self.regions)]
        found = {name: np.concatenate([part[name] for part in parts]) for name in FIELDS}
        return CutErrors(np.zeros(found["counts"].shape[1]), **found)


@dataclass(frozen=True)
class Refiner:
    """A volume and options for the refinement of its cuts."""

    field: Blocked
    descent: PartDescent

    def __call__(
        self, run: Run, cut: Cut, thresholds: np.ndarray, distances: Sequence[float], least: bool = True
    ) -> Refined:
        """Refine a cut; results of an interrupted run are reused.

        Args:
            run: gets a stage.
            cut: cut to refine.
            thresholds: (tiles, levels) as of `Cut.nodes`.
            distances: distance from which each level is seen, unit frame.
            least: see `Cut.nodes`.
        """
        store, grid, tree = self.field.run_pass.store, cut.plan.grid, cut.tiled_tree
        width = _width(tree, grid, self.field.reader.voxel_bytes, thresholds[:, 0])
        plan = (store.folder / PLAN).read_text("utf-8")
        key = digest(plan, thresholds, self.descent, tuple(distances), width, least)[:16]
        places = np.array([tile.place for tile in tree.tiles]) // width
        first = np.flatnonzero(np.any(places[1:] != places[:-1], axis=1)) + 1
        ends = [*first.tolist(), len(places)]
        edge = width * grid.tile
        lows = [places[end - 1] * edge for end in ends]
        boxes = tuple((tuple(lo.tolist()), tuple(np.minimum(lo + edge, grid.dims).tolist())) for lo in lows)
        closed = f"closed-{digest(plan, thresholds, width, least)[:16]}"
        store.prepare(closed)
        if store.missing(closed, range(len(ends))):
            waiting: list[Node] = []
            done = 0
            for some in cut.nodes(thresholds, least=least):
                waiting += some
                while done < len(ends) and len(waiting) >= (size := ends[done] - (ends[done - 1] if done else 0)):
                    save(store, closed, done, waiting[:size], {})
                    waiting, done = waiting[size:], done + 1
        task = RegionDescent(
            self.field.reader, grid, store, self.field.light, self.descent, tuple(distances), boxes, closed,
            f"refined-{key}", least,
        )  # fmt: skip
        with run.stage("refinement") as stage:
            self.field.run_pass(task, "refinement")
            workers = self.field.run_pass.runner.workers
            stage.note = f"{self.descent.steps} steps in each of {len(task)} regions of {edge.max()} voxels"
            stage.note += f", {workers} workers" if workers > 1 else ""
        return Refined(store, task.kind, len(task), key)


def _width(tree: TiledTree, grid: CellGrid, voxel_bytes: int, thresholds: np.ndarray) -> int:
    """Return the edge of a region in tiles, a power of two: enough Gaussians, and voxels that fit in memory."""
    places = np.array([tile.place for tile in tree.tiles])
    total, width = tree.count(float(thresholds[0])), 1
    while True:
        regions = len(np.unique(places // width, axis=0))
        wider = float((2 * width * grid.tile).prod()) * voxel_bytes
        if regions == 1 or total >= ENOUGH * regions or wider > LARGEST:
            return width
        width *= 2
