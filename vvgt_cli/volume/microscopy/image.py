"""Images of microscopes: one channel and one time step of one as a volume, in memory or left in its file."""

from __future__ import annotations

import io
import math
import os
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from vvgt_cli.errors import DataError, SeveralArrays, UsageError
from vvgt_cli.volume.blocks import IN_BLOCKS, check_memory
from vvgt_cli.volume.components import choose_component, contiguous, listed, magnitude
from vvgt_cli.volume.reading import ReadOptions, Volume, placed
from vvgt_cli.volume.stored import Slices, stored_or_loaded

EXTRA = "microscopy"
MAX_XML = 64 << 20
Color = tuple[float, float, float] | None


@dataclass(frozen=True)
class Micrograph:
    """An image of a microscope.

    Attributes:
        times: number of time steps.
        channels: number of channels.
        shape: (nz, ny, nx) of each.
        dtype: of the values.
        read: (time, channel, slices along z, y, x, step 1) to that box, (z, y, x).
        chunks: (z, y, x) voxels that are read together.
        spacing: (x, y, z) in micrometres, negative where an axis runs backwards; None where the file has none.
        origin: world position of the centre of voxel (0, 0, 0), (x, y, z), micrometres.
        names: of the channels, where the file has any.
        colors: RGB in [0, 1] of the channels, where the file has any.
        rgb: the channels are red, green, blue and perhaps opacity.
        samples: the channels are samples of pixels, not channels of their own, as those of ``rgb`` are.
        mapped: ``read`` gives views of the file, which take no memory.
        tells: a message says what is taken for spacing that is None.
    """

    times: int
    channels: int
    shape: tuple[int, int, int]
    dtype: np.dtype
    read: Callable[[int, int, Slices], np.ndarray]
    chunks: tuple[int, int, int]
    spacing: tuple[float | None, float | None, float | None] = (None, None, None)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    names: Sequence[str] = ()
    colors: Sequence[Color] = ()
    rgb: bool = False
    samples: bool = False
    mapped: bool = False
    tells: bool = True


def picture_volume(picture: Micrograph, options: ReadOptions, source: str, name: str) -> Volume:
    """Make a volume of one channel of one time step, in micrometres; with ``options.stored`` it stays in its file.

    Errors are those of `Reader.read`.
    """
    if min(picture.times, picture.channels, *picture.shape) < 1 or picture.dtype.kind not in "iufb":
        raise DataError(f"{source}: {picture.shape} values of type {picture.dtype}; expected integers or floats, z y x")
    channel = choose_component(
        picture.channels, picture.dtype, options.component, f"{source}:", picture.names, picture.colors, picture.rgb,
        not (picture.rgb or picture.samples),
    )  # fmt: skip
    what = "time steps" if picture.shape[0] > 1 else "time steps of one slice each"
    time = options.step(picture.times, source, what)
    box = tuple(slice(0, n) for n in picture.shape)
    size = math.prod(picture.shape)
    field: Any
    if channel is None:
        if options.stored:
            raise UsageError(f"{source}: a magnitude cannot be read block by block; choose one channel")
        loaded = 0 if picture.mapped else picture.dtype.itemsize * picture.channels
        check_memory((loaded + 4) * size, source, IN_BLOCKS)
        field = magnitude([picture.read(time, c, box) for c in range(picture.channels)])
    elif not picture.mapped:
        read = partial(picture.read, time, channel)
        field = stored_or_loaded(read, picture.dtype, picture.shape, picture.chunks, source, options.stored)
    else:
        field = picture.read(time, channel, box)
        if not field.flags.c_contiguous and not options.stored:
            check_memory(size * picture.dtype.itemsize, source, IN_BLOCKS)
            field = contiguous(field)
    unit = "" if picture.spacing == (None, None, None) else "um"
    sizes = [s if s is not None and math.isfinite(s) else 0.0 for s in picture.spacing]
    across = next((abs(s) for s in sizes if s), 1.0)  # of an axis without a size
    unknown = [axis for axis, s, n in zip("xyz", sizes, field.shape[::-1], strict=True) if not s and n > 1]
    if unknown and picture.tells and options.spacing is None:
        axes = ", ".join(unknown)
        warnings.warn(
            f"{source}: no voxel size along {axes}; taken as {across:g} (--spacing X Y Z sets it)", stacklevel=3
        )
    return placed(field, np.diag([s or across for s in sizes]), picture.origin, options, name, unit=unit)


def choose_image(
    names: Sequence[str], facts: Sequence[str], wanted: str | None, what: str, source: str, deep: Sequence[bool] = (),
    keys: Sequence[str] = (),
) -> int:  # fmt: skip
    """Return the index of the image, scene or position asked for by number or name, or of the only one.

    The only one of several slices (``deep``, where they differ) is taken with a warning where none is asked for.
    ``facts`` describe them, ``what`` is the word for them in the plural, and ``keys`` are their numbers, by default
    from 0 on.

    Raises:
        DataError: there are none.
        UsageError: several and none chosen (`SeveralArrays`), or none such.
    """
    if not names:
        raise DataError(f"{source}: no {what}; expected at least one")
    keys = keys or [str(k) for k in range(len(names))]
    listing = listed([f"{k} {n[:60]!r} ({f})" for k, n, f in zip(keys, names, facts, strict=True)])
    if wanted is not None:
        fits = [k for k, name in enumerate(names) if wanted.strip("/") in (keys[k], name)]
        if len(fits) != 1:
            raise UsageError(f"{source}: {len(fits)} {what} {wanted!r}; it has {listing}; choose with --series NAME")
        return fits[0]
    if len(names) == 1:
        return 0
    if sum(deep) != 1:
        text = f"{source}: {len(names)} {what}: {listing}; choose one by number or name with --series NAME"
        raise SeveralArrays(text, "--series", keys, names)
    number = [*deep].index(True)
    warnings.warn(
        f"{source}: {names[number]!r} taken, of {len(names)} images the only one of several slices (--series chooses "
        "another)", stacklevel=3,
    )  # fmt: skip
    return number


def hex_color(text: Any) -> Color:
    """Parse RGB in [0, 1] of ``RRGGBB`` or ``AARRGGBB``, after "#" or not; None for others, and for black."""
    digits = re.fullmatch(r"#?(?:[0-9a-fA-F]{2})?([0-9a-fA-F]{6})", text.strip()) if isinstance(text, str) else None
    if digits is None or digits[1] == "000000":
        return None
    red, green, blue = bytes.fromhex(digits[1])
    return red / 255, green / 255, blue / 255


def safe_xml(text: str, source: str) -> ElementTree.Element:
    """Return the root of a file's metadata; raise DataError for entities, damage, or more than `MAX_XML` characters."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text or len(text) > MAX_XML:
        raise DataError(f"{source}: XML metadata of {len(text)} characters or with entities; expected plain metadata")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise DataError(f"{source}: damaged XML metadata ({error}); check that the file is whole") from error


class Bounded(io.BufferedReader):
    """A file that is never asked for more bytes than it has: lengths in it may lie, and memory is allocated first."""

    def __init__(self, path: Path) -> None:
        """Open a file."""
        super().__init__(io.FileIO(path))
        self._size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """Read as any file does, but never ask for more bytes than are left."""
        rest = max(self._size - self.tell(), 0)
        return super().read(rest if size is None or size < 0 else min(size, rest))
