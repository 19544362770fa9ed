"""VTK files for ``vvgt``: any dataset, and the index of an image in pieces."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any


def write(data: Any, stem: str) -> str:
    """Write a dataset as VTK's XML, and return the file, ``stem`` and its type's ending, or raise RuntimeError."""
    from vtkmodules import vtkIOXML

    writer: Any
    if data.IsA("vtkUniformGridAMR"):
        writer = vtkIOXML.vtkXMLUniformGridAMRWriter()
    elif data.IsA("vtkMultiBlockDataSet"):
        writer = vtkIOXML.vtkXMLMultiBlockDataWriter()
    else:
        writer = vtkIOXML.vtkXMLDataObjectWriter.NewWriter(data.GetDataObjectType())
    if writer is None:
        raise RuntimeError(f"a {data.GetClassName()}; expected an image, a grid or a mesh")
    path = f"{stem}.{writer.GetDefaultFileExtension()}"
    writer.SetFileName(path)
    writer.SetInputDataObject(data)
    if not writer.Write():
        raise RuntimeError(f"{path}: could not be written; is there space?")
    return path


def index_of(image: Any, stem: str, extents: Sequence[Sequence[int]]) -> str:
    """Return the text of a ``.pvti``: an image like ``image`` in pieces ``stem_N.vti`` of these extents."""
    directions = image.GetDirectionMatrix()
    turns = [directions.GetElement(k // 3, k % 3) for k in range(9)]
    place = {
        "WholeExtent": _whole(extents),
        "GhostLevel": [0],
        "Origin": image.GetOrigin(),
        "Spacing": image.GetSpacing(),
    }
    words = " ".join(f'{key}="{_text(values)}"' for key, values in {**place, "Direction": turns}.items())
    lists = "".join(
        f"<P{name}>{''.join(map(_array, _arrays(data)))}</P{name}>"
        for name, data in (("PointData", image.GetPointData()), ("CellData", image.GetCellData()))
    )
    name = os.path.basename(stem)
    pieces = "".join(f'<Piece Extent="{_text(extent)}" Source="{name}_{n}.vti"/>' for n, extent in enumerate(extents))
    kind = 'type="PImageData" version="1.0" byte_order="LittleEndian"'
    return f"<VTKFile {kind}><PImageData {words}>{lists}{pieces}</PImageData></VTKFile>"


def _whole(extents: Sequence[Sequence[int]]) -> list[int]:
    """Return the extent that holds those of all pieces."""
    return [(max if k % 2 else min)(extent[k] for extent in extents) for k in range(6)]


def voxels_of(extents: Sequence[Sequence[int]]) -> int:
    """Return the number of points of an image in pieces."""
    whole = _whole(extents)
    return math.prod(whole[2 * k + 1] - whole[2 * k] + 1 for k in range(3))


def series_of(files: Sequence[tuple[str, float]]) -> str:
    """Return the text of a ``.pvd`` of files in its folder, at their times."""
    sets = "".join(f'<DataSet timestep="{time!r}" file="{os.path.basename(path)}"/>' for path, time in files)
    return f'<VTKFile type="Collection" version="0.1"><Collection>{sets}</Collection></VTKFile>'


def _text(values: Sequence[float]) -> str:
    return " ".join(repr(v) for v in values)


def _arrays(data: Any) -> list[Any]:
    return [array for array in map(data.GetArray, range(data.GetNumberOfArrays())) if array is not None]


def _array(array: Any) -> str:
    called = array.GetDataTypeAsString()
    kind = "Float" if called in ("float", "double") else "UInt" if called.startswith("unsigned") else "Int"
    type_ = f"{kind}{8 * array.GetDataTypeSize()}"
    name = array.GetName().replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    return f'<PDataArray type="{type_}" Name="{name}" NumberOfComponents="{array.GetNumberOfComponents()}"/>'
