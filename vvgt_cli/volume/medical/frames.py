"""Volumes one behind the other in a file, plain or gzip-compressed: the values of NIfTI, Analyze and MGH."""

from __future__ import annotations

import gzip
import math
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import load_block
from vvgt_cli.volume.components import select_component
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.packed import packed


@dataclass(frozen=True)
class Frames:
    """Where values lie: ``dims`` fastest first, of which the fourth is time and those beyond it are components.

    ``start``, ``step`` and ``unit`` are of time, where the file says a unit.
    """

    path: Path
    dtype: np.dtype
    dims: tuple[int, ...]
    offset: int
    zipped: bool
    slope: float = 1.0
    intercept: float = 0.0
    start: float = 0.0
    step: float = 0.0
    unit: str = ""


def read_head(path: Path, size: int) -> tuple[bytes, bool]:
    """The first ``size`` bytes of a file, unzipped, and whether it is gzip-compressed.

    Raises:
        DataError: damaged gzip data.
    """
    with open(path, "rb") as file:
        head = file.read(size)
    if head[:2] != b"\x1f\x8b":
        return head, False
    try:
        with gzip.open(path, "rb") as unzipped:
            return unzipped.read(size), True
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(f"{path}: damaged gzip data ({error}); try to fetch the file again") from error


def load_frames(frames: Frames, options: ReadOptions, source: str) -> tuple[np.ndarray, tuple[float, float]]:
    """The volume (nz, ny, nx) that the options choose, memory-mapped where it is plain, and its slope and intercept.

    Where the fourth axis is the only one beyond space, ``component`` is taken for it too.

    Raises:
        DataError: sizes that do not fit the file or memory.
        UsageError: several components, or time steps (`SeveralSteps`), and none chosen.
    """
    spatial, offset = (*frames.dims, 1, 1)[:3], frames.offset
    times, rest = _times(frames, options, source)
    step, component = options.time or 0, options.component
    number = None  # of the one volume that need be unpacked
    if rest == 1:
        number = step
    elif isinstance(component, int) and component < rest:
        number, component = component * times + step, None
    if number is not None:
        offset += number * math.prod(spatial) * frames.dtype.itemsize
        times, rest, step = 1, 1, 0
    shape, scaling = (rest, times, *reversed(spatial)), (frames.slope, frames.intercept)  # (c, t, z, y, x)
    if frames.zipped and options.packed and (rest, times, options.component) == (1, 1, None):
        return packed(frames.path, frames.dtype, shape[2:], "gzip", skip=offset), scaling
    if frames.zipped:
        block = load_block(frames.path, frames.dtype, shape, encoding="gzip", skip=offset)
    else:
        block = load_block(frames.path, frames.dtype, shape, offset=offset)
    return select_component(
        np.moveaxis(block[:, step], 0, -1),
        component,
        source,
        label="the series" if rest > 1 else "",
        scaling=scaling,
    )


def _times(frames: Frames, options: ReadOptions, source: str) -> tuple[int, int]:
    """Time steps and components; a lone fourth axis counts as components where a component is asked for."""
    times, rest = math.prod(frames.dims[3:4]), math.prod(frames.dims[4:])
    if options.time is None and options.component is not None and times > 1 == rest:
        return 1, times
    known = frames.unit and math.isfinite(frames.step) and frames.step > 0 and math.isfinite(frames.start)
    at = [frames.start + k * frames.step for k in range(times)] if known else None
    options.step(times, source, times=at, unit=frames.unit)
    return times, rest
