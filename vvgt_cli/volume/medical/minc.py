"""MINC 1 (a NetCDF file) and MINC 2 (an HDF5 file), ``.mnc``: values stay in their file, and are scaled slice by slice.

The values of a slice run from image-min to image-max. Format: https://en.wikibooks.org/wiki/MINC/Reference.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.arrays.hdf5 import checked_dataset
from vvgt_cli.volume.arrays.netcdf import check_header
from vvgt_cli.volume.components import choose_component
from vvgt_cli.volume.labelled import number_in
from vvgt_cli.volume.libraries import need, read_part
from vvgt_cli.volume.readers import HDF5, volume_name
from vvgt_cli.volume.reading import ReadOptions, Volume, check_memory, magnitude, placed, text_of
from vvgt_cli.volume.space import MILLIMETRE, metres, one_unit
from vvgt_cli.volume.stored import Slices, give_back, stored_or_loaded

IMAGE, DIMENSIONS = "minc-2.0/image/0/", "minc-2.0/dimensions/"
SLAB = 1 << 22  # voxels that are scaled at once, in float64
AXES = ("xspace", "yspace", "zspace")


@dataclass(frozen=True)
class _Image:
    """The image of a file.

    Attributes:
        names: of its axes, slowest first.
        shape: of the stored values.
        dtype: of the stored values.
        read: reads the stored values at an index of all axes.
        attributes: of the image.
        ends: image-min and image-max, along the first axes of the image; None where values are not scaled.
        axes: attributes of each axis.
    """

    names: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype
    read: Callable[[tuple[Any, ...]], np.ndarray]
    attributes: dict[str, Any]
    ends: tuple[np.ndarray, np.ndarray] | None
    axes: dict[str, dict[str, Any]]


def read_minc(path: Path, options: ReadOptions) -> Volume:
    """Read a MINC file as float32. An axis that is neither of space nor named ``time`` is of components."""
    with open(path, "rb") as file:
        packed = file.read(len(HDF5)) == HDF5
    return _volume(_minc2(path) if packed else _minc1(path), path, options)


def _minc1(path: Path) -> _Image:
    variables = check_header(path)
    if "image" not in variables:
        raise DataError(f"{path}: no variable 'image'; expected one in a MINC file")
    image = variables["image"]
    dtype = image.dtype.newbyteorder("=")
    if dtype.kind in "iS":
        signed = str(image.attributes.get("signtype", "unsigned" if dtype.itemsize == 1 else "signed"))
        dtype = np.dtype(f"{'u' if signed.startswith('unsigned') else 'i'}{dtype.itemsize}")
    values = image.mapped(path)
    if min(values.shape, default=0) > 0 and dtype.kind in "iu":
        values = values.view(dtype.newbyteorder(">"))

    def read(index: tuple[Any, ...]) -> np.ndarray:
        part = np.array(values[index])
        give_back(values)
        return part

    ends = [variables[name] for name in ("image-min", "image-max") if name in variables]
    limits = [(v.dims, v.mapped(path).reshape(v.shape)) for v in ends]
    axes = {name: variables[name].attributes for name in image.dims if name in variables}
    return _Image(
        image.dims, image.shape, dtype, read, image.attributes,
        _ends(limits, image.dims, image.shape, path), axes,
    )  # fmt: skip


def _minc2(path: Path) -> _Image:
    h5py = need("h5py", "hdf5", str(path), "MINC 2")
    with h5py.File(path, "r") as file:
        data = checked_dataset(h5py, path, file, IMAGE + "image")
        names = _order(data)
        limits = []
        for name in ("image-min", "image-max"):
            if IMAGE + name in file:
                one = checked_dataset(h5py, path, file, IMAGE + name)
                check_memory(one.size * one.dtype.itemsize, path.name)
                limits.append((_order(one), np.asarray(one[()])))
        axes = {name: dict(file[DIMENSIONS + name].attrs) for name in names if DIMENSIONS + name in file}
        return _Image(
            names, data.shape, data.dtype, partial(read_part, path, IMAGE + "image"), dict(data.attrs),
            _ends(limits, names, data.shape, path), axes,
        )  # fmt: skip


def _order(dataset: Any) -> tuple[str, ...]:
    """Return the names of a dataset's axes; its attribute may name more of them."""
    names = text_of(dataset.attrs.get("dimorder", ""))
    return tuple(names.split(",")[: len(dataset.shape)]) if names else ()


def _ends(
    limits: list[tuple[tuple[str, ...], np.ndarray]], names: tuple[str, ...], shape: tuple[int, ...], path: Path
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return image-min and image-max in float64."""
    if not limits:
        return None
    n = len(limits[0][0])
    if len(limits) != 2 or any(dims != names[:n] or values.shape != shape[:n] for dims, values in limits):
        dims = " and ".join(", ".join(dims) or "none" for dims, _ in limits)
        raise DataError(
            f"{path}: image-min and image-max along axes {dims}; expected both along the first of the image"
        )
    low, high = (np.asarray(values, np.float64) for _, values in limits)
    return low, high


def _volume(image: _Image, path: Path, options: ReadOptions) -> Volume:
    spatial = [k for k, name in enumerate(image.names) if name in AXES]
    times = [k for k, name in enumerate(image.names) if name == "time"]
    parts = [k for k in range(len(image.names)) if k not in (*spatial, *times)]
    if len(spatial) != 3 or len({*image.names}) != len(image.shape) or len(times + parts) > 2 or len(parts) > 1 or (
        min(image.shape) < 1 or image.dtype.kind not in "iuf"
    ):  # fmt: skip
        raise DataError(
            f"{path}: axes {', '.join(image.names)} of {image.shape} values of type {image.dtype}; expected three in "
            "space, and at most one each of time and components"
        )
    n, shape = math.prod(image.shape[k] for k in parts), tuple(image.shape[k] for k in spatial)
    fixed = dict.fromkeys(times, options.step(image.shape[times[0]] if times else 1, str(path)))
    component = choose_component(n, image.dtype, options.component, f"{path}: each voxel has")
    chosen = range(n) if component is None else [component]
    read = [_scaled(image, spatial, fixed | dict.fromkeys(parts, k), path) for k in chosen]

    def norm(slices: Slices) -> np.ndarray:
        return magnitude([part(slices) for part in read])

    one = norm if len(read) > 1 else read[0]
    field = stored_or_loaded(one, np.dtype(np.float32), shape, (1, *shape[1:]), str(path), options.stored)
    names = tuple(image.names[k] for k in spatial)
    return placed(field, *_place(image.axes, names, path), options, volume_name(path), space="RAS")


def _scaled(image: _Image, spatial: list[int], fixed: dict[int, int], path: Path) -> Callable[[Slices], np.ndarray]:
    """Make a function that reads the values of a box, scaled, at ``fixed`` places of the axes that are not spatial."""
    low, high = _valid(image, path)

    def part(slices: Slices) -> np.ndarray:
        z, y, x = (range(*s.indices(image.shape[k])) for s, k in zip(slices, spatial, strict=True))
        out = np.empty((len(z), len(y), len(x)), np.float32)
        deep = max(SLAB // max(len(y) * len(x), 1), 1)
        for k in range(0, len(z), deep):
            box = (slice(z.start + k, min(z.start + k + deep, z.stop)), *slices[1:])
            at: dict[int, Any] = fixed | dict(zip(spatial, box, strict=True))
            index = tuple(at[axis] for axis in range(len(image.shape)))
            values = image.read(index)
            if image.ends is not None and image.dtype.kind != "f":
                first, last = (_along(end, index) for end in image.ends)
                slope = (last - first) / (high - low)
                values = np.clip(values, low, high) * slope + (first - low * slope)
            out[k : k + deep] = values
        return out

    return part


def _along(end: np.ndarray, index: tuple[Any, ...]) -> np.ndarray:
    """Return image-min or image-max of a part of the image, with the axes of the part."""
    part = end[index[: end.ndim]]
    rest = sum(isinstance(i, slice) for i in index[end.ndim :])
    return np.reshape(part, (*np.shape(part), *[1] * rest))


def _valid(image: _Image, path: Path) -> tuple[float, float]:
    """Return the stored values that stand for image-min and image-max."""
    if image.dtype.kind == "f":
        return 0.0, 1.0
    stated, info = image.attributes, np.iinfo(image.dtype)
    limits = np.ravel(stated["valid_range"]) if "valid_range" in stated else [
        number_in(stated, key, end, str(path)) for key, end in (("valid_min", info.min), ("valid_max", info.max))
    ]  # fmt: skip
    low, high = (float(v) for v in limits)
    if not info.min <= low < high <= info.max:
        raise DataError(f"{path}: its valid range is {low:g} to {high:g}; expected one of {image.dtype}, ascending")
    return low, high


def _place(axes: dict[str, dict[str, Any]], names: tuple[str, ...], path: Path) -> tuple[list[list[float]], np.ndarray]:
    """Return the vectors of a step along x, y and z, one a row, and the first position, in mm."""
    rows, origin = [], np.zeros(3)
    for name in names[::-1]:  # fastest first
        stated = axes.get(name, {})
        if text_of(stated.get("spacing", "")).strip("_") == "irregular":
            raise DataError(f"{path}: axis {name} has irregular steps; expected regular ones: try mincresample")
        unit = np.eye(3)[AXES.index(name)]
        cosines = np.asarray(stated.get("direction_cosines", unit), np.float64).reshape(3)
        _, unit = one_unit([text_of(stated.get("units", "")).strip("_\0 ")], str(path), True)
        cosines = cosines * (metres(unit) or MILLIMETRE) / MILLIMETRE
        rows.append((cosines * number_in(stated, "step", 1.0, str(path))).tolist())
        origin += cosines * number_in(stated, "start", 0.0, str(path))
    if not np.isfinite(rows).all() or not np.isfinite(origin).all():
        raise DataError(f"{path}: its steps or starts are not finite; check that the file is whole")
    return rows, origin
