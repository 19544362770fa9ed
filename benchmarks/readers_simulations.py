"""Rows of benchmarks/readers.py: files of simulation programs, by VTK's writers, by h5py, or by numpy and by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from readers import ORIGIN, SPACING, Row
from readers_vtk import by_vtk, hexahedra, vtk_image, write_vtk


def _minc1(folder: Path, values: np.ndarray) -> Path:
    from vtkmodules.vtkIOMINC import vtkMINCImageWriter

    return write_vtk(vtkMINCImageWriter(), vtk_image(values), folder / "v.mnc")


def _ensight(folder: Path, values: np.ndarray) -> Path:
    """EnSight Gold, binary, by VTK's writer, hexahedra."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkIOParallel import vtkEnSightWriter

    mesh = hexahedra(values)
    block = numpy_to_vtk(np.ones(mesh.GetNumberOfCells(), np.int32))
    block.SetName("BlockId")
    mesh.GetCellData().AddArray(block)
    writer = vtkEnSightWriter()
    writer.SetPath(str(folder))
    writer.SetBaseName("v")
    write_vtk(writer, mesh, folder / "v")
    writer.WriteCaseFile(1)
    return next(folder.glob("*.case"))


def _points(values: np.ndarray) -> list[np.ndarray]:
    """Coordinates along x, y, z of every point, each (z, y, x)."""
    axes = [o + s * np.arange(n) for o, s, n in zip(ORIGIN, SPACING, values.shape[::-1], strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    return [x, y, z]


def _xdmf2(folder: Path, values: np.ndarray) -> Path:
    from vtkmodules.vtkIOXdmf2 import vtkXdmfWriter

    return write_vtk(vtkXdmfWriter(), vtk_image(values), folder / "v.xmf")


def _xdmf3(folder: Path, values: np.ndarray) -> Path:
    """An index beside HDF5, as scripts write it."""
    import h5py

    with h5py.File(folder / "v.h5", "w") as file:
        file["values"] = values.astype(np.float32)
    size = " ".join(map(str, values.shape))
    origin, step = (" ".join(map(str, place[::-1])) for place in (ORIGIN, SPACING))
    item = '<DataItem Dimensions="3" NumberType="Float" Precision="8" Format="XML">'
    (folder / "v.xdmf").write_text(
        f"""<?xml version="1.0"?>
<Xdmf Version="3.0"><Domain><Grid Name="grid" GridType="Uniform">
<Topology TopologyType="3DCoRectMesh" Dimensions="{size}"/>
<Geometry GeometryType="ORIGIN_DXDYDZ">{item}{origin}</DataItem>{item}{step}</DataItem></Geometry>
<Attribute Name="values" AttributeType="Scalar" Center="Node">
<DataItem Dimensions="{size}" NumberType="Float" Precision="4" Format="HDF">v.h5:/values</DataItem></Attribute>
</Grid></Domain></Xdmf>"""
    )
    return folder / "v.xdmf"


def _cgns(folder: Path, values: np.ndarray) -> Path:
    """A structured zone: https://cgns.github.io/standard/FMM/hdf5.html."""
    from tests.vtk_files import write_cgns

    return write_cgns(folder / "v.cgns", _points(values), {"values": values.astype(np.float64)})


def _plot3d(folder: Path, values: np.ndarray) -> Path:
    """Binary, whole and a function file, beside ParaView's index."""
    size = np.array(values.shape[::-1], "<i4").tobytes()
    (folder / "v.xyz").write_bytes(size + np.array(_points(values), "<f4").tobytes())
    (folder / "v.f").write_bytes(size + np.array(1, "<i4").tobytes() + values.astype("<f4").tobytes())
    told = {"format": "binary", "byte-order": "little", "precision": 32, "language": "C"}
    files = [{"time": 0, "xyz": "v.xyz", "function": "v.f"}]
    (folder / "v.p3d").write_text(json.dumps({**told, "filenames": files}))
    return folder / "v.p3d"


def _by_vtk_plot3d(path: Path) -> Any:
    from vtkmodules.vtkIOParallel import vtkPlot3DMetaReader

    reader = vtkPlot3DMetaReader()
    reader.SetFileName(str(path))
    reader.Update()
    return reader.GetOutputDataObject(0)


def _openfoam(folder: Path, values: np.ndarray) -> Path:
    """A case in ASCII, the values those of its cells."""
    from tests.vtk_files import write_openfoam

    axes = [o + s * (np.arange(n + 1) - 0.5) for o, s, n in zip(ORIGIN, SPACING, values.shape[::-1], strict=True)]
    return write_openfoam(folder, axes, {"0": values})


def _by_vtk_foam(path: Path) -> Any:
    from vtkmodules.vtkIOGeometry import vtkOpenFOAMReader

    reader = vtkOpenFOAMReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    reader.EnableAllCellArrays()
    reader.Update()
    return reader.GetOutputDataObject(0)


SIMULATIONS = (
    Row("MINC 1", "VTK", "MINC", _minc1, by_vtk("vtkIOMINC.vtkMINCImageReader")),
    Row("EnSight Gold", "VTK", "EnSight", _ensight, by_vtk("vtkIOEnSight.vtkGenericEnSightReader"), most=64),
    Row("OpenFOAM", "by hand", "OpenFOAM", _openfoam, _by_vtk_foam, most=64, cells=True),
    Row("XDMF 2", "VTK", "XDMF", _xdmf2, by_vtk("vtkIOXdmf2.vtkXdmfReader")),
    Row("XDMF 3", "h5py", "XDMF", _xdmf3, by_vtk("vtkIOXdmf2.vtkXdmfReader")),
    Row("CGNS", "h5py", "CGNS", _cgns, by_vtk("vtkIOCGNSReader.vtkCGNSReader"), most=64),
    Row("Plot3D", "numpy", "Plot3D", _plot3d, _by_vtk_plot3d, most=64, steps=False),
)
