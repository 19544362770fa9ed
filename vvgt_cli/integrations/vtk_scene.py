"""Volumes of a vtkRenderer as they are drawn: their place, array, and what hides parts of them.

Used by PyVista, and in the Python of ParaView and 3D Slicer: imports VTK and numpy alone, and no other part of vvgt
than its neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

BLENDS = ("composite", "maximum intensity", "minimum intensity", "average intensity", "additive", "isosurface", "slice")


@dataclass
class Drawn:
    """A volume that a renderer shows.

    Attributes:
        data: vtkDataSet with one array of the drawn one's name, placed in the world.
        array: the array that is drawn, None for none.
        scale: world length of a unit of the data.
        mask: (nz, ny, nx) uint8, 0 where cropping or clipping planes hide a voxel; None where there are none.
        notes: what is drawn and cannot be taken.
    """

    data: Any
    array: Any
    scale: float
    mask: np.ndarray | None
    notes: list[str]


def _array(mapper: Any, data: Any) -> tuple[Any, bool]:
    """Return the array that a mapper draws, None for none, and whether it is of cells."""
    from vtkmodules.vtkCommonCore import reference
    from vtkmodules.vtkRenderingCore import vtkAbstractMapper

    if not data.IsA("vtkDataSet"):
        return None, False
    where: Any = reference(0)
    choice = mapper.GetScalarMode(), mapper.GetArrayAccessMode(), mapper.GetArrayId(), mapper.GetArrayName() or ""
    array = vtkAbstractMapper.GetAbstractScalars(data, *choice, where)
    return array, array is not None and where == 1


def drawn(volume: Any, data: Any = None) -> Drawn:
    """Return a vtkVolume as it is drawn, with ``data`` in place of the mapper's (another step, a file's copy)."""
    mapper = volume.GetMapper()
    data = mapper.GetInputDataObject(0, 0) if data is None else data
    array, cells = _array(mapper, data)
    notes = []
    if (blend := getattr(mapper, "GetBlendMode", int)()) != 0:
        notes.append(f"blending by {BLENDS[blend]} (composited instead)")
    if getattr(mapper, "GetMaskInput", lambda: None)() is not None:
        notes.append("mask of the mapper")
    if getattr(mapper, "GetVolumetricScatteringBlending", float)() > 0:
        notes.append("scattering")
    mask, matrix = None, _numbers(volume.GetMatrix(), 4)
    if data.IsA("vtkImageData"):
        crops = bool(getattr(mapper, "GetCropping", int)())
        if crops and not data.GetDirectionMatrix().IsIdentity():
            crops = False
            notes.append("cropping regions of an oblique image (VTK places them along its axes)")
        mask = _mask(mapper, crops, data, cells, matrix)
    elif getattr(mapper, "GetCropping", bool)() or mapper.GetClippingPlanes() is not None:
        notes.append("cropping of a mesh")
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if np.ptp(lengths) > 1e-6 * lengths.max():
        notes.append("uneven scale: opacity is per mean length")
    alone = data.NewInstance()
    alone.ShallowCopy(data)
    if array is not None and array.GetName():  # another of its name, of cells or points, is not read
        (alone.GetPointData() if cells else alone.GetCellData()).RemoveArray(array.GetName())
    return Drawn(placed(alone, volume.GetMatrix()), array, float(np.prod(lengths) ** (1 / 3)), mask, notes)


def _numbers(matrix: Any, n: int) -> np.ndarray:
    return np.array([[matrix.GetElement(r, c) for c in range(n)] for r in range(n)])


def _affine(image: Any) -> np.ndarray:
    """Return the (4, 4) affine of an image from index to its own space."""
    affine = np.eye(4)
    affine[:3, :3] = _numbers(image.GetDirectionMatrix(), 3) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    return affine


def placed(data: Any, matrix: Any) -> Any:
    """Return a dataset moved by a vtkMatrix4x4: an image by its affine, anything else by its points."""
    if matrix.IsIdentity():
        return data
    if not data.IsA("vtkImageData"):
        from vtkmodules.vtkCommonTransforms import vtkTransform
        from vtkmodules.vtkFiltersGeneral import vtkTransformFilter

        move, along = vtkTransformFilter(), vtkTransform()
        along.SetMatrix(matrix)
        move.SetInputDataObject(data)
        move.SetTransform(along)
        move.Update()
        return move.GetOutputDataObject(0)
    affine = _numbers(matrix, 4) @ _affine(data)
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    moved = data.NewInstance()
    moved.ShallowCopy(data)
    moved.SetOrigin(*affine[:3, 3])
    moved.SetSpacing(*spacing)
    moved.SetDirectionMatrix(*(affine[:3, :3] / spacing).ravel())
    return moved


def _mask(mapper: Any, crops: bool, image: Any, cells: bool, matrix: np.ndarray) -> np.ndarray | None:
    """Return which voxels cropping and clipping planes leave, None where there are none."""
    planes = mapper.GetClippingPlanes()
    count = planes.GetNumberOfItems() if planes is not None else 0
    if not (count or crops):
        return None
    low, dims = np.array(image.GetExtent()[::2], float) + 0.5 * cells, np.array(image.GetDimensions()) - cells
    index = [low[a] + np.arange(dims[a]) for a in range(3)]

    def height(affine: np.ndarray, normal: Sequence[float]) -> np.ndarray:
        x, y, z = np.asarray(normal) @ affine[:3, :3]
        start = float(np.asarray(normal) @ affine[:3, 3])
        return z * index[2][:, None, None] + y * index[1][:, None] + x * index[0] + start

    affine = _affine(image)
    keep = np.ones(dims[::-1], bool)
    if crops:
        bounds, flags, region = mapper.GetCroppingRegionPlanes(), mapper.GetCroppingRegionFlags(), 0
        for axis in range(3):
            at = height(affine, np.eye(3)[axis])
            region = region + 3**axis * ((at >= bounds[2 * axis]).astype(int) + (at > bounds[2 * axis + 1]))
        keep &= (flags >> region) & 1 == 1
    for k in range(count):
        plane = planes.GetItemAsObject(k)
        keep &= height(matrix @ affine, plane.GetNormal()) >= np.dot(plane.GetNormal(), plane.GetOrigin())
    return keep.astype(np.uint8)
