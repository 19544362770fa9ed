"""Meshes and irregular grids resampled to a regular one, by VTK; outside of the mesh is NaN."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.components import ArrayInfo
from vvgt_cli.volume.reading import IDENTITY, ReadOptions, Volume, check_memory, count, float_dtype, printable, triple
from vvgt_cli.volume.space import unit_rows

MAX_EDGE = 512  # voxels along an axis, where nobody said how many


def resample(
    coordinates: Sequence[np.ndarray], values: np.ndarray, dims: tuple[int, int, int] | None, source: str, name: str
) -> Volume:
    """Sample values at uneven coordinates along x, y and z on a regular grid that fills their box (vtkProbeFilter).

    They are interpolated linearly. Samples are voxel centres: the first lies half a voxel inside the box. The volume's
    name says how many there are.

    ``values`` (n,) are those of all points, x fastest. Without ``dims`` (x, y, z) voxels are cubes, about as many as
    there are cells between the points, and at most `MAX_EDGE` along an axis.

    Raises:
        DataError: no cells, or memory that does not suffice.
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkRectilinearGrid

    mesh = vtkRectilinearGrid()
    mesh.SetDimensions(*map(len, coordinates))
    for along, put in zip(coordinates, (mesh.SetXCoordinates, mesh.SetYCoordinates, mesh.SetZCoordinates), strict=True):
        put(numpy_to_vtk(np.ascontiguousarray(along, np.float64), deep=True))
    if mesh.GetNumberOfCells() < 1:
        raise DataError(f"{source}: a mesh without cells; expected some to sample")
    grid = grid_of(np.array(mesh.GetBounds()).reshape(3, 2), dims, mesh.GetNumberOfCells(), source)
    check_memory(count(grid.dims) * 2 * values.itemsize, source)
    sampled, inside = probe(mesh, values, "point", grid)
    return sampled_volume(np.where(inside, sampled, np.nan), inside, values.dtype, grid, dims, source, name)


@dataclass(frozen=True)
class Grid:
    """A regular grid of values: dims, spacing, and the place of the first, (x, y, z); direction row-major."""

    dims: tuple[int, int, int]
    spacing: tuple[float, float, float]
    origin: tuple[float, float, float]
    direction: tuple[float, ...] = IDENTITY

    @classmethod
    def of_image(cls, extent: Any, spacing: Any, origin: Any, direction: Any, where: str) -> Grid:
        """Return the grid of an image's points, or of its cell centres: half a voxel further, one fewer per axis.

        ``extent`` (3, 2) are the first and last point along x, y and z, ``direction`` is row-major.
        """
        (low, high), axes = np.transpose(extent), np.reshape(direction, (3, 3))
        dims = high - low + 1
        if where == "cell":
            low, dims = low + np.where(dims > 1, 0.5, 0.0), np.maximum(dims - 1, 1)
        first = origin + (axes * (low * np.asarray(spacing))).sum(axis=1)
        lengths, turned = unit_rows((axes * np.asarray(spacing)).T)
        return cls(triple(dims.tolist()), triple(lengths), triple(first.tolist()), turned)

    def volume(self, values: np.ndarray, info: ArrayInfo, options: ReadOptions, name: str) -> Volume:
        """Make the volume of an array's values (nz, ny, nx)."""
        place = options.spacing_or(self.spacing), self.origin, self.direction
        return Volume(values, *place, name, quantity=printable(info.name))


def grid_of(bounds: np.ndarray, dims: tuple[int, int, int] | None, cells: int, source: str) -> Grid:
    """Choose samples at the centres of voxels that fill ``bounds`` (3, 2); raise DataError if these are not finite."""
    if not np.isfinite(bounds).all():
        raise DataError(f"{source}: its bounding box {bounds.ravel().tolist()} is not finite")
    extent = bounds[:, 1] - bounds[:, 0]
    thick = extent > 0
    if dims is None:
        edge = (np.prod(extent[thick]) / cells) ** (1 / max(thick.sum(), 1)) if thick.any() else 1.0
        edge = max(edge, extent.max() / MAX_EDGE)
        wanted = np.clip(np.ceil(extent / edge - 1e-9), 1, MAX_EDGE).astype(int)
    else:
        wanted = np.where(thick, dims, 1)
    steps = np.where(thick, extent / wanted, 0.0)
    steps = np.where(thick, steps, steps[thick].mean() if thick.any() else 1.0)
    first = bounds[:, 0] + np.where(extent == 0, 0.0, steps / 2)
    return Grid(triple(wanted.tolist()), triple(steps.tolist()), triple(first.tolist()))


def probe(mesh: Any, values: np.ndarray, where: str, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return samples (nz, ny, nx) of values (n,) of a vtkDataSet's points or cells, and a mask of those inside."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkProbeFilter

    image = vtkImageData()
    image.SetDimensions(*grid.dims)
    image.SetSpacing(*grid.spacing)
    image.SetOrigin(*grid.origin)
    single = mesh.NewInstance()
    single.CopyStructure(mesh)
    array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
    array.SetName("values")
    (single.GetPointData() if where == "point" else single.GetCellData()).AddArray(array)
    filtered = vtkProbeFilter()
    filtered.SetInputData(image)
    filtered.SetSourceData(single)
    filtered.Update()
    sampled = filtered.GetOutput().GetPointData()
    inside = vtk_to_numpy(sampled.GetArray(filtered.GetValidPointMaskArrayName())).astype(bool)
    shape = grid.dims[::-1]
    return vtk_to_numpy(sampled.GetArray("values")).reshape(shape), inside.reshape(shape)


def sampled_volume(
    values: np.ndarray, inside: np.ndarray, dtype: np.dtype, grid: Grid, dims: object, source: str, name: str
) -> Volume:
    """Make the volume of samples, and warn of their number if ``dims`` is None; raise DataError if none is inside.

    Values are (nz, ny, nx), NaN where not ``inside``; ``dtype`` is theirs before sampling.
    """
    size = " x ".join(map(str, grid.dims))
    if not inside.any():
        raise DataError(f"{source}: no sample of {size} lies in a cell of the mesh; try other --dims")
    if dims is None:
        edges = " x ".join(f"{edge:.6g}" for edge in grid.spacing)
        warnings.warn(
            f"{source}: resampled to {size} voxels of {edges}, by its cells (--dims X Y Z decides)", stacklevel=2
        )
    label = f"{name} (resampled to {size})"
    return Volume(values.astype(float_dtype(dtype)), grid.spacing, grid.origin, name=label)
