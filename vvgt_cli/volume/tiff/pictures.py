"""PNG, BMP and JPEG as slices: the numbers that they store, decoded by OpenImageIO."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.components import select_component
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.tiff import KINDS

_SAMPLED = 9  # pictures of a stack that tell whether it is in colour


def picture_planes(files: list[Path], options: ReadOptions, source: str) -> Callable[[Path], np.ndarray]:
    """Return what reads one of the pictures of a stack as (1, y, x).

    Their components are those of the richest of a few of them: red, green and blue that are equal count as one, and
    opacity as none if it is full.

    Raises:
        DataError: a damaged picture, or one with more components than those few.
        UsageError: colours and no component chosen (`SeveralComponents`).
    """
    picks = {files[round(k * (len(files) - 1) / (_SAMPLED - 1))] for k in range(_SAMPLED)}
    count = max(_simplest(read_pixels(path)).shape[2] for path in picks)

    def plane(path: Path) -> np.ndarray:
        pixels = read_pixels(path) if count > 1 else _simplest(read_pixels(path))
        pixels = np.repeat(pixels, count, axis=2) if pixels.shape[2] == 1 else pixels
        if pixels.shape[2] < count or (count == 1 and pixels.shape[2] > 1):
            has = f"{path}: {pixels.shape[2]} components (colours, opacity)"
            raise DataError(f"{has}; expected {count} as in other pictures of {source}: convert it, or leave it out")
        return select_component(pixels[None, ..., :count], options.component, source, color=True)[0]

    return plane


def read_pixels(path: Path) -> np.ndarray:
    """Return the pixels of a picture, (rows, columns, samples) uint8 or uint16, turned as its Exif orientation says.

    Palettes are expanded, greys of fewer bits scaled to 8; colours are neither managed nor multiplied by opacity. The
    fourth byte of a BMP's pixels is dropped: most programs leave it 0.

    Raises:
        DataError: no picture, or a damaged one; not enough memory.
    """
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    config.attribute("oiio:RawColor", 1)
    image = oiio.ImageInput.open(str(path), config)
    kind, pixels, error = ("", None, oiio.geterror()) if image is None else (image.format_name(), None, "")
    if image is not None and kind in KINDS:
        spec = image.spec()
        check_memory(spec.image_bytes(), str(path))
        pixels = image.read_image(0, 0, 0, spec.nchannels, spec.format)
        error = image.geterror()  # also where a JPEG is cut short, whose rest is grey
    if pixels is None or error:
        text = " ".join(error.split())[:200] or f"content: {kind}"
        raise DataError(f"{path}: cannot be read ({text}); expected a whole PNG, BMP or JPEG picture")
    pixels = pixels.reshape(spec.height, spec.width, spec.nchannels)[..., : 3 if kind == "bmp" else None]
    turn = spec.get_int_attribute("Orientation", 1)
    pixels = pixels.swapaxes(0, 1) if turn > 4 else pixels
    return pixels[:: -1 if turn in (3, 4, 7, 8) else 1, :: -1 if turn in (2, 3, 6, 7) else 1]


def _simplest(pixels: np.ndarray) -> np.ndarray:
    """Return pixels without opacity that is full everywhere, and as grey if red, green and blue are equal."""
    if pixels.shape[2] in (2, 4) and (pixels[..., -1] == np.iinfo(pixels.dtype).max).all():
        pixels = pixels[..., :-1]
    return pixels[..., :1] if pixels.shape[2] == 3 and (pixels[..., 1:] == pixels[..., :1]).all() else pixels
