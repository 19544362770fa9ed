"""A volume that is opened but not read, and what a run in blocks finds out about it first."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vvgt_cli.errors import SeveralComponents, UsageError
from vvgt_cli.resources import free_memory
from vvgt_cli.runs.source import Source, SourceRequest
from vvgt_cli.scale.settings import BlockOptions
from vvgt_cli.scale.tasks import CountBlocks
from vvgt_cli.volume import ReadOptions, Volume
from vvgt_cli.volume.readers import SCHEMES
from vvgt_cli.volume.stored import Stored, lies_in_file, readable_in_blocks

LARGE = 0.25  # of the free memory: a file of less is read as ever
Samples = tuple[np.ndarray, np.ndarray]  # bricks (n, z, y, x) of stored values, voxels (n,) that each stands for
PROGRAM, A_CELL = 3e8, 300  # bytes: interpreter, libraries and kernels; a base cell in memory
ZARR = {".zarray", ".zgroup", ".zattrs", "zarr.json"}  # files of which a folder has one
RANGES = 0.15  # bytes a voxel: the map of empty space


@dataclass(frozen=True)
class InBlocks:
    """A volume whose values stay where they are.

    Attributes:
        volume: with an array that gives blocks.
        request: the source as workers open it too: an absolute path, and how to read it.
        told: what there is to say of the level that was chosen, None for nothing.
    """

    volume: Volume
    request: SourceRequest
    told: str | None = None


def open_in_blocks(request: SourceRequest, options: BlockOptions, pixel: float) -> InBlocks:
    """Open a volume without reading it; ``pixel`` is a pixel's width at its centre, unit frame.

    Raises:
        DataError, UsageError: as `read_volume`; a pipe, compressed values that can be read front to back only, or what
            is named as a label map.
    """
    from vvgt_cli.synth.sources import open_volume
    from vvgt_cli.volume.label_maps import NAMED

    path = request.path
    if path == "-" or (os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path))):
        raise UsageError(f"{path}: a pipe is read front to back, once; blocks need a file")
    scheme = path.partition(":")[0] in SCHEMES and not os.path.exists(path)
    absolute = path if scheme else str(Path(path).absolute())
    read, told = _at_level(replace(request.read, stored=True, packed=True), absolute, options, pixel)
    volume = open_volume(absolute, read)
    if not readable_in_blocks(volume):
        raise UsageError(
            f"{path}: compressed in one piece, which is read front to back; unpack it (raw, .nhdr and .nii files are "
            "mapped), or store it in chunks (Zarr, HDF5)"
        )
    if request.tf is None and request.labels is None and volume.data.dtype.kind in "iu" and NAMED.search(volume.name):
        raise UsageError(
            f"{volume.name}: named as a label map; labels need the whole volume in memory, not blocks of it: give the "
            "job more memory (--memory), or take them as scalars (--labels none, or a --tf)"
        )
    return InBlocks(volume, replace(request, volume=absolute, read=read), told)


def _at_level(read: ReadOptions, path: str, options: BlockOptions, pixel: float) -> tuple[ReadOptions, str | None]:
    """The level of an OME-Zarr image: as asked for, else the coarsest whose voxels the screen cannot tell apart."""
    from vvgt_cli.vbm.closed_form import MIN_CELL
    from vvgt_cli.volume.zarr_store import level_shapes

    shapes = level_shapes(path, read)
    if not shapes:
        if options.level is not None:
            raise UsageError(f"{path}: no OME-Zarr image, which alone has levels; leave out --level {options.level}")
        return read, None
    if options.level is not None:
        return replace(read, level=0 if options.level == "full" else int(options.level)), None
    fits = [n for n, shape in enumerate(shapes) if shape and 2 / max(shape) <= MIN_CELL * pixel]
    level = max(fits, default=0)
    sizes = " x ".join(map(str, reversed(shapes[level])))
    return replace(read, level=level), f"level {level} of {len(shapes)} ({sizes}): finer ones the screen cannot tell"


def files_of(path: str) -> list[Path]:
    """The slices in a folder or of a glob; a file, or a folder of anything else, itself; none where nothing is."""
    from vvgt_cli.volume.slices import matching, slices_of

    if not os.path.exists(path):
        return matching(path)
    return (slices_of(Path(path)) if os.path.isdir(path) else []) or [Path(path)]


def beyond_memory(request: SourceRequest) -> bool:
    """Whether a volume is better gone through in blocks: a large field that the memory does not hold with the rest.

    Colours and channels together are not: blocks take one field.

    Raises:
        DataError, UsageError: as `read_volume`.
    """
    from vvgt_cli.runs.layered import ALL, COLOR
    from vvgt_cli.synth.sources import open_volume
    from vvgt_cli.vbm.closed_form import MAX_BASE_CELLS

    path, free = request.volume, free_memory()
    if not isinstance(path, str) or free is None or path == "-" or request.read.component in (ALL, COLOR):
        return False
    inside = not os.path.exists(path) and not files_of(path) and ":/" in path
    place = path.rpartition(":/")[0] if inside else path
    zarr = os.path.isdir(place) and ZARR & set(os.listdir(place))
    h5 = os.path.isfile(place) and place.lower().endswith((".h5", ".hdf5", ".he5", ".hdf", ".nc"))
    files = files_of(place)
    tiff = files and files[0].suffix.lower() in (".tif", ".tiff")
    packed = zarr or h5 or tiff  # few bytes may hold many voxels
    if not packed and sum(file.stat().st_size for file in files) <= LARGE * free:
        return False
    try:
        volume = open_volume(path, replace(request.read, stored=True, packed=True))
    except SeveralComponents:  # colours, or to be chosen: said where it is read
        return False
    if not lies_in_file(volume):
        return False
    own = volume.data.dtype.name not in ("uint8", "uint16", "float32")
    held = volume.data.nbytes if isinstance(volume.data, Stored) else 0
    voxels = volume.data.size
    return held + (4 * own + RANGES) * voxels + PROGRAM + A_CELL * min(voxels, MAX_BASE_CELLS) > free


def resolved(
    opened: InBlocks, counts: CountBlocks, second: CountBlocks | None
) -> tuple[Source, tuple[float, float], Samples]:
    """The function on the data, from what was counted: the source, stored limits, samples.

    Raises:
        DataError, UsageError: as `vvgt_cli.runs.source.load`.
    """
    from vvgt_cli.runs.layered import NONE
    from vvgt_cli.runs.source import Opened, load
    from vvgt_cli.volume.tallies import statistics_of, with_limits

    volume = opened.volume
    whole, samples, weights = counts.merged()
    whole = with_limits(whole, volume)
    numbers = statistics_of(whole, volume, second.merged()[0].histogram if second else None)
    source = load(replace(opened.request, volume=Opened(volume, numbers), labels=NONE))
    return source, whole.stored, (samples, weights)


def needs_histogram(request: SourceRequest) -> bool:
    """Whether the function follows from the histogram of the values, and not from their range alone."""
    from vvgt_cli.transfer import read_transfer_function

    if request.tf is None:
        return True
    tf = read_transfer_function(request.tf) if isinstance(request.tf, str) else request.tf
    return tf.domain == "percentile"
