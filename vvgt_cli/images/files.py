"""Pictures in files: OpenEXR (premultiplied float RGBA, with the camera in the header), 8-bit PNG, and view sets."""

from __future__ import annotations

import contextlib
import json
import struct
import zlib
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.cameras.files import read_frames
from vvgt_cli.cameras.types import Camera
from vvgt_cli.errors import DataError
from vvgt_cli.files import atomic_write, write_bytes
from vvgt_cli.volume.blocks import check_memory

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
    """Read the image at ``path`` (with or without .exr or .png), EXR or else PNG: (h, w, 4) float32 premultiplied.

    Raise DataError if there is none, or it cannot be read.
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
            raise DataError(f"{path}: cannot be written ({' '.join(str(error).split())})") from error


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
        why = " ".join(str(error).split())
        raise DataError(f"{path}: not a readable EXR image ({why}); expected channels R, G, B, A") from error
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


MAX_PIXELS = 2**28  # 16384 x 16384, because a damaged header may claim anything
RADIANCE_BYTES = 72  # a pixel of light, with sums over it
MAX_PIXELS_PER_BYTE = 2**14  # more than deflate can reach for one-bit pixels


def check_pixels(path: str | PathLike[str], width: int, height: int) -> None:
    """Raise DataError if an image is too large for its file, or larger than 2^28 pixels."""
    size = Path(path).stat().st_size
    if width < 1 or height < 1 or width * height > min(MAX_PIXELS, MAX_PIXELS_PER_BYTE * size):
        raise DataError(f"{path}: claims {width} x {height} pixels in {size} bytes; expected a whole image, up to 2^28")


def write_png(path: str | PathLike[str], image: np.ndarray, overwrite: bool = False) -> None:
    """Write an image as 8-bit PNG; no gamma is applied.

    Args:
        path: the file, which is written atomically.
        image: (h, w, 3) RGB or (h, w, 4) *premultiplied* RGBA, in [0, 1] (clipped; NaN becomes 0). PNG stores
            straight alpha, so colours are divided by alpha.
        overwrite: replace an existing file.

    Raises:
        DataError: the shape is wrong, or the file cannot be written.
        UsageError: the file exists and ``overwrite`` is not set.
    """
    write_bytes(path, png_bytes(image), overwrite)


def png_bytes(image: np.ndarray) -> bytes:
    """Encode an image as PNG in memory, for notebooks and browsers; see `write_png`.

    Runs of differences from the mean of the pixels to the left and above are as small as zlib's level 3, and packed
    sooner (docs/log/renderer.md).
    """
    pixels = _bytes(image)
    height, width, channels = pixels.shape
    left, above = np.zeros_like(pixels), np.zeros_like(pixels)
    left[:, 1:], above[1:] = pixels[:, :-1], pixels[:-1]
    rows = np.full((height, 1 + width * channels), 3, np.uint8)  # the filter's number, before each row
    rows[:, 1:] = (pixels - ((left & above) + ((left ^ above) >> 1))).reshape(height, -1)
    packer = zlib.compressobj(strategy=zlib.Z_RLE)
    header = struct.pack(">2I5B", width, height, 8, 2 if channels == 3 else 6, 0, 0, 0)
    chunks = {b"IHDR": header, b"sRGB": b"\3", b"IDAT": packer.compress(rows.data) + packer.flush(), b"IEND": b""}
    parts = ((struct.pack(">I", len(data)), kind + data) for kind, data in chunks.items())
    return b"\x89PNG\r\n\x1a\n" + b"".join(size + part + struct.pack(">I", zlib.crc32(part)) for size, part in parts)


def as_png(image: np.ndarray) -> np.ndarray:
    """Return an image (h, w, 3 or 4) as `read_png` reads what `write_png` writes of it, float32 in [0, 1]."""
    pixels = _bytes(image) * np.float32(1 / 255)
    if pixels.shape[2] == 4:
        pixels[..., :3] *= pixels[..., 3:]
    return pixels


def read_png(path: str | PathLike[str]) -> np.ndarray:
    """Read a PNG: (h, w, 3) RGB or (h, w, 4) premultiplied RGBA, float32 in [0, 1].

    Grey images are returned as RGB(A). Division and multiplication by alpha are exact to half an 8-bit step.

    Raises:
        DataError: the file is not a PNG, or larger than 2^28 pixels.
    """
    import OpenImageIO as oiio

    if not Path(path).is_file():
        raise DataError(f"{path}: no such file; expected a PNG image")
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise DataError(f"{path}: not an image ({oiio.geterror().splitlines()[0]}); expected a PNG")
    if (kind := source.format_name()) != "png":
        raise DataError(f"{path}: an image of format {kind}; expected a PNG")
    pixels = _pixels(source, path, "PNG")
    if pixels.shape[-1] <= 2:
        pixels = np.concatenate([np.repeat(pixels[..., :1], 3, axis=-1), pixels[..., 1:]], axis=-1)
    if pixels.shape[-1] == 4:
        pixels[..., :3] *= pixels[..., 3:]
    return pixels


def _bytes(image: np.ndarray) -> np.ndarray:
    """Convert an image to (h, w, 3 or 4) uint8 with straight alpha."""
    image = np.asarray(image, dtype=np.float32)
    if image.ndim != 3 or image.shape[2] not in (3, 4) or 0 in image.shape:
        raise DataError(f"image of shape {image.shape}; expected (height, width, 3) or (height, width, 4)")
    image = np.fmin(np.fmax(image, 0), 1)  # NaN becomes 0
    if image.shape[2] == 4:
        image[..., :3] /= np.where(image[..., 3:] > 0, image[..., 3:], np.inf)
    return np.rint(255 * np.minimum(image, 1)).astype(np.uint8)


def read_radiance(path: str | PathLike[str]) -> np.ndarray:
    """Read a picture of light, ``.hdr`` or ``.exr``: (h, w, 3) float32, linear; grey ones as red, green and blue.

    Raises:
        DataError: no such picture, a damaged one, or one larger than 2^28 pixels.
    """
    import OpenImageIO as oiio

    source = oiio.ImageInput.open(str(path)) if Path(path).is_file() else None
    if source is None:
        reason = oiio.geterror().splitlines() or ["no such file"]
        raise DataError(f"{path}: cannot be read ({reason[0]}); expected a picture of light, .hdr or .exr")
    pixels = _pixels(source, path, "picture", RADIANCE_BYTES)
    return pixels[..., :3] if pixels.shape[-1] >= 3 else np.repeat(pixels[..., :1], 3, axis=-1)


def _pixels(source: Any, path: str | PathLike[str], what: str, each: int = 0) -> np.ndarray:
    """Return the pixels (h, w, c) float32 of an open image, for which memory must have ``each`` bytes, and close it."""
    with contextlib.closing(source):
        spec = source.spec()
        check_pixels(path, spec.width, spec.height)
        check_memory(each * spec.width * spec.height, str(path), "try a smaller picture")
        pixels = source.read_image("float")
        if pixels is None:
            why = " ".join(source.geterror().split())
            raise DataError(f"{path}: damaged {what} ({why}); expected a complete one")
    return np.asarray(pixels, np.float32).reshape(spec.height, spec.width, spec.nchannels)
