"""Picture files through OpenImageIO: opened within bounds, written atomically."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.files import atomic_write

MAX_PIXELS = 2**28  # 16384 x 16384, because a damaged header may claim anything
MAX_PIXELS_PER_BYTE = 2**14  # more than deflate can reach for one-bit pixels


def write_picture(
    path: str | PathLike[str], kind: str, pixels: np.ndarray, attributes: Mapping[str, Any], overwrite: bool
) -> None:
    """Write (h, w, channels) uint8, float16 or float32; ``kind`` is "png" or "exr", ``attributes`` are OpenImageIO's.

    Raises:
        DataError: the file cannot be written.
        UsageError: the file exists and ``overwrite`` is not set.
    """
    import OpenImageIO as oiio

    height, width, channels = pixels.shape
    types = {"uint8": oiio.UINT8, "float16": oiio.HALF, "float32": oiio.FLOAT}
    spec = oiio.ImageSpec(width, height, channels, types[pixels.dtype.name])
    for name, value in attributes.items():
        spec.attribute(name, value)
    with atomic_write(path, overwrite) as temporary:
        output = oiio.ImageOutput.create(kind)
        if output is None or not output.open(str(temporary), spec):
            raise DataError(f"{path}: cannot be written ({output.geterror() if output else oiio.geterror()})")
        written = output.write_image(pixels)
        if not (output.close() and written):
            raise DataError(f"{path}: cannot be written ({output.geterror()})")


def read_picture(path: str | PathLike[str], kind: str, form: str) -> tuple[np.ndarray, Any]:
    """Return (h, w, channels) float32 as stored, and OpenImageIO's description of the picture.

    Args:
        path: the file.
        kind: "png" or "openexr".
        form: its name in messages.

    Raises:
        DataError: no such file, of another kind or damaged, or it has more than 2^28 pixels.
    """
    import OpenImageIO as oiio

    if not Path(path).is_file():
        raise DataError(f"{path}: no such file; expected {form}")
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # else straight colours are multiplied by alpha in 8 bits
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise DataError(f"{path}: not an image ({oiio.geterror().splitlines()[0]}); expected {form}")
    try:
        spec = source.spec()
        if source.format_name() != kind:
            raise DataError(f"{path}: an image of format {source.format_name()}; expected {form}")
        size = Path(path).stat().st_size
        if min(spec.width, spec.height) < 1 or spec.width * spec.height > min(MAX_PIXELS, MAX_PIXELS_PER_BYTE * size):
            claim = f"claims {spec.width} x {spec.height} pixels in {size} bytes"
            raise DataError(f"{path}: {claim}; expected a whole image, up to 2^28")
        pixels = source.read_image(oiio.FLOAT)
        if pixels is None:
            raise DataError(f"{path}: damaged ({source.geterror().strip()}); expected {form}, whole")
    finally:
        source.close()
    return np.asarray(pixels, dtype=np.float32).reshape(spec.height, spec.width, spec.nchannels), spec
