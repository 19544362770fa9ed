"""Meshes and irregular grids resampled to a regular one, by VTK; outside of the mesh is NaN."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory, count
from vvgt_cli.volume.types import Volume

MOST = 512  # voxels along an axis, where nobody said how many


def rectilinear(coordinates: Sequence[np.ndarray]) -> Any:
    """A vtkRectilinearGrid of points at ascending coordinates along x, y and z."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkRectilinearGrid

    grid = vtkRectilinearGrid()
    grid.SetDimensions(*map(len, coordinates))
    for along, put in zip(coordinates, (grid.SetXCoordinates, grid.SetYCoordinates, grid.SetZCoordinates), strict=True):
        put(numpy_to_vtk(np.ascontiguousarray(along, np.float64), deep=True))
    return grid


def resample(
    mesh: Any, values: np.ndarray, where: str, dims: tuple[int, int, int] | None, source: str, name: str
) -> Volume:
    """Sample values on a vtkDataSet on a regular grid that fills the mesh's bounding box (vtkProbeFilter).

    Point data are interpolated as the cells do, cell data are constant in a cell. Samples are voxel centres: the first
    lies half a voxel inside the box. The volume's name says how many there are.

    Args:
        mesh: a vtkDataSet.
        values: (n,) scalars of its points or cells.
        where: ``point`` or ``cell``.
        dims: voxels along (x, y, z); None: cubic ones, about as many as the mesh has cells, `MOST` along an axis.
        source: for messages.
        name: of the volume.

    Raises:
        DataError: an empty mesh, or memory that does not suffice.
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkProbeFilter

    if mesh.GetNumberOfCells() < 1:
        raise DataError(f"{source}: a mesh without cells; expected some to sample")
    bounds = np.array(mesh.GetBounds()).reshape(3, 2)  # x, y, z
    if not np.isfinite(bounds).all():
        raise DataError(f"{source}: its bounding box {bounds.ravel().tolist()} is not finite")
    size, spacing = _grid(bounds, dims, mesh.GetNumberOfCells())
    check_memory(count(size) * 2 * values.itemsize, source)
    image = vtkImageData()
    image.SetDimensions(*size)
    image.SetSpacing(*spacing)
    flat = bounds[:, 0] == bounds[:, 1]
    origin = np.where(flat, bounds[:, 0], bounds[:, 0] + np.array(spacing) / 2)
    image.SetOrigin(*origin)
    single = mesh.NewInstance()
    single.CopyStructure(mesh)
    array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
    array.SetName("values")
    (single.GetPointData() if where == "point" else single.GetCellData()).AddArray(array)
    probe = vtkProbeFilter()
    probe.SetInputData(image)
    probe.SetSourceData(single)
    probe.Update()
    found = probe.GetOutput().GetPointData()
    inside = vtk_to_numpy(found.GetArray(probe.GetValidPointMaskArrayName())).astype(bool)
    if not inside.any():
        raise DataError(f"{source}: no sample of {_text(size)} lies in a cell of the mesh; try other --dims")
    sampled = vtk_to_numpy(found.GetArray("values"))
    small = values.dtype.itemsize <= (4 if values.dtype.kind == "f" else 2)
    out = np.where(inside, sampled, np.nan).astype(np.float32 if small else np.float64).reshape(size[::-1])
    label = f"{name} (resampled to {_text(size)})"
    return Volume(out, spacing, tuple(origin.tolist()), name=label)


def _text(size: Sequence[int]) -> str:
    return " x ".join(map(str, size))


def _grid(
    bounds: np.ndarray, dims: tuple[int, int, int] | None, cells: int
) -> tuple[tuple[int, int, int], tuple[float, float, float]]:
    """Voxels and their edges along x, y, z."""
    extent = bounds[:, 1] - bounds[:, 0]
    thick = extent > 0
    if dims is None:
        edge = (np.prod(extent[thick]) / cells) ** (1 / max(thick.sum(), 1)) if thick.any() else 1.0
        edge = max(edge, extent.max() / MOST)
        wanted = np.clip(np.ceil(extent / edge - 1e-9), 1, MOST).astype(int)
    else:
        wanted = np.where(thick, dims, 1)
    steps = np.where(thick, extent / wanted, 0.0)
    steps = np.where(thick, steps, steps[thick].mean() if thick.any() else 1.0)
    return tuple(wanted.tolist()), tuple(steps.tolist())
