"""The Gaussians of a cut region by region, of the closed form or refined; a region is a task for any worker.

The Gaussians of a `VolumePart` of a volume are fitted to pictures of it alone. Premultiplied pictures compose front to
back. So if the Gaussians of every part show what the part shows, all of them show what the volume shows, and parts can
be fitted in any order, by any number of workers, without an exchange.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.blocks import Blocks
from vvgt_cli.cameras.sets import RADIUS, pixel_width
from vvgt_cli.conversion.request import FitOptions, Limits
from vvgt_cli.conversion.shards.cut import Cut, CutNode, Regions
from vvgt_cli.conversion.shards.level_selection import CUTS, FIELDS, STEP, CutErrors, errors_of
from vvgt_cli.conversion.stage import Work
from vvgt_cli.conversion.stages import CheckViews, Refinement, TrainingViews
from vvgt_cli.conversion.stages.closed_form import FAINT_LOGIT
from vvgt_cli.conversion.stages.views import view_count
from vvgt_cli.dvr.layout import Light
from vvgt_cli.dvr.render import BoxFrame, RenderSettings, camera_arrays, for_thin, tiers
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.field.digests import digest
from vvgt_cli.field.rays import HALO, LIT_HALO, LONGEST, KernelBundle, caster, meeting
from vvgt_cli.field.reader import Layers, Scalars, VoxelBox
from vvgt_cli.gaussians import Gaussians, as_stored
from vvgt_cli.gaussians.frames import rescale
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.gaussians.types import concatenate
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run

if TYPE_CHECKING:
    from vvgt_cli.field.blocked import Pass
    from vvgt_cli.field.field import Field


REACH = 16  # voxels around a part that may hide it
PART_RADIUS = 1.25  # of a part in its frame: half its diagonal; the default views show all but its corners


class VolumePart:
    """The voxels of a box, cut out of a volume: a ray is transparent before and behind them.

    Its frame is centred on the box, with the directions of the volume's box frame, scaled so that half the diagonal is
    `PART_RADIUS`.

    Attributes:
        centre: (3,) centre in the volume's box frame.
        scale: lengths in its frame per length in the unit frame.
    """

    def __init__(
        self, reader: Scalars | Layers, frame: BoxFrame, dims: tuple[int, int, int], lo: np.ndarray, hi: np.ndarray,
        light: Light | None = None,
    ) -> None:  # fmt: skip
        """Read the voxels ``lo`` to ``hi`` (3,), x first, of a volume of ``dims`` voxels with this ``frame``."""
        from vvgt_cli.dvr.bricks import brick_ranges, empty_distance

        halo = REACH + (HALO if light is None else LIT_HALO)
        self.box: VoxelBox = reader.box(np.maximum(lo - halo, 0), np.minimum(hi + halo, dims))
        self._lo, self._hi, self._dims, self._frame, self._light = lo, hi, dims, frame, light
        self.centre = (lo + hi) / 2 * frame.step - frame.half
        self.scale = PART_RADIUS / float(np.linalg.norm((hi - lo) / 2 * frame.step))
        self._empty = empty_distance(brick_ranges(self.box.values), self.box.optics)

    @property
    def views(self) -> VolumePart:
        """The renderer of its pictures, as `vvgt_cli.field.field.Field.views`."""
        return self

    def view(
        self, camera: Camera, settings: RenderSettings, blocks: Blocks | None = None, grown: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Render a picture (h, w, 4) of the part, as `render_view` does.

        Args:
            camera: camera in the part's frame.
            settings: settings of the rays.
            blocks: blocks to render, None for all.
            grown: voxels along each axis by which the faces that cut the volume move outwards, at most `REACH`; a box
                without extent is transparent.
        """
        eye, basis, lens = self._arrays(camera)
        lo = np.where(self._lo > 0, self._lo - grown, 0.0)
        hi = np.where(self._hi < self._dims, self._hi + grown, self._dims)
        cast = caster(self.box, self._empty, lo, hi, self._dims, self._light)
        out = np.zeros((camera.height, camera.width, 4), np.float32)
        box = BoxFrame((self._hi - self._lo) / 2 * self._frame.step * self.scale, self._frame.step * self.scale)
        for rays in tiers(for_thin(settings, box, camera), out, blocks):
            for offsets, mask, known in rays:
                row, column = np.nonzero(mask)
                pixels = np.stack([column, row], axis=1)
                bundle = KernelBundle(eye, basis, lens, min(settings.step, LONGEST), pixels, offsets)
                near = meeting(bundle, lo - 0.5, hi - 0.5)
                sums = np.zeros((len(pixels), 4))
                sums[near] = cast(bundle, near).sum(axis=1)
                out[row, column] = (known * out[row, column] + sums) / (known + len(offsets))
        return out

    def shown(self, camera: Camera) -> np.ndarray:
        """Return the share (h, w) float32 of each pixel's light from the part that passes the voxels before it.

        Voxels up to `REACH` before the part count: where its faces lie inside a body, other parts hide them.
        """
        eye, basis, lens = self._arrays(camera)
        column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        pixels = np.stack([column.ravel(), row.ravel()], axis=1)
        bundle = KernelBundle(eye, basis, lens, LONGEST, pixels, np.zeros((1, 2)))
        through = np.ones(len(pixels), np.float32)
        for lo, hi in self._before(eye):
            near = meeting(bundle, lo - 0.5, hi - 0.5)
            seen = caster(self.box, self._empty, lo, hi, self._dims, self._light)(bundle, near)
            through[near] *= 1 - seen[:, 0, 3]
        return through.reshape(camera.height, camera.width)

    def weights(self, camera: Camera, width: float) -> np.ndarray:
        """Return (h, w) factors by which errors of a part's picture count in pictures of the volume.

        They are `shown`, and lower where the picture changes with the place of the faces that cut the volume: Gaussians
        reach over these, and only those of both sides together show what is there. Faces move by an eighth of the part
        at most. Two by two pixels have a factor in common.

        Args:
            camera: camera in the part's frame, with an even number of pixels along each edge.
            width: length by which Gaussians reach over a face, in the part's frame.
        """
        grown = np.minimum(width / (self._frame.step * self.scale), np.minimum((self._hi - self._lo) / 8, REACH))
        single = RenderSettings(step=LONGEST, samples=1)
        half = camera.resized(0.5)
        inner, outer = (self.view(half, single, grown=by) for by in (-grown, grown))
        found: np.ndarray = self.shown(half) * (1 - np.abs(outer - inner).max(axis=2))
        return found.repeat(2, axis=0).repeat(2, axis=1)

    def _before(self, eye: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield boxes of voxels (first, end) that rays from an eye, in voxels, may pass before they enter the part.

        A ray has entered once it has passed the near face of each axis, so that the boxes, one an axis, do not overlap.
        """
        lo, hi = np.maximum(self._lo - REACH, 0), np.minimum(self._hi + REACH, self._dims)
        for axis in range(3):
            first, end = lo.copy(), hi.copy()
            if eye[axis] < self._lo[axis] - 0.5:
                end[axis] = lo[axis] = self._lo[axis]
            elif eye[axis] > self._hi[axis] - 0.5:
                first[axis] = hi[axis] = self._hi[axis]
            else:
                continue
            if (first < end).all():
                yield first, end

    def _arrays(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return `camera_arrays` of a camera in the part's frame, in voxels of the volume."""
        frame = BoxFrame(self._frame.half * self.scale, self._frame.step * self.scale)
        eye, basis, lens = camera_arrays(frame, camera)
        return eye + self.centre / self._frame.step, basis * self.scale, lens

    def moved_in(self, gaussians: Gaussians) -> Gaussians:
        """Return Gaussians of the volume's box frame in the part's frame."""
        return rescale(gaussians, self.scale, -self.centre, np.zeros(3))

    def moved_out(self, gaussians: Gaussians) -> Gaussians:
        """Return Gaussians of the part's frame in the volume's box frame."""
        return rescale(gaussians, 1 / self.scale, np.zeros(3), self.centre)


@dataclass(frozen=True)
class Refiner:
    """A volume and options for the refinement of its regions.

    Attributes:
        reader, light: see `vvgt_cli.field.cells.CellBlocks`.
        fit: options of the descent.
        limits: target PSNR on a part's own weighted check views, at which its descent ends.
        distances: distance from which each level is seen, unit frame.
    """

    reader: Scalars | Layers
    light: Light | None
    fit: FitOptions
    limits: Limits
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
        compared: whether only errors of levels are saved, and how many Gaussians of the first are faint.
    """

    cut: Cut
    regions: Regions
    thresholds: np.ndarray
    least: bool
    kind: str
    refiner: Refiner | None = None
    compared: bool = False

    def __len__(self) -> int:
        """Return the number of regions."""
        return len(self.regions.ends)

    def __call__(self, number: int) -> None:
        """Save the nodes of region ``number``, and the errors of their levels if these are refined or compared."""
        nodes = self.cut.nodes(*self.regions.rows(number), self.thresholds, self.least)
        if self.refiner is not None:
            nodes = self._refined(nodes, number, self.refiner)
        errors: dict[str, np.ndarray] = {}
        if self.least and (self.refiner is not None or self.compared):
            errors = errors_of([node.levels for node in nodes], self.cut.plan.ply.rule or INRIA)
        if not self.compared:
            save(self.cut.store, self.kind, number, nodes, errors)
            return
        faint = [sum(int((node.levels[0].opacity_logits < FAINT_LOGIT).sum()) for node in nodes)]
        self.cut.store.save(self.kind, number, ".npz", faint=np.array(faint), **errors)

    def _refined(self, nodes: list[CutNode], number: int, refiner: Refiner) -> list[CutNode]:
        """Return the nodes of a region, each level refined as a whole."""
        grid = self.cut.plan.grid
        frame = BoxFrame(np.array(grid.half), np.array(grid.step))
        part = VolumePart(refiner.reader, frame, grid.blocks.dims, *self.cut.box(self.regions, number), refiner.light)
        levels = []
        for k, distance in enumerate(refiner.distances):
            own = [node.levels[k] for node in nodes]
            refined = refine_part(part, concatenate(own), refiner, distance)
            ends = np.cumsum([len(each) for each in own])
            levels.append([refined.take(np.arange(e - len(each), e)) for each, e in zip(own, ends, strict=True)])
        return [
            CutNode(list(made), node.spreads, node.normals)
            for made, node in zip(zip(*levels, strict=True), nodes, strict=True)
        ]


def save(store: BlockStore, kind: str, number: int, nodes: Sequence[CutNode], more: dict[str, np.ndarray]) -> None:
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
class StoredGaussians:
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
        """Yield the Gaussians of level ``k`` of nodes ``begin`` to ``end``; raise DataError if a region is damaged."""
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
) -> StoredGaussians:
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
    steps: Any = None if refiner is None else (refiner.fit, refiner.limits, refiner.distances)
    key = digest(cut.key, thresholds, steps, regions, least)[:16]
    kind = f"{'closed' if refiner is None else 'refined'}-{key}"
    task = RegionNodes(cut, regions, thresholds, least, kind, refiner)
    name = "closed form" if refiner is None else "refinement"
    with run.stage(name) as stage:
        run_pass(task, name)
        workers, edge = run_pass.runner.workers, int((regions.width * cut.plan.grid.tile).max())
        steps_of = "" if refiner is None else f"{refiner.fit.steps} steps in each of "
        stage.note = f"{steps_of}{len(task)} regions of {edge} voxels" + (f", {workers} workers" if workers > 1 else "")
    return StoredGaussians(cut.store, kind, regions.ends)


def measure_cuts(run_pass: Pass, cut: Cut, budget: int) -> tuple[CutErrors, int]:
    """Make and draw `CUTS` cuts of every node, or reuse an interrupted run's.

    Args:
        run_pass: runs the pass over the regions.
        cut: pyramid to cut.
        budget: largest number of Gaussians of the finest cut.

    Returns:
        The errors; and how many Gaussians of the finest cut are faint (`FAINT_LOGIT`).

    Raises:
        DataError: a block is damaged.
    """
    tree, most = cut.pyramid, np.finfo(float).max
    finest = tree.threshold(budget)
    second = max(tree.threshold(max(int(tree.counts(finest).sum()) // 2, 1)), np.finfo(float).tiny)
    values = np.minimum(np.array([finest, *(second * STEP ** np.arange(CUTS - 1))]), most)
    regions, thresholds = cut.regions(finest), np.broadcast_to(values, (len(tree), CUTS))
    kind = f"errors-{digest(cut.key, values)[:16]}"
    run_pass(RegionNodes(cut, regions, thresholds, True, kind, compared=True), "errors")
    stored = StoredGaussians(cut.store, kind, regions.ends)
    return replace(stored.errors(), thresholds=values), int(stored.field("faint").sum())


PIXEL = 2.0  # width of a pixel of the training views, in median standard deviations of the middle axis
SMALLEST, LARGEST, MULTIPLE = 64, 384, 16  # pixels along the edge of a view
FACES = 3.0  # median standard deviations of the middle axis by which Gaussians reach over a face


def refine_part(part: VolumePart, gaussians: Gaussians, refiner: Refiner, distance: float = RADIUS) -> Gaussians:
    """Return Gaussians of the volume's box frame, refined; the given ones where descent does not help.

    Args:
        part: voxels that the Gaussians stand for.
        gaussians: Gaussians of the closed form.
        refiner: options of the descent.
        distance: distance in the unit frame from which they are seen, which decides on the screen's pixel.
    """
    start, steps = part.moved_in(gaussians), refiner.fit.steps or 0
    if not len(gaussians) or not steps:
        return gaussians
    screen = pixel_width(refiner.fit.size) * distance / RADIUS * part.scale
    width = float(np.exp(np.median(np.sort(start.log_scales, axis=1)[:, 1])))
    edge = view_edge(width, screen)
    fit = replace(refiner.fit, size=max(round(pixel_width(1) / screen), edge))
    field = cast("Field", part)  # only its pictures are drawn
    run = Run(Console(quiet=True), ConversionReport("convert"))
    work = Work(run, field, fit, refiner.limits, gaussians=start, weigh=lambda at: part.weights(at, FACES * width))
    CheckViews(edge=edge).run(work)
    if work.target_reached():
        return gaussians
    TrainingViews(view_count(steps, small=True), edge).run(work)
    Refinement(steps, steps, small=True, overlap=True).run(work)
    record = run.report.refinement
    return as_stored(part.moved_out(work.current())) if record and record["kept"] else gaussians


def view_edge(width: float, screen: float) -> int:
    """Return the pixels along the edge of views of Gaussians, whose pixels are as wide as neighbours are apart.

    Args:
        width: median standard deviation of the middle axis, in the frame of the views.
        screen: width of a screen's pixel there, the least width of a view's pixel.
    """
    edge = pixel_width(1) / max(PIXEL * width, screen)
    return int(np.clip(math.ceil(edge / MULTIPLE) * MULTIPLE, SMALLEST, LARGEST))
