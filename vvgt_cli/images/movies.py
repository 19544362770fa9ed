"""Movies: GIF through Pillow, MP4 (H.264) through imageio-ffmpeg."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.files import atomic_write

SUFFIXES = (".gif", ".mp4")
RATE = 25  # pictures per second: 4 hundredths each, which GIF can represent
_QUALITY = "18"  # of x264: visually almost lossless
_MOST = 1 << 16  # colours that a palette is computed from
_COLORS, _SAMPLES, _ROUNDS = 256, 16, 3  # size of a GIF's palette, pictures sampled for it, rounds of clustering


def movie_ready(path: str | Path) -> None:
    """Check that a movie of this name can be written.

    Raises:
        DataError: a library that it needs is not installed.
    """
    if Path(path).suffix.lower() == ".mp4":
        _ffmpeg(str(path))


def write_movie(path: str | Path, pictures: Iterable[np.ndarray], overwrite: bool = False) -> int:
    """Write pictures as a looping movie, and return its size in bytes.

    Args:
        path: a file that ends in one of `SUFFIXES`.
        pictures: (h, w, 3) float32 RGB in [0, 1] (clipped), at least one, all of the same size.
        overwrite: replace an existing file.

    Raises:
        DataError: the library fails or is not installed, or the file cannot be written.
        UsageError: the file exists and ``overwrite`` is not set.
    """
    frames = (np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8) for picture in pictures)
    with atomic_write(path, overwrite) as temporary:
        (_gif if Path(path).suffix.lower() == ".gif" else _mp4)(temporary, frames)
        return temporary.stat().st_size


def _gif(path: Path, frames: Iterator[np.ndarray]) -> None:
    """Write a GIF that loops forever, with one palette for all pictures, so that static parts do not flicker."""
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    some = [np.asarray(image).reshape(-1, 3) for image in images[:: max(len(images) // _SAMPLES, 1)]]
    colors = np.unique(np.concatenate(some), axis=0)  # each once, so that the background does not dominate
    colors = colors[:: max(len(colors) // _MOST, 1)]
    palette = Image.fromarray(colors[None]).quantize(_COLORS, Image.Quantize.MEDIANCUT, kmeans=_ROUNDS)
    drawn = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    drawn[0].save(path, save_all=True, append_images=drawn[1:], duration=1000 // RATE, loop=0, optimize=False)


def _ffmpeg(source: str) -> Any:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise DataError(
            f"{source}: .mp4 needs imageio_ffmpeg ({error}); try: pip install 'vvgt[share]', or .gif"
        ) from None
    return imageio_ffmpeg


def _mp4(path: Path, frames: Iterator[np.ndarray]) -> None:
    """Write H.264 that all players support: 4:2:0, with the last row or column repeated to get even sizes."""
    library, writer = _ffmpeg(str(path)), None
    try:
        for frame in frames:
            height, width = frame.shape[:2]
            even = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            if writer is None:
                writer = library.write_frames(
                    str(path), (even.shape[1], even.shape[0]), fps=RATE, codec="libx264", macro_block_size=2,
                    output_params=["-crf", _QUALITY, "-movflags", "+faststart"], ffmpeg_log_level="error",
                )  # fmt: skip
                writer.send(None)
            writer.send(np.ascontiguousarray(even))
    except (OSError, RuntimeError) as error:
        raise DataError(f"{path.name}: ffmpeg failed ({' '.join(str(error).split())[:200]})") from None
    finally:
        if writer is not None:
            writer.close()
