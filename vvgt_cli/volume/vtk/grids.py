"""Arrays and hidden cells of VTK's datasets in memory, and images as volumes.

Cells are compared with points before VTK walks them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.components import ArrayInfo, select_from_array
from vvgt_cli.volume.reading import ReadOptions, Volume, without
from vvgt_cli.volume.vtk.resample import Grid
from vvgt_cli.volume.vtk.xml import GHOSTS, HIDDEN


def values_of(mesh: Any, info: ArrayInfo) -> np.ndarray:
    """Return the numbers of an array: (n,), or (n, c) with components."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    data = mesh.GetPointData() if info.where == "point" else mesh.GetCellData()
    return np.asarray(vtk_to_numpy(data.GetArray(info.name)))


def arrays_of(mesh: Any) -> list[ArrayInfo]:
    """List the arrays of numbers, without ghost marks."""
    from vtkmodules.util.numpy_support import get_vtk_to_numpy_typemap

    types = get_vtk_to_numpy_typemap()
    infos = []
    for where, data in (("point", mesh.GetPointData()), ("cell", mesh.GetCellData())):
        active = data.GetScalars()
        for k in range(data.GetNumberOfArrays()):
            array = data.GetArray(k)
            if array is None or array.GetDataType() not in types or array.GetName() == GHOSTS:
                continue
            if not array.GetName():
                array.SetName(f"array{k}")
            dtype = np.dtype(types[array.GetDataType()]).name
            infos.append(ArrayInfo(array.GetName(), where, array.GetNumberOfComponents(), dtype, array is active))
    return infos


def check_cells(mesh: Any, source: str) -> None:
    """Refuse cells that name points which are not there: VTK would read beyond the array."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    if not mesh.IsA("vtkUnstructuredGrid") or mesh.GetNumberOfCells() < 1:
        return
    cells = mesh.GetCells()
    ids = vtk_to_numpy(cells.GetConnectivityArray())
    offsets = vtk_to_numpy(cells.GetOffsetsArray())
    fits = ids.size and ids.min() >= 0 and ids.max() < mesh.GetNumberOfPoints()
    if not fits or offsets[0] != 0 or offsets[-1] > ids.size or (np.diff(offsets) < 0).any():
        raise DataError(f"{source}: its cells name points that do not exist; check that the file is whole")


def shown(mesh: Any) -> Any:
    """Remove hidden cells, and cells with a hidden point, from a grid or mesh; return it as it is where none are."""
    from vtkmodules.vtkCommonCore import vtkIdList
    from vtkmodules.vtkFiltersCore import vtkExtractCells

    marks = _hidden(mesh, "cell")
    points = _hidden(mesh, "point")
    if points is not None:
        ids, odd = vtkIdList(), np.zeros(mesh.GetNumberOfCells(), bool)
        for point in np.flatnonzero(points).tolist():
            mesh.GetPointCells(point, ids)
            odd[[ids.GetId(k) for k in range(ids.GetNumberOfIds())]] = True
        marks = odd if marks is None else marks | odd
    if marks is None:
        return mesh
    chosen = vtkIdList()
    for cell in np.flatnonzero(~marks).tolist():
        chosen.InsertNextId(cell)
    keep = vtkExtractCells()
    keep.SetInputData(mesh)
    keep.SetCellList(chosen)
    keep.Update()
    return keep.GetOutput()


def _hidden(mesh: Any, where: str) -> np.ndarray | None:
    """Return a mask of the points or cells that ghost marks hide; None where they hide none."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    array = (mesh.GetPointData() if where == "point" else mesh.GetCellData()).GetArray(GHOSTS)
    if array is None or array.GetNumberOfComponents() != 1:
        return None
    hidden: np.ndarray = vtk_to_numpy(array).astype(np.uint8) & HIDDEN[where] != 0
    return hidden if hidden.any() else None


def visible(image: Any, field: np.ndarray, where: str) -> np.ndarray:
    """Set the values (nz, ny, nx) of an image to NaN where they are hidden."""
    for kind in ("point", "cell"):
        hidden = None if (kind, where) == ("point", "cell") else _hidden(image, kind)
        if hidden is not None:
            hidden = hidden.reshape(image_place(image, kind).dims[::-1])
            field = without(field, hidden if kind == where else around(hidden, field.shape))
    return field


def around(cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Mask the points (nz, ny, nx) whose surrounding cells are all in ``cells``, a mask."""
    for axis, n in enumerate(shape):
        if n > cells.shape[axis]:
            ones = np.ones_like(np.take(cells, [0], axis))
            cells = np.concatenate([ones, cells], axis) & np.concatenate([cells, ones], axis)
    return cells


def image_place(image: Any, where: str) -> Grid:
    """Return the grid of the points of a vtkImageData, or of its cell centres."""
    extent = np.reshape(image.GetExtent(), (3, 2))
    return Grid.of_image(extent, image.GetSpacing(), image.GetOrigin(), _direction(image), where)


def _direction(image: Any) -> np.ndarray:
    matrix = image.GetDirectionMatrix()
    return np.array([[matrix.GetElement(r, c) for c in range(3)] for r in range(3)])


def image_volume(image: Any, info: ArrayInfo, options: ReadOptions, source: str, name: str) -> Volume:
    """Make a volume of a vtkImageData: point data, or cell data on the grid of cell centres."""
    if options.dims is not None:
        raise UsageError(f"{source}: an image, which is a regular grid already; leave out --dims")
    grid = image_place(image, info.where)
    values = values_of(image, info).reshape(*grid.dims[::-1], info.components)
    field = visible(image, select_from_array(values, info, options.component, source), info.where)
    return grid.volume(field, info, options, name)
