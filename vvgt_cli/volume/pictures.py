"""PNG, BMP and JPEG: one slice each, with the numbers that they store, decoded by OpenImageIO."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.components import select_component
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import Reader, register, volume_name
from vvgt_cli.volume.types import Volume

KINDS = {"png": (".png",), "bmp": (".bmp",), "jpeg": (".jpg", ".jpeg")}
SUFFIXES = tuple(suffix for suffixes in KINDS.values() for suffix in suffixes)
_SAMPLED = 9  # pictures of a stack that tell whether it is in colour
_MAGIC = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")


def read_pixels(path: Path) -> np.ndarray:
    """Return the pixels of a picture, (rows, columns, samples) uint8 or uint16, turned as its Exif orientation says.

    Palettes are expanded, and greys of 1, 2 or 4 bits scaled to 8 (PNG 13.12). There is no colour management, and colours
    are not multiplied by opacity. The fourth byte of a BMP's pixels, which few programs fill, is dropped.

    Raises:
        DataError: no picture, or a damaged one; not enough memory.
    """
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    config.attribute("oiio:RawColor", 1)
    image = oiio.ImageInput.open(str(path), config)
    kind = image.format_name() if image is not None else ""
    if image is None or kind not in KINDS:
        text = " ".join(oiio.geterror().split())[:200] or f"content of kind {kind}"
        raise DataError(f"{path}: cannot be read as PNG, BMP or JPEG ({text}); check that it is whole")
    spec = image.spec()
    check_memory(spec.image_bytes(), str(path))
    pixels = image.read_image(0, 0, 0, spec.nchannels, spec.format)
    error = " ".join(image.geterror().split())[:200]
    image.close()
    if pixels is None or error:  # of JPEG that is cut short, the rest is grey
        raise DataError(f"{path}: damaged {kind.upper()} picture ({error}); check that it is whole")
    pixels = pixels.reshape(spec.height, spec.width, spec.nchannels)
    turn = spec.get_int_attribute("Orientation", 1)
    pixels = pixels.swapaxes(0, 1) if turn > 4 else pixels
    pixels = pixels[:: -1 if turn in (3, 4, 7, 8) else 1, :: -1 if turn in (2, 3, 6, 7) else 1]
    return pixels[..., :3] if kind == "bmp" else pixels


def picture_planes(files: list[Path], options: ReadOptions, source: str) -> Callable[[Path], np.ndarray]:
    """Return what reads one of the pictures of a stack as (1, y, x).

    A stack has as many components as the richest of a few of its pictures: one if red, green and blue are equal; opacity
    counts if a pixel is not opaque.

    Raises:
        DataError: a damaged picture.
        UsageError: colours and no component chosen (`SeveralComponents`).
    """
    picks = {files[round(k * (len(files) - 1) / (_SAMPLED - 1))] for k in range(_SAMPLED)}
    count = max(_simplest(read_pixels(path)).shape[2] for path in picks)

    def plane(path: Path) -> np.ndarray:
        pixels = read_pixels(path)
        if count == 1:
            pixels = _simplest(pixels)
        elif pixels.shape[2] == 1:
            pixels = np.repeat(pixels, min(count, 3), axis=2)
        if pixels.shape[2] == 3 and count == 4:
            pixels = np.dstack([pixels, np.full_like(pixels[..., :1], np.iinfo(pixels.dtype).max)])
        if pixels.shape[2] < count or (count == 1 and pixels.shape[2] > 1):
            raise DataError(
                f"{path}: {pixels.shape[2]} components; expected {count}, as other pictures of {source} have; convert "
                "it to their kind, or leave it out"
            )
        return select_component(pixels[None, ..., :count], options.component, source, color=True)[0]

    return plane


def _simplest(pixels: np.ndarray) -> np.ndarray:
    """Return pixels without opacity that is full everywhere, and as grey if red, green and blue are equal."""
    if pixels.shape[2] in (2, 4) and (pixels[..., -1] == np.iinfo(pixels.dtype).max).all():
        pixels = pixels[..., :-1]
    return pixels[..., :1] if pixels.shape[2] == 3 and (pixels[..., 1:] == pixels[..., :1]).all() else pixels


def read_picture(path: Path, options: ReadOptions) -> Volume:
    """Read one picture as a volume of one slice, as one page of TIFF is.

    Raises:
        DataError, UsageError: as `picture_planes`.
    """
    plane = picture_planes([path], options, str(path))(path)
    return Volume(plane, options.spacing_or((1.0, 1.0, 1.0)), name=volume_name(path))


register(Reader("picture", SUFFIXES, lambda head: head.startswith(_MAGIC), read_picture, by_name=True))
