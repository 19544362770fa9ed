"""Layout of a folder of views, and the files that describe it: transforms.json, COLMAP, points, contact sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.cameras.files import blender_json, colmap_model, point_cloud_ply, transforms_json
from vvgt_cli.errors import UsageError
from vvgt_cli.images import contact_sheet, over, write_exr, write_png
from vvgt_cli.images.files import read_view
from vvgt_cli.look.function import TransferFunctionLike

if TYPE_CHECKING:
    from vvgt_cli.dvr import Scene
    from vvgt_cli.field.field import Field

CONTACT = "contact.png"
POINTS_FILE = "points3d.ply"  # the original 3DGS code looks for this name
POINTS = 20_000  # Gaussians of the closed form whose centres become the cloud
COARSER = 4  # that many are wider than cells for the images' own size: these would cost four times the time
POINT_VIEWS, POINT_VIEW_SIZE = 12, 80  # that decide what is seen
POINT_GRID = 128  # voxels along the longest edge, at least, that the cloud is made of
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

    @property
    def exact(self) -> bool:
        """Return whether a view's pixels are stored as they were rendered."""
        return self.format != "png" and not self.half

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


def start_points(scene: Scene, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (unit frame) and colours of the closed form's Gaussians, (n, 3) each; none if nothing is visible.

    Views are ``size`` px high. Large volumes are subsampled along each axis: the points lie much farther apart than
    voxels.
    """
    from vvgt_cli.closed_form.closed_form import closed_form

    cameras = default_views("train", POINT_VIEWS, size=POINT_VIEW_SIZE)
    shape = np.array(scene.values.shape[::-1])
    every = np.minimum(max(shape.max() // POINT_GRID, 1), shape)
    coarse = _thinned(scene, every)
    gaussians = closed_form(coarse, POINTS, max(size // COARSER, 1), cameras).gaussians()
    means = (gaussians.means + coarse.half) / coarse.step * every * scene.step - scene.half
    if not len(gaussians):  # what is thinner than these views' pixels, or lies between the voxels that were taken
        gaussians = closed_form(scene, POINTS, size).gaussians()
        means = gaussians.means.astype(np.float64)
    return np.clip(means, -scene.half, scene.half) @ scene.volume.axes.T, np.clip(gaussians.colors, 0, 1)


def field_points(field: Field, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the `start_points` of a volume in blocks."""
    from vvgt_cli.closed_form import VbmOptions

    gaussians = field.pyramid(VbmOptions(POINTS, size)).gaussians
    half = np.array(field.source.volume.unit_frame().half)
    points = np.clip(gaussians.means.astype(np.float64), -half, half)
    return points @ field.source.volume.axes.T, np.clip(gaussians.colors, 0, 1)


def _thinned(scene: Scene, every: np.ndarray) -> Scene:
    """Return the scene of every ``every``-th voxel (x, y, z), the middle one of each group."""
    if every.max() == 1:
        return scene
    volume, data = scene.volume, scene.volume.data if scene.grid is None else scene.grid
    for axis, (n, step) in enumerate(zip(volume.data.shape, every[::-1], strict=True)):
        data = np.take(data, np.minimum(np.arange(step // 2, n + step // 2, step), n - 1), axis)
    x, y, z = (float(length) for length in volume.spacing * every)
    if scene.grid is not None:
        volume, world = replace(volume, data=data[..., 3], spacing=(x, y, z)), np.float32(volume.unit_frame().scale)
        return type(scene).of_grid(volume, scene.tf, scene.unit_distance, data * world, scene.lighting, scene.labels)
    volume, tf = replace(volume, data=data, spacing=(x, y, z)), cast(TransferFunctionLike, scene.tf)
    return type(scene).build(volume, tf, scene.unit_distance, lighting=scene.lighting)


def thumbnail(image: np.ndarray, camera: Camera) -> np.ndarray:
    """Return a camera's ``image`` (h, w, 4) float32, averaged down to at most `THUMBNAIL` pixels a side."""
    factor = _factor(camera)
    h, w = image.shape[0] // factor, image.shape[1] // factor
    small: np.ndarray = image[: h * factor, : w * factor].reshape(h, factor, w, factor, 4).mean(axis=(1, 3))
    return small


def thumbnails(
    folder: Path, views: Sequence[View], background: Sequence[float], known: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Return the contact sheet of the views on disk, (H, W, 3) float32 in [0, 1], training views first.

    ``known``: some views' thumbnails, by stem.
    """
    height = max(_shrunk(view.camera.height, view.camera) for view in views)
    width = max(_shrunk(view.camera.width, view.camera) for view in views)
    tiles = []
    for view in views:
        small = known.get(view.stem)
        if small is None:
            small = thumbnail(read_view(folder / view.stem), view.camera)
        h, w = small.shape[:2]
        tile = np.zeros((height, width, 4), np.float32)
        top, left = (height - h) // 2, (width - w) // 2
        tile[top : top + h, left : left + w] = small
        tiles.append(tile)
    return contact_sheet(tiles, background=background)


def _factor(camera: Camera) -> int:
    return min(-(-max(camera.width, camera.height) // THUMBNAIL), camera.width, camera.height)


def _shrunk(pixels: int, camera: Camera) -> int:
    return pixels // _factor(camera)
