"""Reading view sets: images with their cameras (docs/commands/render-views.md)."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np

from vvgt_cli.cameras.files import read_frames
from vvgt_cli.cameras.types import Camera
from vvgt_cli.errors import DataError
from vvgt_cli.images.exr import read_exr
from vvgt_cli.images.png import read_png

SUFFIXES = (".exr", ".png")  # the first that exists is read


def load_views(directory: str | PathLike[str], split: str = "train") -> tuple[list[Camera], np.ndarray]:
    """Read cameras and images of ``transforms_SPLIT.json`` in a folder written by `vvgt render-views`.

    EXR is preferred to PNG, whose 8 bits round colours and alpha.

    Args:
        directory: the folder.
        split: ``train`` or ``test``.

    Returns:
        (cameras, images): n cameras in the unit frame, and (n, h, w, 4) float32 premultiplied RGBA.

    Raises:
        DataError: there is no such split, an image is missing, damaged or not of its camera's size, or sizes differ.
    """
    folder = Path(directory)
    path = folder / f"transforms_{split}.json"
    if not path.is_file():
        raise DataError(f"{path}: no such file; expected a folder that 'vvgt render-views' wrote")
    frames = read_frames(path)
    cameras = [frame.camera for frame in frames]
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        shown = ", ".join(f"{width} x {height}" for width, height in sizes[:4])
        raise DataError(f"{path}: views of {len(sizes)} sizes ({shown}); expected one")
    width, height = sizes[0]
    images = np.empty((len(frames), height, width, 4), np.float32)
    for image, frame in zip(images, frames, strict=True):
        read = read_view(folder / frame.file_path)
        if read.shape != image.shape:
            raise DataError(
                f"{folder / frame.file_path}: {read.shape[1]} x {read.shape[0]} px; expected {width} x {height}, as in "
                f"{path.name}"
            )
        image[:] = read
    return cameras, images


def read_view(path: str | PathLike[str]) -> np.ndarray:
    """Read the image at ``path`` (with or without a suffix), EXR or else PNG: (h, w, 4) float32 premultiplied.

    Raises:
        DataError: the image is missing or damaged.
    """
    stem = Path(path)
    if stem.suffix in SUFFIXES:
        stem = stem.with_suffix("")
    for suffix in SUFFIXES:
        file = stem.with_name(stem.name + suffix)
        if file.is_file():
            image = read_exr(file)[0] if suffix == ".exr" else read_png(file)
            opaque = np.ones_like(image[..., :1])
            return image if image.shape[2] == 4 else np.concatenate([image, opaque], axis=-1)
    raise DataError(f"{stem}: no such image; expected {' or '.join(stem.name + suffix for suffix in SUFFIXES)}")
