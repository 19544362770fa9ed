"""`Blocked`: a field that holds only some blocks of its volume in memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import Blocks, Camera, default_views, pixel_width
from vvgt_cli.closed_form.columns import MOMENTS
from vvgt_cli.dvr.layout import Light
from vvgt_cli.dvr.render import BoxFrame, Rays, RenderSettings, camera_arrays, first_rays, for_thin, more_rays
from vvgt_cli.field.block_store import CELLS, BlockStore
from vvgt_cli.field.cells import CellBlocks, MeanBlocks, PointBlocks, RayBlocks, ValueBlocks
from vvgt_cli.field.digests import digest
from vvgt_cli.field.field import Field, Picture, ViewRenderer
from vvgt_cli.field.grid import CellGrid
from vvgt_cli.field.rays import LONGEST, Bundle, RayFile, composed
from vvgt_cli.field.reader import Scalars
from vvgt_cli.field.runners import Runner, Task
from vvgt_cli.field.settings import cell_grid
from vvgt_cli.field.source import StyledVolume
from vvgt_cli.field.workload import PROGRAM, VIEW, Workload, for_budget, pace, view_edge
from vvgt_cli.files import write_arrays
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.progress import ProgressCallback

if TYPE_CHECKING:
    from vvgt_cli.closed_form import Start, VbmOptions
    from vvgt_cli.closed_form.moments import Cells
    from vvgt_cli.dvr.traced import Scattering
    from vvgt_cli.field.cells import Reader


RAY_STEP = 2e-8  # seconds per step of a ray outside empty space: bonsai-tree in blocks of 128, two threads
PATH_LENGTH = 1.5  # of a typical ray through the box, unit-frame lengths


@dataclass
class Pass:
    """A pass over blocks, which computes only those that the store lacks.

    Attributes:
        runner: runner of the workers.
        store: destination of their results.
        bar: returns a progress bar for a name, or None.
        shard: index (from 1) and count of the shards that the blocks are divided among; None for all blocks.
    """

    runner: Runner
    store: BlockStore
    bar: Callable[[str], ProgressCallback | None]
    shard: tuple[int, int] | None = None

    def __call__(self, task: Task, name: str, numbers: Sequence[int] | None = None) -> int:
        """Compute a task's missing blocks and return how many there were.

        Raises:
            MissingBlocks: blocks of other shards are missing.
            DataError: see the task.
        """
        self.store.prepare(task.kind)
        everything = range(len(task)) if numbers is None else numbers
        index, count = self.shard or (1, 1)
        own = self.store.missing(task.kind, (n for n in everything if n % count == index - 1))
        if own:
            self.runner.run(task, own, self.bar(name))
        missing = self.store.missing(task.kind, everything)
        if missing:
            raise MissingBlocks(name, len(missing))
        return len(own)


class MissingBlocks(Exception):
    """The state in which blocks of other shards are missing, so that the run cannot continue yet."""

    def __init__(self, what: str, missing: int) -> None:
        """Name the pass, and how many of its blocks are missing."""
        super().__init__(what)
        self.what, self.missing = what, missing


@dataclass
class Blocked(Field):
    """A field that reads its volume block by block, and renders its own pictures.

    Attributes:
        source: the opened volume and its look.
        reader: reader of its boxes.
        run_pass: runs passes over the blocks.
        edge: approximate edge of a block in voxels.
        visible: approximate number of voxels with extinction.
        key: digest of everything that the field depends on.
        prepare_look: maps a source of the same volumes to that source with statistics, reader and visible voxels.
        pictures: rendered pictures, the pixels (n, 4) of their blocks, and expected ones, None; by digest.
        grid: the grid of base cells, once they are integrated.
        renderer: renders its pictures; None selects the field itself.
    """

    source: StyledVolume
    reader: Reader
    run_pass: Pass
    edge: int
    visible: float
    key: str
    prepare_look: Callable[[StyledVolume], tuple[StyledVolume, Reader, float]]
    pictures: dict[str, tuple[Picture, np.ndarray | None]] = field(default_factory=dict)
    grid: CellGrid | None = None
    renderer: ViewRenderer | None = None

    @cached_property
    def frame(self) -> BoxFrame:
        """Half extents and voxel edges in the unit frame."""
        frame = self.source.volume.unit_frame()
        return BoxFrame(np.array(frame.half), np.array(frame.step))

    @cached_property
    def light(self) -> Light | None:
        """Lighting for the kernels; skies take a pass over the blocks."""
        lighting, volume = self.source.lighting, self.source.volume
        if lighting is None:
            return None
        from vvgt_cli.dvr.light import scene_light, shade_cell

        def matter() -> Scattering:
            cell = shade_cell(volume.data.shape)
            task = MeanBlocks(self.reader, self._grid(np.zeros(3, np.int64), cell), self.run_pass.store, cell)
            self.run_pass(task, "light")
            return task.scattering(self.frame.step)

        return scene_light(lighting, volume.axes, self.frame.step, volume.data.shape, matter)

    def _grid(self, exponent: np.ndarray, least: int = 1) -> CellGrid:
        """Return a grid of cells of 2^``exponent`` voxels, in blocks made of whole cubes of ``least`` voxels."""
        from vvgt_cli.closed_form.closed_form import MARCH_SIZE
        from vvgt_cli.closed_form.visibility import widening

        dims, step = np.array(self.source.volume.dims), self.frame.step
        march = widening(dims, exponent, step, default_views("train", size=MARCH_SIZE))
        return cell_grid(self.source.volume, exponent, self.edge, march, least)

    def workload(self, size: int, gaussians: int) -> Workload:
        """Implement `Field.workload`, with a view's time estimated from its ray steps instead of measured."""
        x, y, z = (float(edge) for edge in self.frame.step)
        share = (self.visible / self.source.volume.data.size) ** (1 / 3)
        steps = view_edge(size, small=False) ** 2 * PATH_LENGTH / min(x, y, z) * max(share, 0.1)
        workload = Workload(
            gaussians=gaussians, cells=0.0, voxels=self.visible, size=size, view=VIEW * RAY_STEP * steps, pace=pace(),
            base_bytes=PROGRAM + self.edge**3 * self.reader.voxel_bytes, visible=self.visible, step=(x, y, z),
        )  # fmt: skip
        return for_budget(workload, gaussians)

    def cells(self, size: int, most: int) -> CellBlocks:
        """Return the task for base cells for ``size`` px images, ``most`` at most."""
        from vvgt_cli.closed_form.closed_form import finest_level, level_within
        from vvgt_cli.closed_form.moments import blocks, exponents
        from vvgt_cli.field.grid import TILE_BITS

        step = self.frame.step
        finest = finest_level(step, pixel_width(size))
        level = level_within(step, self.visible, most, finest)
        while blocks(exponents(step, level))[1].max() > 1 << TILE_BITS:
            level += 1  # voxels so thin that a block has too many cells
        grid, todo = self._grid(exponents(step, level)), self._pending()
        rays = self._file([(one, one.first_pass()) for one in todo.values()], grid) if todo else None
        if rays is not None:
            self.run_pass.store.prepare(rays.kind)
        return CellBlocks(self.reader, grid, self.run_pass.store, rays, self.light, self.source.labels_alone)

    def pyramid(self, options: VbmOptions, progress: ProgressCallback | None = None) -> Start:
        """Implement `Field.pyramid`."""
        from vvgt_cli.closed_form import start_of
        from vvgt_cli.closed_form.closed_form import form_of, most_cells
        from vvgt_cli.closed_form.lit import Shading

        task = self.cells(options.size, most_cells(options.max_gaussians, options.values))
        self.run_pass(task, "integrate")
        self.grid, half, step = task.grid, *self.frame
        shading = None if self.light is None else Shading(self.light, half, step, self._normals_at)
        form = form_of(  # pass the cells on without keeping them: their tree takes twice as much memory
            _gathered(task), half, step, options.max_gaussians, options.size, None, None, self.source.labels_alone,
            shading, options.degree, values=options.values,
        )  # fmt: skip
        return start_of(form, options)

    def expect(self, pictures: Sequence[Picture]) -> None:
        """Implement `ViewRenderer.expect`."""
        for picture in pictures:
            self.pictures.setdefault(picture.key, (picture, None))

    def view(self, camera: Camera, settings: RenderSettings, blocks: Blocks | None = None) -> np.ndarray:
        """Implement `ViewRenderer.view`; the first request renders all expected pictures."""
        view = Picture(camera, settings, blocks)
        self.expect([view])
        if self.pictures[view.key][1] is None:
            self._render_pending()
        colors = self.pictures[view.key][1]
        assert colors is not None
        return view.drawn.image(colors)

    def forget(self, picture: Picture) -> None:
        """Implement `ViewRenderer.forget`."""
        self.pictures.pop(picture.key, None)

    def _pending(self) -> dict[str, Drawing]:
        """Return the pictures that are expected but not rendered, by digest."""
        return {
            key: Drawing(view.camera, for_thin(view.settings, self.frame, view.camera), view.drawn)
            for key, (view, colors) in self.pictures.items()
            if colors is None
        }

    def _file(self, wanted: Sequence[tuple[Drawing, list[Rays]]], grid: CellGrid) -> RayFile:
        """Write the rays that pictures need next to a file."""
        bundles = [
            Bundle(
                *camera_arrays(self.frame, one.camera), min(one.settings.step, LONGEST), np.argwhere(mask)[:, ::-1],
                offsets,
            )
            for one, rays in wanted
            for offsets, mask, _ in rays
        ]  # fmt: skip
        return RayFile.of(bundles, grid.blocks, self.run_pass.store)

    def _render_pending(self) -> None:
        """Render all expected pictures together, in at most two passes."""
        todo, grid = self._pending(), self.grid or self._grid(np.zeros(3, np.int64))
        for asked in (Drawing.first_pass, Drawing.second_pass):
            wanted = [(one, rays) for one in todo.values() if (rays := asked(one))]
            if not wanted:
                continue
            file = self._file(wanted, grid)
            numbers = self._visible_blocks()
            task = RayBlocks(self.reader, grid, self.run_pass.store, file, self.light)
            self.run_pass(task, "views", numbers)  # the pass over the cells may have cast some already
            seen = composed(file, self.run_pass.store, numbers, self.source.volume.dims)
            for one, rays in wanted:
                for part in rays:
                    one.add(part, next(seen))
            seen.close()  # closes the mapped files, too
        for key, one in todo.items():
            self.pictures[key] = self.pictures[key][0], one.colors

    def _visible_blocks(self) -> list[int]:
        """Return the blocks with visible cells.

        All blocks are returned before the cells are integrated, and of layers of scalars, which may be visible between
        voxels alone.
        """
        if self.grid is None or self.source.mixed:
            return list(range(len((self.grid or self._grid(np.zeros(3, np.int64))).blocks)))
        store = self.run_pass.store
        return [n for n in range(len(self.grid.blocks)) if len(store.load(CELLS, n, names=("counts",))["counts"])]

    def normals(self, gaussians: Gaussians) -> np.ndarray | None:
        """Implement `Field.normals`."""
        if self.light is None:
            return None
        from vvgt_cli.closed_form.lit import mean_normals

        return mean_normals(gaussians, self._normals_and_extinction, self.frame.half)

    def _normals_at(self, points: np.ndarray) -> np.ndarray:
        return self._normals_and_extinction(points)[:, :3]

    def _normals_and_extinction(self, points: np.ndarray) -> np.ndarray:
        """Return normals and extinction (n, 4) at points (n, 3) of the box frame."""
        grid = self.grid or self._grid(np.zeros(3, np.int64))
        at = (points + self.frame.half) / self.frame.step - 0.5
        store, kind = self.run_pass.store, f"points-{digest(at)[:16]}"
        task = PointBlocks(self.reader, grid, store, self._saved(at, kind), kind)
        self.run_pass(task, "normals")
        out = np.zeros((len(at), 4))
        for number in range(len(task)):
            part = store.load(kind, number)
            out[part["which"]] = part["normals"]
        return out

    def _saved(self, rows: np.ndarray, kind: str) -> str:
        """Return the path of a new file of the store with an array."""
        path = self.run_pass.store.folder / f"{kind}.npy"
        write_arrays(path, rows)
        return str(path)

    def sample(self, gaussians: Gaussians) -> np.ndarray:
        """Implement `Field.sample`."""
        from vvgt_cli.closed_form.gaussian_samples import NORMAL_SUMS, POINTS, in_voxels, values_of

        self.source.require_scalar_field()
        assert isinstance(self.reader, Scalars)
        grid, store = self.grid or self._grid(np.zeros(3, np.int64)), self.run_pass.store
        centres, arms = in_voxels(gaussians, *self.frame)
        rows = np.concatenate([centres, arms.reshape(-1, 9)], axis=1)
        kind = f"values-{digest(rows)[:16]}"
        task = ValueBlocks(self.reader, grid, store, self._saved(rows, kind), kind)
        self.run_pass(task, "values")
        samples = np.full(len(gaussians) * POINTS, np.nan, np.float32)
        sums = np.zeros((len(gaussians), NORMAL_SUMS))
        for number in range(len(task)):
            part = store.load(kind, number)
            samples[part["numbers"]] = part["values"]
            sums[part["which"]] += part["sums"]
        rule = self.reader.rule
        return values_of(samples.reshape(-1, POINTS), sums, gaussians, rule.slope, rule.intercept)

    def with_look(self, source: StyledVolume) -> Blocked:
        """Implement `Field.with_look`; the new field's blocks go to a subfolder of this field's store."""
        source, reader, visible = self.prepare_look(source)
        volumes = [id(volume) for volume in self.source.volumes]
        shown = [volumes.index(id(volume)) for volume in source.volumes]
        key = digest(self.key, source.shown_as(), [layer.tf for layer in source.layers], shown)
        store = BlockStore(self.run_pass.store.folder / f"shown-{key[:16]}")
        store.open({"shown": key}, ours=True)
        return Blocked(source, reader, replace(self.run_pass, store=store), self.edge, visible, key, self.prepare_look)


def _gathered(task: CellBlocks) -> Cells:
    """Return all cells, with normals under light."""
    from vvgt_cli.closed_form.moments import Cells
    from vvgt_cli.field.tiles import places_of, read_cells

    grid, lit, places = task.grid, task.light is not None, places_of(task.store, task.grid)
    count, done = sum(place.cells for place in places), 0
    index, moments, normals = np.empty((count, 3), np.int32), np.empty((count, MOMENTS)), np.empty((count * lit, 3))
    for place in places:
        part, here = read_cells(task.store, grid, place, lit), slice(done, done + place.cells)
        index[here], moments[here], done = part.index, part.moments, here.stop
        if part.normals is not None:
            normals[here] = part.normals
    return Cells(index, moments, grid.cell_edge, np.array(grid.exponent, np.int64), normals if lit else None)


@dataclass
class Drawing:
    """A partially rendered picture, which stores only the pixels of its blocks.

    Attributes:
        camera, settings: the fields of `Picture`.
        blocks: the blocks to render, all of them of a whole picture.
    """

    camera: Camera
    settings: RenderSettings
    blocks: Blocks

    @cached_property
    def mask(self) -> np.ndarray:
        """Mask (h, w) of the pixels to render."""
        return self.blocks.mask()

    @cached_property
    def colors(self) -> np.ndarray:
        """Colours (n, 4) float32 of these pixels, row by row."""
        return np.zeros((np.count_nonzero(self.mask), 4), np.float32)

    def first_pass(self) -> list[Rays]:
        """Return the rays of the first pass."""
        return first_rays(self.settings, self.mask)

    def second_pass(self) -> list[Rays]:
        """Return the rays of the second pass."""
        return more_rays(self.settings, self.blocks.image(self.colors), self.mask)

    def add(self, rays: Rays, shown: np.ndarray) -> None:
        """Average in the colours that ``rays`` see, (pixels, rays, 4) float64."""
        offsets, mask, known = rays
        at = mask[self.mask]
        self.colors[at] = (known * self.colors[at] + shown.sum(axis=1)) / (known + len(offsets))
