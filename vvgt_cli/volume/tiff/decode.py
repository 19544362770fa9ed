"""Pixels of TIFF pages: by OpenImageIO, which unpacks a page to its size and no further, else by tifffile."""

from __future__ import annotations

import math
import os
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import unpack

# of OpenImageIO: none, CCITT, LZW, JPEG, deflate, PackBits
_CODINGS = {1, 2, 3, 4, 5, 7, 8, 32773, 32946}
_PACKED = {8: "zlib", 32946: "zlib", 34925: "xz"}  # codings of `blocks.unpack`
_WHITE_IS_ZERO, _PALETTE = 0, 3


def open_image(name: str) -> tuple[Any, str]:
    """Open a picture with OpenImageIO, to be read as it is stored; return None and why where that is not possible."""
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # numbers as stored, not multiplied by alpha
    config.attribute("oiio:RawColor", 1)
    image = oiio.ImageInput.open(name, config)
    return image, "" if image is not None else oiio.geterror()  # else it is printed at the end


class Pages(ExitStack):
    """The files of a series, opened as their pages are wanted; a context.

    Args:
        path: for messages.
    """

    def __init__(self, path: Path) -> None:
        """Take the file that pages are decoded from."""
        super().__init__()
        self._path = path
        self._images: dict[str, Any] = {}

    def decoded(self, page: Any, series: Any) -> np.ndarray:
        """Decode a page to its stored numbers, in the type of its series and the order of tifffile's axes.

        Raises:
            DataError: a damaged page, one that differs from the series, or a coding without a decoder.
        """
        keyframe = series.keyframe
        image = None
        if isinstance(page.index, int) and keyframe.imagedepth == 1 and keyframe.photometric != _PALETTE:
            image = self._image(page.parent.filehandle.path)
        if image is None:
            return self._by_tifffile(page, series)
        pixels = self._by_oiio(image, page, keyframe)
        if pixels is None:
            return self._by_tifffile(page, series)
        pixels = _as_stored(pixels, keyframe, series.dtype)
        if pixels.dtype != series.dtype:
            raise DataError(f"{self._path}: page {page.index} has type {pixels.dtype}; expected {series.dtype}")
        return np.moveaxis(pixels, -1, 0) if keyframe.planarconfig == 2 else pixels

    def _image(self, name: str) -> Any:
        """Open a file with OpenImageIO; None where it cannot."""
        if name not in self._images:
            self._images[name], _ = open_image(name)
            if self._images[name] is not None:
                self.callback(self._images[name].close)
        return self._images[name]

    def _by_oiio(self, image: Any, page: Any, keyframe: Any) -> np.ndarray | None:
        """Decode (rows, columns, samples) in the file's type; None for a coding that OpenImageIO lacks."""
        spec = image.spec() if image.seek_subimage(page.index, 0) else None
        if spec is not None:
            declared, expected = (
                (spec.height, spec.width, spec.nchannels),
                (keyframe.imagelength, keyframe.imagewidth, keyframe.samplesperpixel),
            )
            if declared != expected:
                raise DataError(
                    f"{self._path}: page {page.index} is {spec.width} x {spec.height} x {spec.nchannels} when decoded; "
                    f"expected {expected[1]} x {expected[0]} x {expected[2]}"
                )
            pixels = image.read_image(page.index, 0, 0, spec.nchannels, spec.format)
            if pixels is not None:
                return np.asarray(pixels.reshape(expected))
        text = _one_line(image.geterror())
        if keyframe.compression in _CODINGS:
            raise DataError(f"{self._path}: page {page.index} is damaged ({text})")
        return None

    def _by_tifffile(self, page: Any, series: Any) -> np.ndarray:
        keyframe = series.keyframe
        self._check_segments(page, keyframe)
        try:
            values = page.asarray()
        except ValueError as error:
            text = _one_line(str(error))
            if "imagecodecs" not in text:
                raise DataError(f"{self._path}: page {page.index} is damaged ({text})") from error
            raise DataError(
                f"{self._path}: pixels coded as {getattr(keyframe.compression, 'name', keyframe.compression)} need "
                f"imagecodecs ({text}); try: pip install imagecodecs"
            ) from error
        if values.size != keyframe.size or values.dtype != series.dtype:
            raise DataError(
                f"{self._path}: page {page.index} has {values.size} values of {values.dtype} when decoded; expected "
                f"{keyframe.size} of {series.dtype}"
            )
        return np.asarray(values)

    def _check_segments(self, page: Any, keyframe: Any) -> None:
        """Refuse pages that lack parts, parts beyond the file, and parts that unpack to more than the page.

        tifffile's own decoders have no bound.
        """
        parts = math.prod(page.chunked)
        if len(page.dataoffsets) != parts:
            raise DataError(f"{self._path}: page {page.index} has {len(page.dataoffsets)} parts; expected {parts}")
        coding = _PACKED.get(int(keyframe.compression))
        if coding is None:
            return
        with open(page.parent.filehandle.path, "rb") as file:
            end = file.seek(0, os.SEEK_END)
            for offset, n in zip(page.dataoffsets, page.databytecounts, strict=True):
                if offset + n > end:
                    raise DataError(
                        f"{self._path}: page {page.index} has a part of {n} bytes at {offset}; the file ends at {end}"
                    )
                file.seek(offset)
                if len(unpack(coding, file.read(n), keyframe.nbytes + 1)) > keyframe.nbytes:
                    raise DataError(f"{self._path}: page {page.index} unpacks to more than its {keyframe.nbytes} bytes")


def _as_stored(pixels: np.ndarray, keyframe: Any, dtype: np.dtype) -> np.ndarray:
    """Restore the stored numbers: OpenImageIO inverts bytes where 0 is white, and stretches odd numbers of bits."""
    if pixels.dtype.kind != "u":
        return pixels
    if keyframe.photometric == _WHITE_IS_ZERO and pixels.dtype == np.uint8:
        pixels = 255 - pixels
    bits = int(keyframe.bitspersample)
    if bits < 8 * pixels.itemsize:
        pixels = pixels >> (8 * pixels.itemsize - bits)
    return pixels.astype(bool) if dtype.kind == "b" else pixels


def _one_line(text: str) -> str:
    return " ".join(text.split())[:200] or "no message"
