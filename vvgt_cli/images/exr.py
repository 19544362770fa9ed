"""Reading and writing OpenEXR: premultiplied float RGBA, with the camera in the header."""

from __future__ import annotations

import json
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.cameras.types import Camera
from vvgt_cli.errors import DataError
from vvgt_cli.files import atomic_write
from vvgt_cli.images.png import check_pixels

CAMERA_ATTRIBUTE = "vvgt.camera"  # a JSON string, because EXR's matrix attributes are only float32
CHANNELS = ("R", "G", "B", "A")


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
    import OpenEXR

    pixels = np.ascontiguousarray(rgba, dtype=np.float16 if half else np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != 4 or 0 in pixels.shape:
        raise DataError(f"image of shape {pixels.shape}; expected (height, width, 4)")
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if camera is not None:
        if (camera.height, camera.width) != pixels.shape[:2]:
            raise DataError(
                f"camera {camera.name} is {camera.width} x {camera.height} px, the image "
                f"{pixels.shape[1]} x {pixels.shape[0]}; expected the same"
            )
        header[CAMERA_ATTRIBUTE] = json.dumps(asdict(camera), default=lambda array: array.tolist())
    with atomic_write(path, overwrite) as temporary:
        try:
            OpenEXR.File(header, {"RGBA": pixels}).write(str(temporary))
        except RuntimeError as error:
            raise DataError(f"{path}: cannot be written ({error})") from error


def read_exr(path: str | PathLike[str]) -> tuple[np.ndarray, Camera | None]:
    """Read channels R, G, B, A (opaque if A is missing) and the camera, if the header has one.

    Returns:
        (rgba, camera): (h, w, 4) premultiplied float32, and the camera or None.

    Raises:
        DataError: the file is not an EXR image or has more than 2^28 pixels, channels are missing or subsampled, or the
            camera is not valid.
    """
    import OpenEXR

    if not Path(path).is_file():
        raise DataError(f"{path}: no such file; expected an EXR image")
    try:
        header = OpenEXR.File(str(path), header_only=True).header()
        low, high = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
        width, height = (int(n) for n in high - low + 1)
        check_pixels(path, width, height)
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: not a readable EXR image ({error}); expected channels R, G, B, A") from error
    missing = [name for name in CHANNELS[:3] if name not in channels]
    if missing:
        raise DataError(f"{path}: channels {', '.join(sorted(channels))}; expected R, G, B, A")
    rgba = np.ones((height, width, 4), dtype=np.float32)
    for i, name in enumerate(CHANNELS):
        if name in channels:
            plane = channels[name].pixels
            if plane is None or plane.shape != (height, width):
                raise DataError(f"{path}: channel {name} is subsampled; expected {width} x {height} samples")
            rgba[..., i] = plane
    return rgba, _camera_of(header.get(CAMERA_ATTRIBUTE), path)


def _camera_of(text: Any, path: str | PathLike[str]) -> Camera | None:
    """Parse the camera of a header attribute, None if there is none."""
    if text is None:
        return None
    try:
        return Camera(**json.loads(text))
    except (TypeError, ValueError, KeyError, RecursionError) as error:
        raise DataError(f"{path}: header attribute {CAMERA_ATTRIBUTE}; expected a camera ({error})") from error
