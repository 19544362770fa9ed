"""Volumes one behind the other in a file, plain or gzip-compressed: the values of NIfTI, Analyze and MGH."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vvgt_cli.volume.blocks import load_block
from vvgt_cli.volume.components import select_component
from vvgt_cli.volume.options import ReadOptions


@dataclass(frozen=True)
class Frames:
    """Values in a file: ``dims`` fastest first, of which the fourth is time and those beyond it are components.

    ``offset`` counts decompressed bytes. ``start``, ``step`` and ``unit`` are of time, where the file states a unit.
    """

    path: Path
    dtype: np.dtype
    dims: tuple[int, ...]
    offset: int
    encoding: str
    slope: float = 1.0
    intercept: float = 0.0
    start: float = 0.0
    step: float = 0.0
    unit: str = ""


def load_frames(frames: Frames, options: ReadOptions, source: str) -> tuple[np.ndarray, tuple[float, float]]:
    """Load the volume (nz, ny, nx) that the options choose, memory-mapped where it is plain, and slope and intercept.

    Where the fourth axis is the only one beyond space, ``component`` is taken for it too.

    Raises:
        DataError: sizes that do not fit the file or memory.
        UsageError: several components, or time steps (`SeveralSteps`), and none chosen.
    """
    spatial, offset = (*frames.dims, 1, 1)[:3], frames.offset
    times, rest = _times(frames, options, source)
    step, component = options.time or 0, options.component
    number = None  # of the one volume that must be loaded
    if rest == 1:
        number = step
    elif isinstance(component, int) and component < rest:
        number, component = component * times + step, None
    if number is not None:
        offset += number * math.prod(spatial) * frames.dtype.itemsize
        times, rest, step = 1, 1, 0
    scaling, encoding = (frames.slope, frames.intercept), frames.encoding
    if options.packed and encoding != "raw" and (rest, times, options.component) == (1, 1, None):
        packed = load_block(frames.path, frames.dtype, spatial[::-1], encoding=encoding, skip=offset, packed=True)
        return packed, scaling
    shape = (rest, times, *reversed(spatial))  # (c, t, z, y, x)
    block = load_block(frames.path, frames.dtype, shape, encoding=encoding, skip=offset)
    values, label = np.moveaxis(block[:, step], 0, -1), "the series" if rest > 1 else ""
    return select_component(values, component, source, label=label, scaling=scaling)


def _times(frames: Frames, options: ReadOptions, source: str) -> tuple[int, int]:
    """Count time steps and components; a lone fourth axis counts as components where a component is asked for."""
    times, rest = math.prod(frames.dims[3:4]), math.prod(frames.dims[4:])
    if options.time is None and options.component is not None and times > 1 == rest:
        return 1, times
    known = frames.unit and math.isfinite(frames.step) and frames.step > 0 and math.isfinite(frames.start)
    at = [frames.start + k * frames.step for k in range(times)] if known else None
    options.step(times, source, times=at, unit=frames.unit)
    return times, rest
