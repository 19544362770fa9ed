"""Volumes of what a caller has: numpy and Dask arrays, xarray's DataArray, pyvista's (VTK's) images and grids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vvgt_cli.errors import UsageError
from vvgt_cli.volume.components import contiguous
from vvgt_cli.volume.dask_arrays import Chunks, is_dask, lazy
from vvgt_cli.volume.labelled import axis, labelled_volume
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.space import SPACES, unit_rows
from vvgt_cli.volume.types import Volume


def volume_in_memory(
    data: Any,
    options: ReadOptions,
    *,
    origin: Sequence[float] | None = None,
    affine: Any = None,
    name: str = "array",
) -> Volume:
    """Make a volume of an object; nothing is copied where its layout allows that, and no Dask array is computed.

    Args:
        data: array of three axes, (nz, ny, nx) as slices are stacked, of which masked values become NaN; an
            xarray.DataArray, whose coordinates say where its values are; or a vtkDataSet (pyvista.ImageData, ...), of
            which an image is taken as it is and a mesh is resampled.
        options: spacing (x, y, z) of an array; array, component, time, dims as of a file; ``space`` is the one that the
            affine of an array leads to.
        origin: world position of the centre of voxel (0, 0, 0), (x, y, z), of an array.
        affine: (4, 4) or (3, 4) of an array: (i, j, k, 1), i along x (the last axis), to the world; in place of spacing
            and origin. nibabel's ``img.affine`` belongs to ``img.dataobj`` transposed.
        name: for reports.

    Raises:
        DataError: not three axes, values that are not real numbers, a place that is not one.
        UsageError: options that the object does not take.
    """
    placed = [key for key, value in (("origin", origin), ("affine", affine)) if value is not None]
    if hasattr(data, "IsA") and not isinstance(data, np.ndarray):  # pyvista's arrays have the methods of VTK's
        _refuse(placed, "a VTK dataset says itself where it is")
        return dataset_volume(data, options, name)
    if hasattr(data, "dims") and hasattr(data, "coords") and hasattr(data, "attrs"):
        _refuse(placed, "the coordinates of a DataArray say where it is")
        return _labelled(data, options, name)
    if np.ma.is_masked(data):
        data = data.astype(np.promote_types(data.dtype, np.float32)).filled(np.nan)
    values: Any = lazy(data, name) if is_dask(data) else np.asarray(data)
    return _array(values, options, origin, affine, name)


def dataset_volume(data: Any, options: ReadOptions, name: str) -> Volume:
    """Call `vvgt_cli.volume.vtk.grids.dataset_volume`, which imports VTK."""
    from vvgt_cli.volume.vtk import grids as vtk_grids

    return vtk_grids.dataset_volume(data, options, name, name)


def _refuse(given: Sequence[str], why: str) -> None:
    if given:
        raise UsageError(f"{' and '.join(given)}: {why}; leave out {' and '.join(given)}")


def _labelled(data: Any, options: ReadOptions, name: str) -> Volume:
    """Read an xarray.DataArray; one of Dask block by block, or as a whole for a magnitude or another grid."""
    axes = []
    for dim, size in zip(data.dims, data.shape, strict=True):
        coordinate = data.coords.get(dim)
        centres = None
        if coordinate is not None and coordinate.dtype.kind in "iuf":
            centres = np.asarray(coordinate.values, np.float64)
        axes.append(axis(str(dim), size, centres, getattr(coordinate, "attrs", None)))
    label = str(data.name or name)
    if data.chunks is None:
        return labelled_volume(lambda index: data[index].values, data.dtype, axes, data.attrs, options, label, label)
    read = Chunks(data.data, label)
    blockwise = options.component != "magnitude" and options.dims is None
    options = replace(options, stored=blockwise)
    return labelled_volume(read, data.dtype, axes, data.attrs, options, label, label, read.largest)


def _array(values: Any, options: ReadOptions, origin: Sequence[float] | None, affine: Any, name: str) -> Volume:
    chosen = [key for key in ("array", "component", "time") if getattr(options, key) is not None]
    _refuse([*chosen, *options.raw_flags], "an array is one volume")
    if affine is not None and (options.spacing is not None or origin is not None):
        raise UsageError("affine: holds spacing and origin too; leave out those or the affine")
    if options.space is not None and affine is None:
        raise UsageError(f"space {options.space}: says where an affine leads to; give affine too")
    ready = contiguous(values) if isinstance(values, np.ndarray) and values.ndim == 3 else values
    volume = Volume(ready, options.spacing or (1.0, 1.0, 1.0), name=name)
    if origin is not None:
        volume = replace(volume, origin=tuple(map(float, origin)))
    if affine is None:
        return volume
    matrix = np.asarray(affine, dtype=np.float64)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise UsageError(f"affine: {matrix.shape} {matrix.tolist()}; expected (4, 4) or (3, 4) finite numbers")
    spacing, direction = unit_rows(matrix[:3, :3].T.tolist())
    place: dict[str, Any] = {"spacing": spacing, "direction": direction, "origin": tuple(matrix[:3, 3].tolist())}
    return replace(volume, **place, space=options.space if options.space in SPACES else None)
