"""Connected bodies of a mask, by VTK, and masks of volumes that keep the largest."""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.stored import Stored, chunks_of, planes
from vvgt_cli.volume.types import Volume

BODY_BYTES = 10  # per voxel, while bodies are found


def without_other_bodies(volume: Volume, above: float) -> Volume:
    """Return a mask that hides the voxels above a data value which do not connect with the largest body of such voxels.

    Bodies are found when values of the mask are first read, also of a volume in blocks: in memory, as a whole.

    Raises:
        DataError: no voxel lies above the value, or too little memory; when values are read.
    """

    @cache
    def whole() -> np.ndarray:
        what = f"{volume.name}: --keep-largest {above:g}"
        check_memory(BODY_BYTES * volume.data.size, what, "make a mask of it elsewhere and give that as --mask")
        matter = np.empty(volume.data.shape, bool)
        for row, plane in zip(matter, planes(volume), strict=True):
            np.greater(volume.slope * plane.astype(np.float64) + volume.intercept, above, out=row)
        count = np.count_nonzero(matter)
        if not count:
            raise DataError(f"{what}: no voxel lies above; expected a lower value")
        kept = largest(matter)
        share = 100 * (1 - np.count_nonzero(kept) / count)
        warnings.warn(f"{what}: hides {share:.3g} % of the voxels above it, in smaller bodies", stacklevel=2)
        return np.asarray(kept | ~matter, np.uint8)

    data: Any = Stored(lambda at: whole()[at], np.dtype(np.uint8), volume.data.shape, chunks_of(volume), volume.name)
    return Volume(data, name=volume.name)


def largest(mask: np.ndarray) -> np.ndarray:
    """Return the voxels of the largest connected body of a mask, (nz, ny, nx) bool; voxels connect by their faces."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkImagingMorphological import vtkImageConnectivityFilter

    image = vtkImageData()
    image.SetDimensions(*mask.shape[::-1])
    bits = np.ascontiguousarray(mask, np.uint8)
    image.GetPointData().SetScalars(numpy_to_vtk(bits.ravel()))
    bodies = vtkImageConnectivityFilter()
    bodies.SetInputData(image)
    bodies.SetScalarRange(1, 1)
    bodies.SetExtractionModeToLargestRegion()
    bodies.SetLabelModeToConstantValue()
    bodies.SetLabelConstantValue(1)
    bodies.SetLabelScalarTypeToUnsignedChar()
    bodies.Update()
    return np.asarray(vtk_to_numpy(bodies.GetOutput().GetPointData().GetScalars()).reshape(mask.shape) > 0)
