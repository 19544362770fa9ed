"""What the rows of benchmarks/readers.py do with VTK: its images and meshes, its writers and its readers."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
from readers import ORIGIN, SPACING


def vtk_class(name: str) -> Any:
    """An object of ``MODULE.CLASS``."""
    module, _, kind = name.partition(".")
    return getattr(importlib.import_module(f"vtkmodules.{module}"), kind)()


def vtk_image(values: np.ndarray) -> Any:
    """Points with values (z, y, x)."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData

    image = vtkImageData()
    image.SetDimensions(*values.shape[::-1])
    image.SetSpacing(*SPACING)
    image.SetOrigin(*ORIGIN)
    array = numpy_to_vtk(values.ravel())
    array.SetName("values")
    image.GetPointData().SetScalars(array)
    return image


def hexahedra(values: np.ndarray) -> Any:
    """The same points, as a mesh of cells of six faces."""
    from vtkmodules.vtkFiltersCore import vtkAppendFilter
    from vtkmodules.vtkFiltersGeneral import vtkImageDataToPointSet

    points, append = vtkImageDataToPointSet(), vtkAppendFilter()
    points.SetInputData(vtk_image(values))
    append.AddInputConnection(points.GetOutputPort())
    append.Update()
    return append.GetOutput()


def write_vtk(writer: Any, data: Any, path: Path) -> Path:
    """Write a file by one of VTK's writers."""
    writer.SetInputDataObject(0, data)
    writer.SetFileName(str(path))
    writer.Write()
    return path


def by_vtk(name: str) -> Any:
    """What reads a file by a reader of VTK, ``MODULE.CLASS``, all arrays."""

    def read(path: Path) -> Any:
        reader = vtk_class(name)
        (reader.SetCaseFileName if hasattr(reader, "SetCaseFileName") else reader.SetFileName)(str(path))
        if hasattr(reader, "EnableAllPointArrays"):
            reader.UpdateInformation()
            reader.EnableAllPointArrays()
        reader.Update()
        return reader.GetOutputDataObject(0)

    return read
