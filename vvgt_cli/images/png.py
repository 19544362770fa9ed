"""Reading and writing 8-bit PNG through OpenImageIO."""

from __future__ import annotations

import tempfile
from os import PathLike
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.images.files import read_picture, write_picture


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
    # alpha is straight already: the writer must not divide again
    attributes = {"oiio:UnassociatedAlpha": 1, "oiio:ColorSpace": "sRGB", "png:compressionLevel": 3}
    write_picture(path, "png", _bytes(image), attributes, overwrite)


def png_bytes(image: np.ndarray) -> bytes:
    """Encode an image as PNG in memory, for notebooks and browsers; see `write_png`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image.png"
        write_png(path, image)
        return path.read_bytes()


def read_png(path: str | PathLike[str]) -> np.ndarray:
    """Read a PNG: (h, w, 3) RGB or (h, w, 4) premultiplied RGBA, float32 in [0, 1].

    Grey images are returned as RGB(A). Division and multiplication by alpha are exact to half an 8-bit step.

    Raises:
        DataError: the file is not a PNG, or larger than 2^28 pixels.
    """
    pixels, _ = read_picture(path, "png", "a PNG")
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
    image = np.clip(np.nan_to_num(image, nan=0.0), 0, 1)
    if image.shape[2] == 4:
        alpha = image[..., 3:]
        straight = np.divide(image[..., :3], alpha, out=np.zeros_like(image[..., :3]), where=alpha > 0)
        image = np.concatenate([np.minimum(straight, 1), alpha], axis=-1)
    return np.ascontiguousarray(np.rint(image * 255).astype(np.uint8))
