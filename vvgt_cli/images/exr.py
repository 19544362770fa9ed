"""Reading and writing OpenEXR: premultiplied float RGBA, with the camera in the header."""

from __future__ import annotations

import json
from dataclasses import asdict
from os import PathLike
from typing import Any

import numpy as np

from vvgt_cli.cameras.types import Camera
from vvgt_cli.errors import DataError
from vvgt_cli.images.files import read_picture, write_picture

CAMERA_ATTRIBUTE = "vvgt.camera"  # a JSON string, because EXR's matrix attributes are only float32
CHANNELS = ("R", "G", "B", "A")
WRITTEN = "1970:01:01 00:00:00"  # for OpenImageIO's DateTime, by default the time of writing: same image, same bytes


def write_exr(
    path: str | PathLike[str],
    rgba: np.ndarray,
    *,
    half: bool = False,
    camera: Camera | None = None,
    overwrite: bool = False,
) -> None:
    """Write channels R, G, B, A, ZIP-compressed; float32 values are preserved exactly.

    Args:
        path: the file, which is written atomically.
        rgba: (h, w, 4) premultiplied.
        half: write 16-bit floats.
        camera: camera for the header attribute ``vvgt.camera``: a JSON object with ``rotation`` (3 x 3,
            world to camera, OpenCV axes), ``translation`` (3), ``fx fy cx cy`` (pixels), ``width height name``.
        overwrite: replace an existing file.

    Raises:
        DataError: the shape is wrong, the camera has another size, or the file cannot be written.
        UsageError: the file exists and ``overwrite`` is not set.
    """
    pixels = np.ascontiguousarray(rgba, dtype=np.float16 if half else np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != 4 or 0 in pixels.shape:
        raise DataError(f"image of shape {pixels.shape}; expected (height, width, 4)")
    attributes = {"compression": "zip", "DateTime": WRITTEN}
    if camera is not None:
        if (camera.height, camera.width) != pixels.shape[:2]:
            raise DataError(
                f"camera {camera.name} is {camera.width} x {camera.height} px, the image "
                f"{pixels.shape[1]} x {pixels.shape[0]}; expected the same"
            )
        attributes[CAMERA_ATTRIBUTE] = json.dumps(asdict(camera), default=lambda array: array.tolist())
    write_picture(path, "exr", pixels, attributes, overwrite)


def read_exr(path: str | PathLike[str]) -> tuple[np.ndarray, Camera | None]:
    """Read channels R, G, B, A (opaque if A is missing) and the camera, if the header has one.

    Returns:
        (rgba, camera): (h, w, 4) premultiplied float32, and the camera or None.

    Raises:
        DataError: the file is not an EXR image or has more than 2^28 pixels, channels are missing, subsampled or
            integers, or the camera is not valid.
    """
    pixels, spec = read_picture(path, "openexr", "an EXR image")
    names = spec.channelnames
    if not set(CHANNELS[:3]) <= set(names) or "uint" in (str(spec.format), *map(str, spec.channelformats)):
        raise DataError(f"{path}: channels {', '.join(sorted(names))}; expected R, G, B, A, floats")
    rgba = np.ones((*pixels.shape[:2], 4), dtype=np.float32)
    for i, name in enumerate(CHANNELS):
        if name in names:
            rgba[..., i] = pixels[..., names.index(name)]
    return rgba, _camera_of(spec.getattribute(CAMERA_ATTRIBUTE), path)


def _camera_of(text: Any, path: str | PathLike[str]) -> Camera | None:
    """Parse the camera of a header attribute, None if there is none."""
    if text is None:
        return None
    try:
        return Camera(**json.loads(text))
    except (TypeError, ValueError, KeyError, RecursionError) as error:
        raise DataError(f"{path}: header attribute {CAMERA_ATTRIBUTE}; expected a camera ({error})") from error
