"""Compositing of images: over a background, side by side, and as a contact sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vvgt_cli.errors import DataError

BLACK = (0.0, 0.0, 0.0)
GAP = 4  # pixels between the pictures of a contact sheet


def over(rgba: np.ndarray, background: float | Sequence[float] | np.ndarray = BLACK) -> np.ndarray:
    """Composite premultiplied RGBA (..., 4) over a colour, grey or image (..., 3); return float32, not clipped.

    Raise DataError for other shapes.
    """
    rgba = np.asarray(rgba, dtype=np.float32)
    if rgba.shape[-1:] != (4,):
        raise DataError(f"image of shape {rgba.shape}; expected four channels, premultiplied RGBA")
    return rgba[..., :3] + (1 - rgba[..., 3:]) * np.asarray(background, dtype=np.float32)


def _rgb(image: np.ndarray, background: Sequence[float]) -> np.ndarray:
    """Return an RGB or premultiplied RGBA image as (h, w, 3) float32 in [0, 1]."""
    image = np.asarray(image, dtype=np.float32)
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        raise DataError(f"image of shape {image.shape}; expected (height, width, 3) or (height, width, 4)")
    return np.clip(over(image, background) if image.shape[2] == 4 else image, 0, 1)


def coarser(image: np.ndarray, factor: int) -> np.ndarray:
    """Return an image (h, w, c) averaged over squares of ``factor`` pixels, without the rest at the right and below."""
    h, w = image.shape[0] // factor, image.shape[1] // factor
    return image[: h * factor, : w * factor].reshape(h, factor, w, factor, -1).mean(axis=(1, 3))


def side_by_side(reference: np.ndarray, ours: np.ndarray, gain: float = 8.0) -> np.ndarray:
    """Join reference, ours and their absolute difference times ``gain``, (h, 3 w, 3) float32 in [0, 1].

    Images are (h, w, 3) RGB, or (h, w, 4) premultiplied, over black. Raise DataError for others, or other sizes.
    """
    left, right = _rgb(reference, BLACK), _rgb(ours, BLACK)
    if left.shape != right.shape:
        raise DataError(f"images of {left.shape[:2]} and {right.shape[:2]} pixels; expected the same size")
    return np.concatenate([left, right, np.clip(gain * np.abs(left - right), 0, 1)], axis=1)


def captioned(sheet: np.ndarray, rows: int) -> np.ndarray:
    """Write a line above each row of `side_by_side`, with the names of its pictures and its PSNR in dB.

    Args:
        sheet: (h, 3 w, 3) float32 in [0, 1], ``rows`` rows below each other.
        rows: their number.

    Returns:
        (h + rows c, 3 w, 3) float32 in [0, 1], where c is the height of a line.
    """
    from PIL import Image, ImageDraw, ImageFont

    wide, size = sheet.shape[1] // 3, min(max(sheet.shape[1] // 72, 9), 24)
    font, parts = ImageFont.load_default(size), []
    for pictures in np.split(sheet, rows):
        error = float(((pictures[:, :wide] - pictures[:, wide : 2 * wide]) ** 2).mean())
        line = Image.new("RGB", (3 * wide, 2 * size), (32, 32, 32))
        names = ("volume", f"splats, {-10 * math.log10(error):.1f} dB" if error else "splats", "8 x difference")
        for k, name in enumerate(names):
            ImageDraw.Draw(line).text(((k + 0.5) * wide, size), name, (255, 255, 255), font, anchor="mm")
        parts += [np.asarray(line, np.float32) / 255, pictures]
    return np.concatenate(parts)


def contact_sheet(images: Sequence[np.ndarray], background: Sequence[float] = BLACK) -> np.ndarray:
    """Lay images of one size out in rows, `GAP` pixels apart, over ``background``, (H, W, 3) float32 in [0, 1].

    Images are (h, w, 3) RGB or (h, w, 4) premultiplied; a row has as many as there are rows, or one more. Raise
    DataError for none, or other sizes.
    """
    tiles = [_rgb(image, background) for image in images]
    if not tiles or len({tile.shape for tile in tiles}) != 1:
        raise DataError(
            f"{len(tiles)} images of {len({t.shape for t in tiles})} sizes; expected at least one, one size"
        )
    columns = math.ceil(math.sqrt(len(tiles)))
    height, width, _ = tiles[0].shape
    rows = -(-len(tiles) // columns)
    sheet = np.empty((rows * (height + GAP), columns * (width + GAP), 3), dtype=np.float32)
    sheet[:] = background
    for i, tile in enumerate(tiles):
        y, x = i // columns * (height + GAP), i % columns * (width + GAP)
        sheet[y : y + height, x : x + width] = tile
    return sheet[: sheet.shape[0] - GAP, : sheet.shape[1] - GAP]
