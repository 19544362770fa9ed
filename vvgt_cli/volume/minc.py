"""MINC 1 (a NetCDF file) and MINC 2 (an HDF5 file), ``.mnc``, read by nibabel part by part.

Values are scaled slice by slice (image-min, image-max). Format: https://en.wikibooks.org/wiki/MINC/Reference.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, SeveralSteps, UsageError
from vvgt_cli.volume import netcdf3
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.hdf5 import MAGIC, check_storage
from vvgt_cli.volume.headers import unit_rows
from vvgt_cli.volume.libraries import library_errors, need
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import Reader, register, volume_name
from vvgt_cli.volume.stored import Slices, Stored
from vvgt_cli.volume.types import Volume

IMAGE = "/minc-2.0/image/0/image"
SLAB = 1 << 22  # voxels that are scaled at once: nibabel does so in float64


def _sniff(head: bytes) -> bool:
    return (head.startswith(MAGIC) and b"minc-2.0" in head) or (head.startswith(b"CDF") and b"MINC standard" in head)


def read_minc(path: Path, options: ReadOptions) -> Volume:
    """Read a MINC file as float32; MINC 2 stays in its file where it is read in blocks. A fourth axis is time.

    Raises:
        DataError: nibabel or h5py is not installed, a damaged file, values in other files, axes that are no volume.
        UsageError: time steps (`SeveralSteps`) and none chosen, or a choice that does not exist.
    """
    with open(path, "rb") as file:
        packed = file.read(len(MAGIC)) == MAGIC
    if packed:
        h5py = need("h5py", "minc", str(path), "MINC 2")
        with library_errors(str(path), "MINC 2"), h5py.File(path, "r") as file:
            check_storage(h5py, file[IMAGE], path, str(path))
    else:
        netcdf3.check_header(path)
        check_memory(path.stat().st_size, path.name)
    nibabel = need("nibabel", "minc", str(path), "MINC")
    with library_errors(str(path), "MINC"):
        image = (nibabel.minc2.Minc2Image if packed else nibabel.minc1.Minc1Image).from_filename(path)
        return _volume(image, path, options, packed)


def _volume(image: Any, path: Path, options: ReadOptions, packed: bool) -> Volume:
    shape = tuple(map(int, image.shape))
    if len(shape) not in (3, 4) or min(shape) < 1 or not np.isfinite(image.affine).all():
        raise DataError(f"{path}: axes of {shape} values; expected three in space, and time before them")
    times = shape[0] if len(shape) == 4 else 1
    if times > 1 and options.time is None:
        raise SeveralSteps(str(path), times)
    if (options.time or 0) >= times:
        raise UsageError(f"{path}: --time {options.time}: it has {times} time steps; expected 0 to {times - 1}")
    if options.component not in (None, 0):
        raise UsageError(f"{path}: a scalar volume; leave out --component {options.component}")
    lead: tuple[Any, ...] = (options.time or 0,) if len(shape) == 4 else ()
    proxy = image.dataobj

    def part(slices: Slices) -> np.ndarray:
        z, y, x = (range(*s.indices(n)) for s, n in zip(slices, shape[-3:], strict=True))
        out = np.empty((len(z), len(y), len(x)), np.float32)
        deep = max(SLAB // max(len(y) * len(x), 1), 1)
        for k in range(0, len(z), deep):
            here = slice(z.start + k, min(z.start + k + deep, z.stop))
            out[k : k + deep] = proxy[(*lead, here, slices[1], slices[2])]
        return out

    lazy: Any = Stored(part, np.dtype(np.float32), shape[-3:], (1, *shape[-2:]), str(path))
    if not options.stored:
        check_memory(4 * math.prod(shape[-3:]), path.name)
        lazy = lazy[:]
    affine = image.affine  # of indices in the order of the axes, slowest first
    spacing, direction = unit_rows(affine[:3, 2::-1].T.tolist())
    place = options.spacing_or(spacing), tuple(affine[:3, 3].tolist()), direction
    return Volume(lazy, *place, volume_name(path), space="RAS")


register(Reader("MINC", (".mnc",), _sniff, read_minc, times=True))
