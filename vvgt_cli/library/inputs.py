"""What callers hand in, as requests of the pipeline have it."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Real
from typing import Any, BinaryIO, TypedDict

from vvgt_cli.conversion.result import Result
from vvgt_cli.errors import UsageError
from vvgt_cli.progress import Console
from vvgt_cli.runs.source import Opened, SourceRequest
from vvgt_cli.transfer import TransferFunction
from vvgt_cli.transfer.lighting import LightOptions
from vvgt_cli.volume import ReadOptions, Volume

PathLike = str | os.PathLike[str]
VolumeLike = Any  # a path, a Volume, a Session, an array, an xarray.DataArray, a pyvista (VTK) dataset
LightLike = LightOptions | str | Sequence[float] | Sequence[str | Sequence[float]] | None
FunctionLike = PathLike | Mapping[str, Any] | TransferFunction


class Reading(TypedDict, total=False):
    """How to read a volume; see `vvgt_cli.volume.ReadOptions`, and `vvgt_cli.volume.memory` for affine and origin."""

    dims: tuple[int, int, int]
    dtype: str
    byte_order: str
    header_bytes: int
    spacing: Sequence[float]
    array: str
    component: int | str
    time: int
    space: str
    affine: Any
    origin: Sequence[float]


def volume_of(volume: VolumeLike, reading: Reading, name: str = "array") -> Volume:
    """The volume that a caller means.

    Args:
        volume: a path (or ``example:NAME``), a `Volume`, or what `vvgt_cli.volume.memory.volume_in_memory` takes.
        reading: how to read it.
        name: of an array, for reports.

    Raises:
        DataError: not a volume, or a damaged one.
        UsageError: options that it does not take, or that there are not.
    """
    from vvgt_cli.synth.sources import open_volume
    from vvgt_cli.volume.memory import volume_in_memory

    given: dict[str, Any] = dict(reading)
    if unknown := sorted(set(given) - set(Reading.__annotations__)):
        raise UsageError(f"{unknown[0]}: no such option; of reading expected {', '.join(Reading.__annotations__)}")
    affine, origin = given.pop("affine", None), given.pop("origin", None)
    for key in ("dims", "spacing"):
        if given.get(key) is not None:
            given[key] = tuple(float(v) if key == "spacing" else int(v) for v in given[key])
    options = ReadOptions(**given)
    if isinstance(volume, Volume):
        if reading:
            raise UsageError(f"{', '.join(reading)}: a Volume has been read; leave out {', '.join(reading)}")
        return volume
    if isinstance(volume, str | os.PathLike):
        if affine is not None or origin is not None:
            raise UsageError("affine and origin are of arrays; a file says itself where it is; leave them out")
        return open_volume(os.fspath(volume), options)
    return volume_in_memory(volume, options, origin=origin, affine=affine, name=name)


def function_of(tf: FunctionLike | None) -> str | TransferFunction | None:
    """The function that a caller means: a path or a name as it is, what a JSON file holds read.

    Raises:
        DataError: a mapping that is not a function.
    """
    from vvgt_cli.transfer import read_transfer_function

    if isinstance(tf, Mapping):
        return read_transfer_function(tf)
    return os.fspath(tf) if isinstance(tf, os.PathLike) else tf


def source_of(
    volume: VolumeLike,
    tf: FunctionLike | None,
    tf_range: str | Sequence[float],
    opacity_unit_distance: str | float | None,
    reading: Reading,
    light: LightLike = None,
) -> SourceRequest:
    """The volume, read, under a function.

    Raises:
        DataError, UsageError: as `volume_of` and `function_of`.
    """
    if not isinstance(tf_range, str):
        tf_range = ",".join(repr(float(v)) for v in tf_range)
    distance = None if opacity_unit_distance is None else str(opacity_unit_distance)
    opened = _opened(volume, reading) or volume_of(volume, reading)
    return SourceRequest(opened, tf=function_of(tf), tf_range=tf_range, unit_distance=distance, light=light_of(light))


def _opened(volume: VolumeLike, reading: Reading) -> Opened | None:
    """What a `Session` holds."""
    opened = getattr(volume, "opened", volume)
    if not isinstance(opened, Opened):
        return None
    if reading:
        raise UsageError(f"{', '.join(reading)}: a session's volume has been read; leave out {', '.join(reading)}")
    return opened


def light_of(light: LightLike) -> LightOptions:
    """The light that a caller means: options as they are, a name, three numbers, or several of these."""
    if isinstance(light, LightOptions):
        return light
    if light is None or isinstance(light, str):
        return LightOptions(() if light is None else (light,))
    parts: list[Any] = list(light)
    if all(isinstance(part, Real) for part in parts):
        parts = [parts]
    return LightOptions(tuple(p if isinstance(p, str) else ",".join(repr(float(v)) for v in p) for p in parts))


def ply_of(ply: PathLike | Result) -> str | BinaryIO:
    """A ``.ply``'s path, or a result as the file that it would be."""
    if isinstance(ply, Result):
        from vvgt_cli.gaussians import write_ply

        stream = io.BytesIO()
        write_ply(stream, ply.gaussians, replace(ply.ply, frame="unit", up="none"))
        stream.seek(0)
        return stream
    return os.fspath(ply)


def console_of(progress: bool) -> Console:
    """Lines and bars on standard error, or silence."""
    return Console(quiet=not progress)
