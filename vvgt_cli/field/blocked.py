"""`Blocked`: a field of which only blocks are in memory at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.cameras.blocks import Blocks
from vvgt_cli.cameras.sets import pixel_width
from vvgt_cli.dvr.layout import Light
from vvgt_cli.dvr.render import Box as Frame
from vvgt_cli.dvr.render import Rays, RenderSettings, for_thin
from vvgt_cli.field.cells import NORMALS, CellBlocks, ExtinctionBlocks, PointBlocks, RayBlocks, ValueBlocks, read_rows
from vvgt_cli.field.digests import digest, values_digest
from vvgt_cli.field.drawing import Drawing
from vvgt_cli.field.field import Picture, ViewRenderer
from vvgt_cli.field.grid import CellGrid
from vvgt_cli.field.parts import CELLS, Parts
from vvgt_cli.field.rays import Bundle, RayFile, composed
from vvgt_cli.field.reader import Scalars
from vvgt_cli.field.runners import Runner, Task
from vvgt_cli.field.settings import cell_grid
from vvgt_cli.field.source import Source
from vvgt_cli.field.workload import PROGRAM, VIEW, Workload, for_budget, pace, view_edge
from vvgt_cli.files import atomic_write
from vvgt_cli.gaussians import Gaussians

if TYPE_CHECKING:
    from vvgt_cli.closed_form import Start, VbmOptions
    from vvgt_cli.closed_form.moments import Cells
    from vvgt_cli.field.cells import Reader

Progress = Callable[[int, int], None]
RAY_STEP = 2e-8  # seconds of a step of a ray through what is not empty: bonsai-tree in blocks of 128, two threads
WAY = 1.5  # unit-frame lengths of a ray through the box, about


@dataclass
class Pass:
    """What does the blocks of a task that are missing.

    Attributes:
        runner: of the workers.
        parts: where what they leave is.
        bar: a progress bar by its name, None for none.
        shard: part (from 1) and count of the blocks that are this run's; None: all.
    """

    runner: Runner
    parts: Parts
    bar: Callable[[str], Progress | None]
    shard: tuple[int, int] | None = None

    def __call__(self, task: Task, name: str, numbers: Sequence[int] | None = None) -> int:
        """Do them; how many there were to do.

        Raises:
            Later: others are missing, of other shards.
            DataError: as the task.
        """
        self.parts.prepare(task.kind)
        everything = range(len(task)) if numbers is None else numbers
        index, count = self.shard or (1, 1)
        own = self.parts.missing(task.kind, (n for n in everything if n % count == index - 1))
        if own:
            self.runner.run(task, own, self.bar(name))
        missing = self.parts.missing(task.kind, everything)
        if missing:
            raise Later(name, len(missing))
        return len(own)


class Later(Exception):
    """Parts of other shards are missing: nothing more can be done now."""

    def __init__(self, what: str, missing: int) -> None:
        super().__init__(what)
        self.what, self.missing = what, missing


@dataclass
class Blocked:
    """A field (`vvgt_cli.field.field.Field`) that reads its volume block by block, and draws its own pictures.

    Attributes:
        source: what was opened, and its look.
        reader: reads boxes of it.
        do: runs passes over the blocks.
        edge: voxels along the edge of blocks, about.
        visible: voxels that have extinction, about.
        key: digest of all that it depends on.
        look: given a source of the same volumes, that with its statistics, its reader and visible voxels.
        pictures: drawn or expected, by what they show.
        grid: of its cells, once they are there.
        views: its pictures; None makes it draw them itself.
    """

    source: Source
    reader: Reader
    do: Pass
    edge: int
    visible: float
    key: str
    look: Callable[[Source], tuple[Source, Reader, float]]
    pictures: dict[str, tuple[Picture, np.ndarray | None]] = field(default_factory=dict)
    grid: CellGrid | None = None
    views: ViewRenderer = field(default=None)  # type: ignore[assignment] # set below

    def __post_init__(self) -> None:
        self.views = self.views or self

    @cached_property
    def frame(self) -> Frame:
        """Half extents and voxel edges, unit frame."""
        frame = self.source.volume.unit_frame()
        return Frame(np.array(frame.half), np.array(frame.step))

    @cached_property
    def light(self) -> Light | None:
        """What falls on it; shadows and occlusion take a pass."""
        lighting, volume = self.source.lighting, self.source.volume
        if lighting is None:
            return None
        from vvgt_cli.dvr.light import scene_light

        def extinction(cell: int) -> np.ndarray:
            task = ExtinctionBlocks(self.reader, self._grid(np.zeros(3, np.int64), cell), self.do.parts, cell)
            self.do(task, "light")
            return task.gathered()

        return scene_light(lighting, volume.axes, self.frame.step, volume.data.shape, extinction)

    def _grid(self, exponent: np.ndarray, least: int = 1) -> CellGrid:
        """Cells of 2^``exponent`` voxels, in blocks of whole cubes of ``least`` voxels."""
        from vvgt_cli.closed_form.closed_form import MARCH_SIZE
        from vvgt_cli.closed_form.visibility import widening

        dims, step = np.array(self.source.volume.dims), self.frame.step
        march = widening(dims, exponent, step, default_views("train", size=MARCH_SIZE))
        return cell_grid(self.source.volume, exponent, self.edge, march, least)

    def workload(self, size: int, gaussians: int) -> Workload:
        """See `Field.workload`: a view's time is estimated from the steps of its rays; nothing is timed."""
        x, y, z = (float(edge) for edge in self.frame.step)
        share = (self.visible / self.source.volume.data.size) ** (1 / 3)
        steps = view_edge(size, small=False) ** 2 * WAY / min(x, y, z) * max(share, 0.1)
        case = Workload(
            gaussians=gaussians, cells=0.0, voxels=self.visible, size=size, view=VIEW * RAY_STEP * steps, pace=pace(),
            there=PROGRAM + self.edge**3 * self.reader.voxel_bytes, visible=self.visible, step=(x, y, z),
        )  # fmt: skip
        return for_budget(case, gaussians)

    def cells(self, size: int, budget: int, most: int | None = None) -> CellBlocks:
        """The pass over base cells for images of ``size`` px; at most ``most`` cells, None: as many as memory holds."""
        from vvgt_cli.closed_form.closed_form import finest_level, level_within, most_cells
        from vvgt_cli.closed_form.moments import blocks, exponents
        from vvgt_cli.field.grid import TILE_BITS

        step = self.frame.step
        finest = finest_level(step, pixel_width(size))
        level = level_within(step, self.visible, most or most_cells(budget), finest)
        while blocks(exponents(step, level))[1].max() > 1 << TILE_BITS:
            level += 1  # of voxels so thin that a block of them is many cells
        grid, todo = self._grid(exponents(step, level)), self._todo()
        rays = self._file([(one, one.first()) for one in todo], grid) if todo else None
        if rays is not None:
            self.do.parts.prepare(rays.kind)
        return CellBlocks(self.reader, grid, self.do.parts, rays, self.light)

    def pyramid(self, options: VbmOptions, progress: Progress | None = None) -> Start:
        """See `Field.pyramid`."""
        from vvgt_cli.closed_form import start_of
        from vvgt_cli.closed_form.closed_form import form_of, most_cells
        from vvgt_cli.closed_form.lit import Shading

        most = most_cells(options.max_gaussians, options.values)
        task = self.cells(options.size, options.max_gaussians, most)
        self.do(task, "integrate")
        self.grid, half, step = task.grid, *self.frame
        shading = None if self.light is None else Shading(self.light, half, step, self._normals_at)
        form = form_of(  # which alone holds the cells: their tree takes twice as much
            _gathered(task), half, step, options.max_gaussians, options.size, None, None, self.source.labels_alone,
            shading, options.degree, values=options.values,
        )  # fmt: skip
        return start_of(form, options)

    def expect(self, pictures: Sequence[Picture]) -> None:
        """See `ViewRenderer.expect`."""
        for picture in pictures:
            self.pictures.setdefault(_key(picture), (picture, None))

    def view(self, camera: Camera, settings: RenderSettings, blocks: Blocks | None = None) -> np.ndarray:
        """See `ViewRenderer.view`: all expected pictures are drawn with the first that is asked for."""
        view = Picture(camera, settings, blocks)
        self.expect([view])
        if self.pictures[_key(view)][1] is None:
            self._march()
        picked = self.pictures[_key(view)][1]
        assert picked is not None
        if blocks is None:
            return picked
        image = np.zeros((camera.height, camera.width, 4), np.float32)
        image[blocks.mask()] = picked
        return image

    def forget(self, picture: Picture) -> None:
        """See `ViewRenderer.forget`."""
        self.pictures.pop(_key(picture), None)

    def _todo(self) -> list[Drawing]:
        """All that are expected."""
        return [
            Drawing(key, view.camera, for_thin(view.settings, self.frame, view.camera), view.blocks)
            for key, (view, made) in self.pictures.items()
            if made is None
        ]

    def _file(self, wanted: Sequence[tuple[Drawing, list[Rays]]], grid: CellGrid) -> RayFile:
        """The rays that pictures ask for next, in a file."""
        bundles = [
            Bundle(one.camera, one.settings.step, np.argwhere(mask)[:, ::-1], offsets)
            for one, rays in wanted
            for offsets, mask, _ in rays
        ]
        return RayFile.of(bundles, self.frame, grid.blocks, self.do.parts)

    def _march(self) -> None:
        """Make every picture that is expected, all of them together: at most two passes."""
        todo, grid = self._todo(), self.grid or self._grid(np.zeros(3, np.int64))
        for asked in (Drawing.first, Drawing.more):
            wanted = [(one, rays) for one in todo if (rays := asked(one))]
            if not wanted:
                continue
            file = self._file(wanted, grid)
            numbers = self._shown()
            task = RayBlocks(self.reader, grid, self.do.parts, file, self.light)
            self.do(task, "views", numbers)  # those that the pass over the cells has cast are there
            seen = composed(file, self.do.parts, numbers, self.source.volume.dims)
            for one, rays in wanted:
                for part in rays:
                    one.add(part, next(seen))
            seen.close()  # and with it the files that are mapped
        for one in todo:
            image = one.seen if one.blocks is not None else one.image()
            self.pictures[one.key] = self.pictures[one.key][0], image

    def _shown(self) -> list[int]:
        """Blocks that hold anything visible, as far as the pass over the cells has found it out."""
        if self.grid is None:
            return list(range(len(self._grid(np.zeros(3, np.int64)).blocks)))
        parts = self.do.parts
        return [n for n in range(len(self.grid.blocks)) if len(parts.load(CELLS, n, names=("counts",))["counts"])]

    def normals(self, gaussians: Gaussians) -> np.ndarray | None:
        """See `Field.normals`."""
        if self.light is None:
            return None
        from vvgt_cli.closed_form.lit import mean_normals, normal_points

        points = normal_points(gaussians)
        return mean_normals(points, self._at(points), self.frame.half)

    def _normals_at(self, points: np.ndarray) -> np.ndarray:
        return self._at(points)[:, :3]

    def _at(self, points: np.ndarray) -> np.ndarray:
        """Normals and extinction (n, 4) at points (n, 3) of the box frame."""
        grid = self.grid or self._grid(np.zeros(3, np.int64))
        at = (points + self.frame.half) / self.frame.step - 0.5
        parts, kind = self.do.parts, f"points-{digest(at)[:16]}"
        path = parts.folder / f"{kind}.npy"
        with atomic_write(path, overwrite=True) as temporary, open(temporary, "wb") as stream:
            np.save(stream, at)
        task = PointBlocks(self.reader, grid, parts, str(path), kind)
        self.do(task, "normals")
        out = np.zeros((len(at), 4))
        for number in range(len(task)):
            part = parts.load(kind, number)
            out[part["which"]] = part["found"]
        return out

    def sample(self, gaussians: Gaussians) -> np.ndarray:
        """See `Field.sample`."""
        from vvgt_cli.closed_form.gaussian_samples import POINTS, in_voxels, values_of

        self.source.one_field()
        assert isinstance(self.reader, Scalars)
        grid, parts = self.grid or self._grid(np.zeros(3, np.int64)), self.do.parts
        centres, arms = in_voxels(gaussians, *self.frame)
        rows = np.concatenate([centres, arms.reshape(-1, 9)], axis=1)
        kind = f"values-{digest(rows)[:16]}"
        path = parts.folder / f"{kind}.npy"
        with atomic_write(path, overwrite=True) as temporary, open(temporary, "wb") as stream:
            np.save(stream, rows)
        task = ValueBlocks(self.reader, grid, parts, str(path), kind)
        self.do(task, "values")
        samples = np.full(len(gaussians) * POINTS, np.nan, np.float32)
        for number in range(len(task)):
            part = parts.load(kind, number)
            samples[part["numbers"]] = part["found"]
        rule = self.reader.rule
        return values_of(samples.reshape(-1, POINTS), gaussians, rule.slope, rule.intercept)

    def with_look(self, source: Source) -> Blocked:
        """See `Field.with_look`: its blocks lie in a folder of their own, within this field's."""
        source, reader, visible = self.look(source)
        volumes = [id(volume) for volume in self.source.volumes]
        shown = [volumes.index(id(volume)) for volume in source.volumes]
        key = digest(self.key, source.shown_as(), [layer.tf for layer in source.layers], shown)
        parts = Parts(self.do.parts.folder / f"shown-{key[:16]}")
        parts.open({"shown": key}, ours=True)
        return Blocked(source, reader, replace(self.do, parts=parts), self.edge, visible, key, self.look)

    @cached_property
    def _digest(self) -> str | None:
        return values_digest([place.volume() for place in self.reader.all_places])

    def digest(self) -> str | None:
        """See `Field.digest`."""
        return self._digest


def _key(view: Picture) -> str:
    camera, blocks = view.camera, view.blocks
    lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    numbers = None if blocks is None else blocks.numbers
    return digest(camera.rotation, camera.translation, lens, view.settings, numbers)


def _gathered(task: CellBlocks) -> Cells:
    """All cells, with their normals where something is lit."""
    from vvgt_cli.closed_form.moments import Cells, in_order, morton

    index, moments, normals = [np.empty((0, 3), np.int32)], [], []
    for number in range(len(task)):
        part = task.parts.load(CELLS, number, names=("tiles", "counts"))
        offset = 0
        for tile, count in zip(part["tiles"], part["counts"].tolist(), strict=True):
            rows, local = read_rows(task.parts, number, offset, count)
            index.append(local + (tile * task.grid.tile_cells).astype(np.int32))
            moments.append(rows)
            offset += count
        if task.light is not None:
            normals.append(np.load(task.parts.path(CELLS, number, NORMALS)))
    whole = np.concatenate(index)
    lit = None
    if task.light is not None:
        lit = np.concatenate(normals)[np.argsort(morton(whole), kind="stable")]
    grid = task.grid
    return Cells(*in_order(whole, moments), grid.cell_edge, np.array(grid.exponent, np.int64), lit)
