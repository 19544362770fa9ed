"""VTKHDF images, box by box by h5py; whatever else a ``.vtkhdf`` holds is read as a whole by VTK.

Layout: https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format, "Image data" and "Temporal data".
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.arrays.hdf5 import checked_dataset
from vvgt_cli.volume.components import ArrayInfo, choose_array, selected_dtype
from vvgt_cli.volume.reading import ReadOptions, Volume, read_part, text_of, volume_name
from vvgt_cli.volume.stored import Slices, stored_or_loaded
from vvgt_cli.volume.vtk.child import volume_by_child
from vvgt_cli.volume.vtk.index import chosen_time
from vvgt_cli.volume.vtk.xml import GHOSTS, image_grid

GROUPS = {"point": "PointData", "cell": "CellData"}
PLACE = ("WholeExtent", "Spacing", "Origin", "Direction")


def read_vtkhdf(path: Path, options: ReadOptions) -> Volume:
    """Read a ``.vtkhdf``."""
    try:
        import h5py
    except ImportError:
        return volume_by_child("VTKHDF", path, options)
    with h5py.File(path, "r") as file:
        root = file.get("VTKHDF")
        if isinstance(root, h5py.Group) and options.component != "magnitude":
            hidden = any(f"{group}/{GHOSTS}" in root for group in GROUPS.values())
            if text_of(root.attrs.get("Type", "")) == "ImageData" and not hidden:
                return _image(h5py, file, path, options)
    return volume_by_child("VTKHDF", path, options)


def _image(h5py: Any, file: Any, path: Path, options: ReadOptions) -> Volume:
    root, source = file["VTKHDF"], str(path)
    if options.dims is not None:
        raise UsageError(f"{source}: an image, which is a regular grid already; leave out --dims")
    times = _times(h5py, file, path)
    time = None if chosen_time(times, options.time, source) is None else options.time or 0
    image = {key: " ".join(map(str, np.ravel(root.attrs[key]).tolist())) for key in PLACE if key in root.attrs}
    infos = _arrays(h5py, root, len(times) > 0)
    info = infos[choose_array(infos, options.array, source)]
    grid = image_grid(image, info.where, path)
    name = f"VTKHDF/{GROUPS[info.where]}/{info.name}"
    dataset = checked_dataset(h5py, path, file, name)
    before = () if time is None else (_offset(h5py, file, path, info, time),)
    shape = tuple(reversed(grid.dims))
    expected = (*shape, *dataset.shape[len(before) + 3 :])
    if dataset.shape[len(before) :] != expected or (before and not 0 <= before[0] < dataset.shape[0]):
        raise DataError(f"{source}: array {info.name!r} is of shape {dataset.shape}; expected {expected} values a step")
    dtype = dataset.dtype.newbyteorder("=")
    selected_dtype(info, options.component, source)  # raises where a component must be chosen
    behind = (int(options.component or 0),) if len(dataset.shape) > len(before) + 3 else ()

    def read(box: Slices) -> np.ndarray:
        return np.ascontiguousarray(read_part(path, name, (*before, *box, *behind)), dtype)

    chunks = dataset.chunks[len(before) : len(before) + 3] if dataset.chunks else (1, *shape[1:])
    values = stored_or_loaded(read, dtype, shape, chunks, source, options.stored)
    return grid.volume(values, info, options, volume_name(path))


def _times(h5py: Any, file: Any, path: Path) -> list[float]:
    """Return the times of the steps; none where there are none."""
    if "VTKHDF/Steps" not in file:
        return []
    values = checked_dataset(h5py, path, file, "VTKHDF/Steps/Values")
    return [float(value) for value in np.ravel(values[()])]


def _offset(h5py: Any, file: Any, path: Path, info: ArrayInfo, time: int) -> int:
    """Return where a step of an array begins, along its first axis."""
    name = f"VTKHDF/Steps/{GROUPS[info.where]}Offsets/{info.name}"
    return int(checked_dataset(h5py, path, file, name)[time]) if name in file else time


def _arrays(h5py: Any, root: Any, timed: bool) -> list[ArrayInfo]:
    infos = []
    for where, name in GROUPS.items():
        group = root.get(name)
        if not isinstance(group, h5py.Group):
            continue
        active = text_of(group.attrs.get("Scalars", ""))
        for key, data in group.items():
            if isinstance(data, h5py.Dataset) and data.dtype.kind in "iuf" and len(data.shape) - timed in (3, 4):
                components = 1 if len(data.shape) - timed == 3 else int(data.shape[-1])
                infos.append(ArrayInfo(key, where, components, data.dtype.name, key == active))
    return infos
