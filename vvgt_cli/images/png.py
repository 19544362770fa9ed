"""Reading and writing 8-bit PNG through OpenImageIO."""

from __future__ import annotations

import tempfile
from os import PathLike
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.files import atomic_write

MAX_PIXELS = 2**28  # 16384 x 16384, because a damaged header may claim anything
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
    import OpenImageIO as oiio

    pixels = _bytes(image)
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT8)
    spec.attribute("oiio:UnassociatedAlpha", 1)  # alpha is straight already: the writer must not divide again
    spec.attribute("oiio:ColorSpace", "sRGB")
    spec.attribute("png:compressionLevel", 3)
    with atomic_write(path, overwrite) as temporary:
        output = oiio.ImageOutput.create("png")
        if output is None or not output.open(str(temporary), spec):
            raise DataError(f"{path}: cannot be written ({output.geterror() if output else oiio.geterror()})")
        written = output.write_image(pixels)
        if not (output.close() and written):
            raise DataError(f"{path}: cannot be written ({output.geterror()})")


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
    import OpenImageIO as oiio

    if not Path(path).is_file():
        raise DataError(f"{path}: no such file; expected a PNG image")
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise DataError(f"{path}: not an image ({oiio.geterror().splitlines()[0]}); expected a PNG")
    try:
        spec, kind = source.spec(), source.format_name()
        if kind != "png":
            raise DataError(f"{path}: an image of format {kind}; expected a PNG")
        check_pixels(path, spec.width, spec.height)
        pixels = source.read_image(oiio.FLOAT)
        if pixels is None:
            raise DataError(f"{path}: damaged PNG ({source.geterror().strip()}); expected a complete one")
    finally:
        source.close()
    pixels = np.asarray(pixels, dtype=np.float32).reshape(spec.height, spec.width, spec.nchannels)
    if spec.nchannels <= 2:
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
