"""`render-views`: calibrated views of a volume for trainers, resumable and divisible into shards."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.cameras import Camera, default_views, orbit_views
from vvgt_cli.cameras.boxed import render_in_box, to_box_frame
from vvgt_cli.cameras.files import read_frames
from vvgt_cli.cameras.sets import FIELD_OF_VIEW, RADIUS, SET_VIEWS, SIZE
from vvgt_cli.commands.view_files import (
    CONTACT,
    POINTS,
    Layout,
    View,
    field_points,
    start_points,
    thumbnail,
    thumbnails,
)
from vvgt_cli.conversion.manifest import Manifest, Shard
from vvgt_cli.device import on_device
from vvgt_cli.errors import DataError, NothingVisible, UsageError
from vvgt_cli.field.blocked import Blocked
from vvgt_cli.field.digests import cameras_digest, volume_digest
from vvgt_cli.field.field import Picture
from vvgt_cli.field.open import FieldNeeds, automatic, blocked, store_beside
from vvgt_cli.field.settings import BlockOptions
from vvgt_cli.field.source import Source, SourceRequest, describe_source, load_all
from vvgt_cli.files import atomic_write, claim
from vvgt_cli.gaussians.outputs import check_folder
from vvgt_cli.images import write_png
from vvgt_cli.jit.ahead import VIEWS, for_blocks
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.version import VERSION
from vvgt_cli.volume.space import shear_text
from vvgt_cli.volume.types import IDENTITY

if TYPE_CHECKING:
    from vvgt_cli.dvr import RenderSettings


Draw = Callable[[Camera], np.ndarray]
NO_POINTS = np.zeros((0, 3))

SPHERE, ORBIT = "sphere", "orbit"


@dataclass(frozen=True)
class CameraRequest:
    """Views to render.

    Attributes:
        kind: ``sphere``, ``orbit`` or the path of a `transforms.json`.
        views, test_views: their numbers; None: 24 and 10. A file decides both.
        size: image height in pixels; None: the file's, or 400.
        fov: vertical field of view in degrees, None: 40.
        radius: distance from the centre, unit frame, None: 3.
    """

    kind: str = SPHERE
    views: int | None = None
    test_views: int | None = None
    size: int | None = None
    fov: float | None = None
    radius: float | None = None

    def make(self) -> list[View]:
        """Return the views, training views first.

        Raises:
            UsageError: options that a file of cameras decides, or no such file.
            DataError: an invalid file, or views of one name.
        """
        if self.kind not in (SPHERE, ORBIT):
            return self._read()
        size, fov, radius = self.size or SIZE, self.fov or FIELD_OF_VIEW, self.radius or RADIUS
        count = SET_VIEWS["train"] if self.views is None else self.views
        if self.kind == SPHERE:
            train = default_views("train", count, size=size, radius=radius, fov=fov)
        else:
            train = orbit_views(count, size=size, radius=radius, fov=fov)
        kept = SET_VIEWS["test"] if self.test_views is None else self.test_views
        test = default_views("test", kept, size=size, radius=radius, fov=fov)
        return [View("train", camera) for camera in train] + [View("test", camera) for camera in test]

    def _read(self) -> list[View]:
        given = {
            "--views": self.views, "--test-views": self.test_views, "--fov": self.fov, "--radius": self.radius
        }  # fmt: skip
        for option, value in given.items():
            if value is not None:
                raise UsageError(f"{option} {value}: the file of --cameras decides this; omit it")
        if not Path(self.kind).is_file():
            raise UsageError(f"--cameras {self.kind}: no such file; expected sphere, orbit or a transforms.json")
        views: dict[str, View] = {}
        frames = read_frames(self.kind, self.size)
        for frame in sorted(frames, key=lambda frame: frame.test):
            # the Blender style names images without a suffix, so a dot would be read as one
            name = re.sub(r"[^\w-]", "_", frame.camera.name)
            if name in views:
                raise DataError(
                    f"{self.kind}: two views become {name!r}; expected names that differ in letters or digits"
                )
            views[name] = View("test" if frame.test else "train", replace(frame.camera, name=name))
        if all(frame.test for frame in frames):
            raise DataError(f"{self.kind}: all views are test views; expected some training views")
        return list(views.values())


@dataclass(frozen=True)
class ViewsRequest:
    """A set of views for each function.

    Attributes:
        source: volume to read; its ``tf`` is not used.
        tfs: transfer functions; empty: one made from the histogram.
        output: directory; several functions get a subdirectory each, by name.
        cameras: views to render.
        layout: files to write.
        renderer: ``vvgt`` or ``vtk``.
        samples: rays along a pixel's edge everywhere, None: 5 or 13 where neighbours differ, else 1.
        step: sampling distance in voxels.
        shard: part of the views to render.
        overwrite: replace the views of another run.
        blocks: how the volume is processed in blocks; None: in memory, or in blocks if it is large.
        device: "cpu" or "cuda", where our own renderer casts the rays of a volume in memory.
    """

    source: SourceRequest
    tfs: tuple[str, ...]
    output: str
    cameras: CameraRequest = field(default_factory=CameraRequest)
    layout: Layout = field(default_factory=Layout)
    renderer: str = "vvgt"
    samples: int | None = None
    step: float = 0.5
    shard: Shard = field(default_factory=Shard)
    overwrite: bool = False
    blocks: BlockOptions | None = None
    device: str = "cpu"

    def folders(self) -> list[Path]:
        """Return one folder per function.

        Raises:
            UsageError: two functions of one name, or a folder that cannot be made.
        """
        root = Path(self.output)
        check_folder(root, "views")
        if len(self.tfs) < 2:
            return [root]
        names: dict[str, str] = {}
        for tf in self.tfs:
            name = function_name(tf)
            if name in names:
                raise UsageError(f"--tf {names[name]} and --tf {tf} would both go to {root / name}; rename one")
            names[name] = tf
        return [root / name for name in names]


def function_name(tf: str) -> str:
    """Return the folder name of a function: its file's stem, `#Preset` and colour-map range in plain characters."""
    path, _, pick = tf.partition("#")
    name = re.sub(r"\.json$", "", path.replace("\\", "/").rpartition("/")[2], flags=re.I)
    return re.sub(r"[^\w.-]+", "_", f"{name}-{pick}" if pick else name).strip(".") or "function"


@dataclass
class _Job:
    """One function's folder and the views to render there."""

    source: Source
    manifest: Manifest
    pending: list[View]  # this part's
    files: list[str]  # of the descriptions and models that this part writes
    small: dict[str, np.ndarray] = field(default_factory=dict)  # thumbnails of views that were rendered
    field: Blocked | None = None  # where the volume is not in memory

    @property
    def folder(self) -> Path:
        return self.manifest.folder


def render_view_sets(request: ViewsRequest, console: Console | None = None) -> int:
    """Render the missing views and return their number.

    Raises:
        UsageError: a folder with another run's views or unknown files, or options that do not fit.
        DataError: invalid input, or a function that shows nothing.
    """
    if request.overwrite and request.shard.count > 1:
        raise UsageError(
            "--overwrite with --shard: shards would remove each other's files; remove the directory instead"
        )
    if request.renderer == "vtk" and request.samples not in (None, 1):
        raise UsageError(f"--samples {request.samples}: VTK casts one ray per pixel; omit it")
    run = Run(console or Console(), ConversionReport("render-views"))
    views, folders = request.cameras.make(), request.folders()
    with ExitStack() as stack:
        functions = dict(zip(folders, request.tfs or (None,), strict=True))
        size = views[0].camera.height
        fields = fields_of(run, request.source, request.blocks, functions, size, request.renderer, stack)
        if fields is None:
            with run.stage("read") as stage:
                sources = load_all(request.source, request.tfs or (None,))
                stage.note = describe_source(sources[0])
        else:
            sources = [field.source for field in fields]
        volume = sources[0].volume
        if volume.sheared:
            raise DataError(
                f"{volume.name}: {shear_text(volume.axes)}; expected right angles: no pinhole camera sees a sheared "
                "volume; resample it first ('vvgt convert' accepts it)"
            )
        lit = [source for source in sources if source.lighting is not None]
        lit.sort(key=lambda source: source.lighting is not None and source.lighting.attenuated)
        kernels = (lit or sources)[-1].kernels(VIEWS)
        run.compile(kernels if fields is None else for_blocks(kernels), sources[0].kernel_type())
        with run.stage("plan") as stage:
            jobs = _plan(request, views, folders, sources, fields)
            total = sum(len(job.pending) for job in jobs)
            stage.note = f"{len(jobs) * len(views)} views, {total} to render here"
        for job in jobs:
            _work(run, request, job, views)
            if job.field is not None:
                job.field.run_pass.store.remove()
    return total


def _settings(request: ViewsRequest, views: Sequence[View], source: Source, content: str) -> dict[str, Any]:
    """Return everything that the files depend on, named as on the command line."""
    cameras = {split: [view.camera for view in views if view.split == split] for split in ("train", "test")}
    sizes = dict.fromkeys(f"{view.camera.width} x {view.camera.height}" for view in views)
    return {
        "version": VERSION,
        "volume": content,
        "function": source.look(),
        "opacity_unit_distance": source.unit_distance,
        **({} if source.lighting is None else {"light": source.lighting.text()}),
        "views": len(cameras["train"]),
        "test_views": len(cameras["test"]),
        "size": ", ".join(sizes),
        "cameras": cameras_digest(cameras["train"] + cameras["test"]),
        **({} if source.volume.direction == IDENTITY else {"direction": list(source.volume.direction)}),
        "renderer": request.renderer,
        "samples": 1 if request.renderer == "vtk" else request.samples or "adaptive",
        "step": request.step,
        "format": request.layout.format,
        "half": request.layout.half,
        "background": list(request.layout.background),
        **({} if request.layout.points else {"points": False}),
    }


def _plan(
    request: ViewsRequest, views: list[View], folders: list[Path], sources: list[Source], fields: list[Blocked] | None
) -> list[_Job]:
    """Find what is missing in every folder, before anything is written."""
    content, layout = volume_digest(sources[0].volume), request.layout
    first = request.shard.index == 1  # the first part describes the set
    jobs = []
    for i, (folder, source) in enumerate(zip(folders, sources, strict=True)):
        manifest = Manifest(folder, _settings(request, views, source, content), request.shard)
        files = [*layout.descriptions(views), *layout.model_names()]
        planned = [name for view in views for name in layout.files(view)]
        manifest.open([*planned, *files, CONTACT], request.overwrite)
        mine = [view for j, view in enumerate(views) if request.shard.holds(i * len(views) + j)]
        pending = [view for view in mine if not all(map(manifest.complete, layout.files(view)))]
        missing = [name for name in files if first and not manifest.complete(name)]
        jobs.append(_Job(source, manifest, pending, missing, field=None if fields is None else fields[i]))
    return jobs


def _work(run: Run, request: ViewsRequest, job: _Job, views: list[View]) -> None:
    """Make what is missing in one function's folder; whatever may fail early runs before the first write."""
    from vvgt_cli.dvr import RenderSettings
    from vvgt_cli.dvr.backends import view_renderer

    manifest, layout = job.manifest, request.layout
    built = layout.descriptions(views)
    models = any(name not in built for name in job.files)
    settings = RenderSettings(request.step, request.samples)
    draw: Draw | None = None
    points: Callable[[int], tuple[np.ndarray, np.ndarray]]
    if job.field is not None:
        draw = draw_in_blocks(job.field, settings, [view.camera for view in job.pending])
        points = partial(field_points, job.field)
    elif job.pending or models:
        with run.stage("scene") as stage:
            scene = on_device(job.source.scene(), request.device, run.console.message)
            stage.note = f"{job.source.name}, opacity per {job.source.unit_distance:g} ({job.source.unit_label})"
        inside = view_renderer(request.renderer, scene, settings) if job.pending else None
        draw = None if inside is None else render_in_box(inside, scene.volume.axes)
        points = partial(start_points, scene)
    if models and layout.points:
        with run.stage("points") as stage:
            found = points(views[0].camera.height)
            if not len(found[0]):
                raise NothingVisible(job.source.volume.name, job.source.tf.name)
            stage.note = f"{len(found[0])} points to start from"
        built |= layout.models(views, *found)
    elif models:
        built |= layout.models(views, NO_POINTS, NO_POINTS)
    for name in ("", *layout.folders(views)):
        (job.folder / name).mkdir(parents=True, exist_ok=True)
    with claim(job.folder / request.shard.manifest):
        if job.files or not (job.folder / request.shard.manifest).exists():
            manifest.record()  # first: it says whose the folder is
            _write(manifest, {name: built[name] for name in job.files})
        if job.pending and draw is not None:
            _render(run, request, job, draw)
        _contact(run, job, layout, views)


def _render(run: Run, request: ViewsRequest, job: _Job, draw: Draw) -> None:
    for path in (job.folder / name for view in job.pending for name in request.layout.files(view)):
        for left in path.parent.glob(f".{path.stem}.{'[0-9a-f]' * 8}{path.suffix}"):  # by a killed run
            left.unlink(missing_ok=True)
    with run.stage("views") as stage:
        bar = run.console.bar("views")
        with ThreadPoolExecutor(1) as writer:  # compresses one view while the next is rendered
            written: Future[list[str]] = writer.submit(list)
            try:
                for done, view in enumerate(job.pending, 1):
                    image = draw(view.camera)
                    job.manifest.record(written.result())
                    written = writer.submit(_keep, job, request.layout, view, image)
                    if bar:
                        bar(done, len(job.pending))
            finally:
                job.manifest.record(written.result())
        camera = job.pending[0].camera
        stage.note = f"{len(job.pending)} views of {camera.width} x {camera.height} px in {job.folder}"


def _keep(job: _Job, layout: Layout, view: View, image: np.ndarray) -> list[str]:
    """Write a view's images, keep its thumbnail if no pixel is rounded, and return the relative paths."""
    if layout.exact:
        job.small[view.stem] = thumbnail(image, view.camera)
    return layout.write(job.folder, view, image)


def _contact(run: Run, job: _Job, layout: Layout, views: list[View]) -> None:
    """Write the contact sheet once all shards' views exist; the run that completes them does it."""
    manifest = job.manifest
    manifest.refresh()
    names = [name for view in views for name in layout.files(view)]
    if not all(manifest.complete(name, content=False) for name in names):
        run.console.message(f"{job.folder}: views of other shards are missing; the last shard writes {CONTACT}")
        return
    if job.pending or not manifest.complete(CONTACT):
        with run.stage("contact sheet"):
            write_png(job.folder / CONTACT, thumbnails(job.folder, views, layout.background, job.small), overwrite=True)
            manifest.record([CONTACT])
    job.small.clear()


def _write(manifest: Manifest, files: dict[str, bytes]) -> None:
    for name, data in files.items():
        with atomic_write(manifest.folder / name, overwrite=True) as temporary:
            temporary.write_bytes(data)
    manifest.record(files)


TOGETHER = 1 << 24  # pixels of views that are made at once


def fields_of(
    run: Run,
    source: SourceRequest,
    options: BlockOptions | None,
    functions: dict[Path, str | None],
    size: int,
    renderer: str,
    stack: ExitStack,
) -> list[Blocked] | None:
    """Return a field in blocks for each function (by folder), None if the volume is read whole; ``stack`` closes them.

    A view is ``size`` px high; ``options`` None: automatic. Raise UsageError for a ``renderer`` that needs the volume
    in memory.
    """
    options = options or automatic(source, run.console)
    if options is None:
        return None
    if renderer != "vvgt":
        raise UsageError(f"--renderer {renderer}: needs the whole volume in memory; in blocks: vvgt")
    fields = []
    for folder, tf in functions.items():
        store = stack.enter_context(store_beside(str(folder)))
        fields.append(
            stack.enter_context(blocked(run, replace(source, tf=tf), options, store, FieldNeeds(POINTS, size)))
        )
    return fields


def draw_in_blocks(
    field: Blocked, settings: RenderSettings, cameras: Sequence[Camera]
) -> Callable[[Camera], np.ndarray]:
    """Return a function that draws a volume in blocks; at most `TOGETHER` pixels of coming views at once."""
    axes = field.source.volume.axes
    left = list(cameras)

    def inside(camera: Camera) -> np.ndarray:
        if not field.pictures:
            many = max(TOGETHER // (camera.width * camera.height), 1)
            field.views.expect([Picture(to_box_frame(other, axes)[0], settings) for other in left[:many]])
            del left[:many]
        image = field.views.view(camera, settings)
        field.views.forget(Picture(camera, settings))
        return image

    return render_in_box(inside, axes)
