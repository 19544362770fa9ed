"""The Gaussians of a cut region by region, of the closed form or refined; a region is a task for any worker."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.cameras.sets import RADIUS
from vvgt_cli.conversion.part_descent import PartDescent
from vvgt_cli.conversion.shards.cut import Cut, Node, Regions
from vvgt_cli.conversion.shards.level_selection import FIELDS, CutErrors, errors_of
from vvgt_cli.dvr.layout import Light
from vvgt_cli.dvr.render import Box as Frame
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.field.digests import digest
from vvgt_cli.field.part import Part
from vvgt_cli.field.reader import Layers, Scalars
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.types import concatenate

if TYPE_CHECKING:
    from vvgt_cli.field.blocked import Pass
    from vvgt_cli.score.record import Run


@dataclass(frozen=True)
class Refiner:
    """A volume and options for the refinement of its regions.

    Attributes:
        reader, light: see `vvgt_cli.field.cells.CellBlocks`.
        descent: options of the descent.
        distances: distance from which each level is seen, unit frame.
    """

    reader: Scalars | Layers
    light: Light | None
    descent: PartDescent
    distances: tuple[float, ...] = (RADIUS,)


@dataclass(frozen=True)
class RegionNodes:
    """The task of making the Gaussians of each region.

    Attributes:
        cut: cut to make.
        regions: division of its tiles.
        thresholds, least: see `Cut.nodes`.
        kind: kind of the results.
        refiner: refiner of the Gaussians, None for the closed form.
    """

    cut: Cut
    regions: Regions
    thresholds: np.ndarray
    least: bool
    kind: str
    refiner: Refiner | None

    def __len__(self) -> int:
        """Return the number of regions."""
        return len(self.regions.ends)

    def __call__(self, number: int) -> None:
        """Save the nodes of region ``number``, and the errors of their levels if these are refined."""
        nodes = self.cut.nodes(*self.regions.rows(number), self.thresholds, self.least)
        errors: dict[str, np.ndarray] = {}
        if self.refiner is not None:
            nodes = self._refined(nodes, number, self.refiner)
            errors = errors_of([node.levels for node in nodes]) if self.least else {}
        save(self.cut.store, self.kind, number, nodes, errors)

    def _refined(self, nodes: list[Node], number: int, refiner: Refiner) -> list[Node]:
        """Return the nodes of a region, each level refined as a whole."""
        grid = self.cut.plan.grid
        frame = Frame(np.array(grid.half), np.array(grid.step))
        part = Part(refiner.reader, frame, grid.blocks.dims, *self.cut.box(self.regions, number), refiner.light)
        levels = []
        for k, distance in enumerate(refiner.distances):
            own = [node.levels[k] for node in nodes]
            refined = refiner.descent(part, concatenate(own), distance)
            ends = np.cumsum([len(each) for each in own])
            levels.append([refined.take(np.arange(e - len(each), e)) for each, e in zip(own, ends, strict=True)])
        return [
            Node(list(made), node.spreads, node.normals)
            for made, node in zip(zip(*levels, strict=True), nodes, strict=True)
        ]


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


@dataclass(frozen=True)
class Made:
    """The Gaussians of a cut, in the store.

    Attributes:
        store: store of the regions.
        kind: kind of the results.
        ends: end of each region's range of nodes.
    """

    store: BlockStore
    kind: str
    ends: tuple[int, ...]

    def level(self, k: int, begin: int, end: int) -> Iterator[Gaussians]:
        """Yield the Gaussians of level ``k`` of the nodes from ``begin`` to ``end``.

        Raises:
            DataError: a region's file is missing or damaged.
        """
        for number in range(int(np.searchsorted(self.ends, begin, "right")), len(self.ends)):
            first = self.ends[number - 1] if number else 0
            if first >= end:
                return
            names = [one for one in self.store.names(self.kind, number) if one.endswith(f"-{k}")]
            part = self.store.load(self.kind, number, names=["counts", *names])
            whole, counts = Gaussians(**{name.rpartition("-")[0]: part[name] for name in names}), part["counts"][:, k]
            for row, (n, e) in enumerate(zip(counts, np.cumsum(counts), strict=True), first):
                if begin <= row < end:
                    yield whole.take(np.arange(e - n, e))

    def regions(self) -> Iterator[tuple[Gaussians, np.ndarray | None]]:
        """Yield the Gaussians of the first level and their normals, None without a light, region by region."""
        for number in range(len(self.ends)):
            part = self.store.load(self.kind, number)
            named = {name.removesuffix("-0"): array for name, array in part.items() if name.endswith("-0")}
            yield Gaussians(**named), part.get("normals")

    def field(self, name: str) -> np.ndarray:
        """Return an array of all regions: "counts" or "spreads" of nodes' levels, "opacity_logits-0" of Gaussians."""
        parts = [self.store.load(self.kind, number, names=[name])[name] for number in range(len(self.ends))]
        return np.concatenate(parts)

    def errors(self) -> CutErrors:
        """Return the errors of refined levels."""
        found = {name: self.field(name) for name in FIELDS}
        return CutErrors(np.zeros(found["counts"].shape[1]), **found)


def make_regions(
    run: Run, run_pass: Pass, cut: Cut, thresholds: np.ndarray, refiner: Refiner | None = None, least: bool = True
) -> Made:
    """Make the Gaussians of a cut region by region; results of an interrupted run are reused.

    Args:
        run: gets a stage.
        run_pass: runs the pass over the regions.
        cut: cut to make.
        thresholds: see `Cut.nodes`.
        refiner: refiner of the Gaussians, None for the closed form.
        least: see `Cut.nodes`.

    Raises:
        DataError: a block is damaged.
    """
    regions = cut.regions(float(thresholds[0, 0]))
    steps: Any = None if refiner is None else (digest(refiner.descent), refiner.distances)
    key = digest(cut.key, thresholds, steps, regions, least)[:16]
    kind = f"{'closed' if refiner is None else 'refined'}-{key}"
    task = RegionNodes(cut, regions, thresholds, least, kind, refiner)
    name = "closed form" if refiner is None else "refinement"
    with run.stage(name) as stage:
        run_pass(task, name)
        workers, edge = run_pass.runner.workers, int((regions.width * cut.plan.grid.tile).max())
        steps_of = "" if refiner is None else f"{refiner.descent.steps} steps in each of "
        stage.note = f"{steps_of}{len(task)} regions of {edge} voxels" + (f", {workers} workers" if workers > 1 else "")
    return Made(cut.store, kind, regions.ends)
