"""Connected bodies of a mask, by VTK."""

from __future__ import annotations

import numpy as np


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
    found: np.ndarray = vtk_to_numpy(bodies.GetOutput().GetPointData().GetScalars()).reshape(mask.shape) > 0
    return found
