"""`render-views`: calibrated views of a volume for trainers, resumable and divisible into shards.

A folder of views has images, and files that describe them: transforms.json, COLMAP, points, contact sheet.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.cameras import Camera, default_views, orbit_views
from vvgt_cli.cameras.files import blender_json, colmap_model, point_cloud_ply, read_frames, transforms_json
from vvgt_cli.cameras.sets import FIELD_OF_VIEW, RADIUS, SET_VIEWS, SIZE
from vvgt_cli.cameras.types import camera_in_box, render_in_box
from vvgt_cli.conversion.manifest import Manifest, Shard, parse_shard
from vvgt_cli.conversion.opened import opened_upright, read_once
from vvgt_cli.errors import DataError, NothingVisible, UsageError
from vvgt_cli.field.blocked import Blocked
from vvgt_cli.field.digests import cameras_digest, volume_digest
from vvgt_cli.field.field import Field, Picture, Resident
from vvgt_cli.field.open import FieldNeeds, store_beside
from vvgt_cli.field.settings import BlockOptions
from vvgt_cli.field.source import SourceRequest, StyledVolume
from vvgt_cli.files import claim, write_bytes
from vvgt_cli.gaussians.outputs import check_folder
from vvgt_cli.images import as_png, coarser, contact_sheet, over, write_exr, write_png
from vvgt_cli.images.files import read_view
from vvgt_cli.jit.ahead import RAYCAST, VIEWS
from vvgt_cli.library.inputs import PathLike
from vvgt_cli.progress import Console, counted
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.version import VERSION
from vvgt_cli.volume.types import IDENTITY

if TYPE_CHECKING:
    from vvgt_cli.dvr import RenderSettings


CONTACT = "contact.png"
POINTS_FILE = "points3d.ply"  # the original 3DGS code looks for this name
POINTS = 20_000  # Gaussians of the closed form whose centres become the cloud
COARSER = 4  # that many are wider than cells for the images' own size: these would cost four times the time
THUMBNAIL = 160  # pixels along a thumbnail's edge, at most


@dataclass(frozen=True)
class View:
    """A camera and the set that it belongs to, ``train`` or ``test``."""

    split: str
    camera: Camera

    @property
    def stem(self) -> str:
        """Return the relative path of its images without suffix."""
        return f"{self.split}/{self.camera.name}"


@dataclass(frozen=True)
class Layout:
    """Files that a view is written to.

    Attributes:
        format: ``exr``, ``png`` or ``both``.
        half: EXR in 16 bits.
        background: RGB behind the opaque images for COLMAP and the contact sheet.
        points: include an initial point cloud.
    """

    format: str = "both"
    half: bool = False
    background: Sequence[float] = (0.0, 0.0, 0.0)
    points: bool = True

    def __post_init__(self) -> None:
        """Raise UsageError for 16 bits of no EXR."""
        if self.half and self.format == "png":
            raise UsageError("--half applies to EXR, which --format png does not write; give only one of the two")

    @property
    def suffix(self) -> str:
        """Return the suffix of the images that `transforms.json` names."""
        return ".exr" if self.format == "exr" else ".png"

    def stored(self, image: np.ndarray) -> np.ndarray:
        """Return a view's image (h, w, 4) float32 premultiplied as `read_view` reads it from its file."""
        return as_png(image) if self.format == "png" else image.astype(np.float16 if self.half else np.float32)

    def files(self, view: View) -> list[str]:
        """Return the relative paths of a view's images."""
        stem, names = view.stem, []
        if self.format != "png":
            names.append(f"{stem}.exr")
        if self.format != "exr":
            names.append(f"{stem}.png")
            if view.split == "train":
                names.append(f"images/{view.camera.name}.png")
        return names

    def folders(self, views: Sequence[View]) -> list[str]:
        """Return the relative paths of the folders that hold the images and the COLMAP model."""
        names = [name for view in views for name in self.files(view)]
        return sorted({name.rpartition("/")[0] for name in names} | ({"sparse/0"} if self.format != "exr" else set()))

    def write(self, folder: Path, view: View, image: np.ndarray) -> list[str]:
        """Write a view's image (h, w, 4) float32 premultiplied over existing files, and return their relative paths."""
        for name in (files := self.files(view)):
            if name.endswith(".exr"):
                write_exr(folder / name, image, half=self.half, camera=view.camera, overwrite=True)
            elif name.startswith("images/"):
                write_png(folder / name, over(image, self.background), overwrite=True)
            else:
                write_png(folder / name, image, overwrite=True)
        return files

    def descriptions(self, views: Sequence[View]) -> dict[str, bytes]:
        """Return the `transforms` files by relative path; the splits share no view."""
        train = [view for view in views if view.split == "train"]
        test = [view for view in views if view.split == "test"]
        names = {split: [view.stem + self.suffix for view in of] for split, of in (("train", train), ("test", test))}
        splits = {"train": names["train"], "val": names["test"], "test": names["test"]} if test else None
        paths = [view.stem + self.suffix for view in views]
        cameras = [view.camera for view in views]
        cloud = POINTS_FILE if self.points else None
        files = {"transforms.json": transforms_json(cameras, ply_file_path=cloud, paths=paths, splits=splits)}
        for split, of in (("train", train), ("test", test)):
            if of:
                files[f"transforms_{split}.json"] = blender_json([v.camera for v in of], [f"./{v.stem}" for v in of])
        return {name: text.encode() for name, text in files.items()}

    def models(self, views: Sequence[View], points: np.ndarray, colors: np.ndarray) -> dict[str, bytes]:
        """Return the point cloud (n, 3), and with PNG the COLMAP model of the training views, by relative path."""
        files = {POINTS_FILE: point_cloud_ply(points, colors)} if self.points else {}
        if self.format != "exr":
            train = [view.camera for view in views if view.split == "train"]
            model = colmap_model(train, [f"{camera.name}.png" for camera in train], points, colors)
            files |= {f"sparse/0/{name}": data for name, data in model.items()}
        return files

    def model_names(self) -> list[str]:
        """Return the relative paths of the files of `models`."""
        colmap = [f"sparse/0/{name}.bin" for name in ("cameras", "images", "points3D")]
        return [*([POINTS_FILE] if self.points else []), *(colmap if self.format != "exr" else [])]


def start_points(field: Field, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (unit frame) and colours of the closed form's Gaussians, (n, 3) each; none if nothing is visible.

    Views are ``size`` px high.
    """
    from vvgt_cli.closed_form import VbmOptions

    gaussians = field.pyramid(VbmOptions(POINTS, max(size // COARSER, 1))).gaussians
    half = np.array(field.source.volume.unit_frame().half)
    points = np.clip(gaussians.means.astype(np.float64), -half, half)
    return points @ field.source.volume.axes.T, np.clip(gaussians.colors, 0, 1)


def thumbnails(
    folder: Path, views: Sequence[View], background: Sequence[float], known: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Return the contact sheet of the views on disk, (H, W, 3) float32 in [0, 1], training views first.

    ``known``: some views' thumbnails, by stem.
    """
    height = max(view.camera.height // _factor(view.camera) for view in views)
    width = max(view.camera.width // _factor(view.camera) for view in views)
    tiles = []
    for view in views:
        small = known.get(view.stem)
        if small is None:
            small = coarser(read_view(folder / view.stem), _factor(view.camera))
        h, w = small.shape[:2]
        tile = np.zeros((height, width, 4), np.float32)
        top, left = (height - h) // 2, (width - w) // 2
        tile[top : top + h, left : left + w] = small
        tiles.append(tile)
    return contact_sheet(tiles, background=background)


def _factor(camera: Camera) -> int:
    """Return by how much a camera's pictures are averaged down to at most `THUMBNAIL` pixels a side."""
    return min(-(-max(camera.width, camera.height) // THUMBNAIL), camera.width, camera.height)


Draw = Callable[[Camera], np.ndarray]
NO_POINTS = np.zeros((0, 3))

SPHERE, ORBIT = "sphere", "orbit"


def camera_views(
    cameras: PathLike | Sequence[Camera], views: int | None = None, test_views: int | None = None,
    size: int | None = None, fov: float | None = None, radius: float | None = None,
) -> list[View]:  # fmt: skip
    """Return the views of a set, training views first; arguments are those of `vvgt_cli.render_views`.

    Raises:
        UsageError: options that a file or cameras decide, or no such file.
        DataError: an invalid file, or views of one name.
    """
    if cameras not in (SPHERE, ORBIT):
        given = {"--views": views, "--test-views": test_views, "--fov": fov, "--radius": radius}
        if stated := [f"{option} {value}" for option, value in given.items() if value is not None]:
            raise UsageError(f"{stated[0]}: the file of --cameras decides this; omit it")
        if isinstance(cameras, str | os.PathLike):
            return _read(os.fspath(cameras), size)
        return [View("train", camera if size is None else camera.resized(size / camera.height)) for camera in cameras]
    count, kept = (
        SET_VIEWS["train"] if views is None else views,
        SET_VIEWS["test"] if test_views is None else test_views,
    )
    lens: dict[str, Any] = {"size": size or SIZE, "fov": fov or FIELD_OF_VIEW, "radius": radius or RADIUS}
    train = default_views("train", count, **lens) if cameras == SPHERE else orbit_views(count, **lens)
    test = default_views("test", kept, **lens)
    return [View("train", camera) for camera in train] + [View("test", camera) for camera in test]


def _read(path: str, size: int | None) -> list[View]:
    if not Path(path).is_file():
        raise UsageError(f"--cameras {path}: no such file; expected sphere, orbit or a transforms.json")
    views: dict[str, View] = {}
    frames = read_frames(path, size)
    for frame in sorted(frames, key=lambda frame: frame.test):
        # the Blender style names images without a suffix, so a dot would be read as one
        name = re.sub(r"[^\w-]", "_", frame.camera.name)
        if name in views:
            raise DataError(f"{path}: two views become {name!r}; expected names that differ in letters or digits")
        views[name] = View("test" if frame.test else "train", replace(frame.camera, name=name))
    if all(frame.test for frame in frames):
        raise DataError(f"{path}: all views are test views; expected some training views")
    return list(views.values())


def folders_of(root: Path, names: Sequence[str]) -> list[Path]:
    """Return one folder for each look: in ``root``, by its name in plain characters, where there are several.

    Raises:
        UsageError: two looks of one name, or a folder that cannot be made.
    """
    check_folder(root, "views")
    if len(names) == 1:
        return [root]
    folders: dict[str, str] = {}
    for name in names:
        plain = re.sub(r"[^\w.-]+", "_", name).strip(".") or "function"
        if plain in folders:
            raise UsageError(f"functions {folders[plain]} and {name} would both go to {root / plain}; rename one")
        folders[plain] = name
    return [root / plain for plain in folders]


@dataclass(frozen=True)
class Rays:
    """How views are rendered; arguments of `vvgt_cli.render_views`."""

    renderer: str = "vvgt"
    samples: int | str = "adaptive"
    step: float = 0.5
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Raise UsageError for an unknown renderer, or samples that VTK has not."""
        if self.renderer not in ("vvgt", "vtk"):
            raise UsageError(f"--renderer {self.renderer}: expected vvgt or vtk")
        if self.renderer == "vtk" and self.samples not in ("adaptive", 1):
            raise UsageError(f"--samples {self.samples}: VTK casts one ray per pixel; omit it")


@dataclass
class _Set:
    """One function's folder and the views to render there."""

    field: Field
    manifest: Manifest
    layout: Layout
    views: list[View]
    pending: list[View]  # this part's
    files: list[str]  # of the descriptions and models that this part writes
    small: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)  # thumbnails of views that were rendered

    @property
    def folder(self) -> Path:
        return self.manifest.folder


def open_looks(
    run: Run, requests: Sequence[SourceRequest], blocks: BlockOptions | None, folders: Sequence[Path] | None,
    size: int, rays: Rays, kernels: tuple[str, ...], stack: ExitStack,
) -> list[Field]:  # fmt: skip
    """Return a volume under each of several looks, which ``stack`` closes.

    Args:
        run: times the stages.
        requests: for one volume.
        blocks: None: in blocks if the volume is large.
        folders: blocks are kept beside them, one a look; None: in a temporary folder, for one.
        size: px, height of a view.
        rays: renderer, of which "vtk" needs the volume in memory, and device.
        kernels: of `vvgt_cli.jit.ahead`, to compile on a first run.
        stack: closes what is opened.

    Raises:
        DataError: a volume or function that is not valid, or a sheared volume.
        UsageError: a renderer that needs the volume in memory.
    """
    requests, blocks = read_once(run, requests, blocks)
    if blocks is not None and rays.renderer != "vvgt":
        raise UsageError(f"--renderer {rays.renderer}: needs the whole volume in memory; in blocks: vvgt")
    fields = []
    for request, folder in zip(requests, folders or [Path()], strict=True):
        store, needs = store_beside(str(folder) if folders else None), FieldNeeds(POINTS, size)
        fields.append(stack.enter_context(opened_upright(run, request, blocks, needs, kernels, store, rays.device)))
    return fields


def prepare(field: Field, rays: Rays, cameras: Sequence[Camera]) -> Draw:
    """Return what draws a view of ``cameras``."""
    from vvgt_cli.dvr import RenderSettings

    settings = RenderSettings(rays.step, None if rays.samples == "adaptive" else int(rays.samples))
    if rays.renderer == "vtk" and isinstance(field, Resident) and cameras:
        from vvgt_cli.dvr import vtk

        return render_in_box(vtk.view_renderer(field.scene, settings), field.source.volume.axes)
    return draw_views(field, settings, cameras)


def render_looks(
    console: Console, requests: Mapping[str, SourceRequest], views: list[View], rays: Rays, blocks: BlockOptions | None,
    output: PathLike | None, shard: str, overwrite: bool, *layout: Any,
) -> tuple[list[Camera], np.ndarray | None]:  # fmt: skip
    """Return the cameras, and the images (n, h, w, 4) of one look unless they are written.

    Arguments and errors are those of `vvgt_cli.render_views`; ``layout`` are those of `Layout`.
    """
    run, part = Run(console, ConversionReport("render-views")), parse_shard(shard)
    if overwrite and part.count > 1:
        raise UsageError(
            "--overwrite with --shard: shards would remove each other's files; remove the directory instead"
        )
    cameras = [view.camera for view in views if view.split == "train" or output is not None]
    if output is not None:
        write_views(run, requests, Path(output), views, Layout(*layout), rays, part, overwrite, blocks)
        return cameras, None
    if len(requests) > 1 or len({(camera.width, camera.height) for camera in cameras}) != 1:
        raise UsageError(
            f"{len(requests)} looks, {len(cameras)} cameras; expected, without a folder to write, one look and cameras "
            "of one size"
        )
    with ExitStack() as stack:
        asked, height = list(requests.values()), cameras[0].height
        (field,) = open_looks(run, asked, blocks, None, height, rays, RAYCAST, stack)
        draw = prepare(field, rays, cameras)
        return cameras, np.stack([draw(camera) for camera in cameras])


def write_views(
    run: Run, requests: Mapping[str, SourceRequest], output: Path, views: list[View], layout: Layout,
    rays: Rays | None = None, shard: Shard | None = None, overwrite: bool = False, blocks: BlockOptions | None = None,
) -> None:  # fmt: skip
    """Render the missing views of a volume under each look, by name, into a folder, or one in it for each of several.

    Raises:
        UsageError: a folder with another run's views or unknown files, or options that do not fit.
        DataError: invalid input, or a function that shows nothing.
    """
    if not views or len({view.stem for view in views}) < len(views):
        raise UsageError(f"cameras: got {len(views)}; expected at least one, and no two of one name")
    folders, asked = folders_of(output, list(requests)), list(requests.values())
    rays, shard = rays or Rays(), shard or Shard()
    with ExitStack() as stack:
        kernels = VIEWS if layout.points else RAYCAST
        fields = open_looks(run, asked, blocks, folders, views[0].camera.height, rays, kernels, stack)
        with run.stage("plan") as stage:
            sets = _plan(fields, folders, views, layout, rays, shard, overwrite)
            total = sum(len(one.pending) for one in sets)
            stage.note = f"{len(sets) * len(views)} views, {total} to render here"
        for one in sets:
            _work(run, one, rays)
            if isinstance(one.field, Blocked):
                one.field.run_pass.store.remove()
            vars(one.field).pop("scene", None)  # an optics grid takes 20 bytes a voxel and more


def _settings(layout: Layout, rays: Rays, views: Sequence[View], source: StyledVolume, content: str) -> dict[str, Any]:
    """Return everything that the files depend on, named as on the command line."""
    cameras = {split: [view.camera for view in views if view.split == split] for split in ("train", "test")}
    sizes = dict.fromkeys(f"{view.camera.width} x {view.camera.height}" for view in views)
    return {
        "version": VERSION,
        "volume": content,
        "function": source.look(),
        "opacity_unit_distance": source.unit_distance,
        **({} if source.lighting is None else {"light": source.lighting.key()}),
        "views": len(cameras["train"]),
        "test_views": len(cameras["test"]),
        "size": ", ".join(sizes),
        "cameras": cameras_digest(cameras["train"] + cameras["test"]),
        **({} if source.volume.direction == IDENTITY else {"direction": list(source.volume.direction)}),
        "renderer": rays.renderer,
        "samples": 1 if rays.renderer == "vtk" else rays.samples,
        "step": rays.step,
        "format": layout.format,
        "half": layout.half,
        "background": list(layout.background),
        **({} if layout.points else {"points": False}),
    }


def _plan(
    fields: list[Field], folders: Sequence[Path], views: list[View], layout: Layout, rays: Rays, shard: Shard,
    overwrite: bool,
) -> list[_Set]:  # fmt: skip
    """Find what is missing in every folder, before anything is written."""
    content = volume_digest(fields[0].source.volume)
    sets = []
    for i, (folder, field) in enumerate(zip(folders, fields, strict=True)):
        manifest = Manifest(folder, _settings(layout, rays, views, field.source, content), shard)
        files = [*layout.descriptions(views), *layout.model_names()]
        planned = [name for view in views for name in layout.files(view)]
        manifest.open([*planned, *files, CONTACT], overwrite)
        mine = [view for j, view in enumerate(views) if shard.holds(i * len(views) + j)]
        pending = [view for view in mine if not all(map(manifest.complete, layout.files(view)))]
        # the first part describes the set
        missing = [name for name in files if shard.index == 1 and not manifest.complete(name)]
        sets.append(_Set(field, manifest, layout, views, pending, missing))
    return sets


def _work(run: Run, one: _Set, rays: Rays) -> None:
    """Make what is missing in one function's folder; whatever may fail early runs before the first write."""
    manifest, layout, views = one.manifest, one.layout, one.views
    built = layout.descriptions(views)
    models = any(name not in built for name in one.files)
    draw = prepare(one.field, rays, [view.camera for view in one.pending])
    if models and layout.points:
        with run.stage("points") as stage:
            cloud = start_points(one.field, views[0].camera.height)
            if not len(cloud[0]):
                raise NothingVisible(one.field.source.volume.name, one.field.source.tf.name)
            stage.note = f"{len(cloud[0])} points to start from"
        built |= layout.models(views, *cloud)
    elif models:
        built |= layout.models(views, NO_POINTS, NO_POINTS)
    for name in ("", *layout.folders(views)):
        (one.folder / name).mkdir(parents=True, exist_ok=True)
    own = one.folder / manifest.shard.manifest
    with claim(own):
        if one.files or not own.exists():
            manifest.record()  # first: it says whose the folder is
            _write(manifest, {name: built[name] for name in one.files})
        if one.pending:
            _render(run, one, draw)
        _contact(run, one)


def _render(run: Run, one: _Set, draw: Draw) -> None:
    for path in (one.folder / name for view in one.pending for name in one.layout.files(view)):
        for left in path.parent.glob(f".{path.stem}.{'[0-9a-f]' * 8}{path.suffix}"):  # by a killed run
            left.unlink(missing_ok=True)
    with run.stage("views") as stage:
        with ThreadPoolExecutor(1) as writer:  # compresses one view while the next is rendered
            written: Future[list[str]] = writer.submit(list)
            try:
                for view in counted(one.pending, run.console.bar("views")):
                    image = draw(view.camera)
                    one.manifest.record(written.result())
                    written = writer.submit(_keep, one, view, image)
            finally:
                one.manifest.record(written.result())
        camera = one.pending[0].camera
        stage.note = f"{len(one.pending)} views of {camera.width} x {camera.height} px in {one.folder}"


def _keep(one: _Set, view: View, image: np.ndarray) -> list[str]:
    """Write a view's images, keep its thumbnail, and return the relative paths."""
    one.small[view.stem] = coarser(one.layout.stored(image).astype(np.float32), _factor(view.camera))
    return one.layout.write(one.folder, view, image)


def _contact(run: Run, one: _Set) -> None:
    """Write the contact sheet once all shards' views exist; the run that completes them does it."""
    manifest, layout, views = one.manifest, one.layout, one.views
    manifest.refresh()
    names = [name for view in views for name in layout.files(view)]
    if not all(manifest.complete(name, content=False) for name in names):
        run.console.message(f"{one.folder}: views of other shards are missing; the last shard writes {CONTACT}")
        return
    if one.pending or not manifest.complete(CONTACT):
        with run.stage("contact sheet"):
            write_png(one.folder / CONTACT, thumbnails(one.folder, views, layout.background, one.small), overwrite=True)
            manifest.record([CONTACT])
    one.small.clear()


def _write(manifest: Manifest, files: dict[str, bytes]) -> None:
    for name, data in files.items():
        write_bytes(manifest.folder / name, data, overwrite=True)
    manifest.record(files)


TOGETHER = 1 << 24  # pixels of views that are made at once, at most, of a volume in blocks


def draw_views(field: Field, settings: RenderSettings, cameras: Sequence[Camera]) -> Draw:
    """Return a function that draws views of ``cameras`` in their order; one in blocks several of them at once."""
    axes, left, ahead = field.source.volume.axes, list(cameras), 0

    def inside(camera: Camera) -> np.ndarray:
        nonlocal ahead
        if not ahead:
            ahead = max(TOGETHER // (camera.width * camera.height), 1)
            field.views.expect([Picture(camera_in_box(other, axes)[0], settings) for other in left[:ahead]])
            del left[:ahead]
        ahead -= 1
        image = field.views.view(camera, settings)
        field.views.forget(Picture(camera, settings))
        return image

    return render_in_box(inside, axes)
