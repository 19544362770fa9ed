"""Files of VTK's family with the ramp of tests/ramps.py in them, by VTK's writers, h5py, or by hand as text.

Each function writes into a folder and returns the file to open. Values of step k are the ramp and 1000 k; cells have
the ramp at their centres.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyvista as pv
from vtkmodules import vtkIOParallelXML, vtkIOXML
from vtkmodules.vtkCommonDataModel import vtkAMRBox, vtkOverlappingAMR, vtkUniformGrid
from vtkmodules.vtkImagingCore import vtkRTAnalyticSource
from vtkmodules.vtkIOHDF import vtkHDFWriter
from vtkmodules.vtkIOIOSS import vtkIOSSWriter
from vtkmodules.vtkIOXdmf2 import vtkXdmfWriter

from tests.ramps import X, Y, Z, ramp

STEP = 1000.0
TIMES = (0.5, 1.25)


def centres(axis: np.ndarray) -> np.ndarray:
    return (axis[:-1] + axis[1:]) / 2


def image(lo: int = 0, hi: int = 4, step: int = 0) -> pv.ImageData:
    """The points of x from ``lo`` to ``hi`` (both in it), with the ramp on points and cells."""
    grid = pv.ImageData(dimensions=(hi - lo + 1, 4, 3), spacing=(0.25, 0.5, 2.0), origin=(X[lo], Y[0], Z[0]))
    x = X[lo : hi + 1]
    grid.point_data["ramp"] = (ramp(x, Y, Z) + STEP * step).ravel()
    grid.cell_data["cells"] = (ramp(*map(centres, (x, Y, Z))) + STEP * step).ravel()
    return grid


def hexahedra(lo: int = 0, hi: int = 4, step: int = 0) -> pv.UnstructuredGrid:
    return image(lo, hi, step).cast_to_structured_grid().cast_to_unstructured_grid()


def write(writer: Any, data: Any, path: Path, **settings: Any) -> Path:
    for key, value in settings.items():
        getattr(writer, f"Set{key}")(*value if isinstance(value, tuple) else (value,))
    writer.SetInputDataObject(0, data)
    writer.SetFileName(str(path))
    writer.Write()
    return path


def pieces(folder: Path, kind: str) -> Path:
    """``.pvtu``, ``.pvtr`` or ``.pvts`` of two pieces that VTK's writers wrote, the index by hand as they write it."""
    word = {"pvtu": "UnstructuredGrid", "pvtr": "RectilinearGrid", "pvts": "StructuredGrid"}[kind]
    for k, (lo, hi) in enumerate(((0, 2), (2, 4))):
        part = {"pvtu": hexahedra, "pvtr": lambda *a: image(*a).cast_to_rectilinear_grid(),
                "pvts": lambda *a: image(*a).cast_to_structured_grid()}[kind](lo, hi)  # fmt: skip
        part.save(folder / f"part{k}.{kind[1:]}")
    extents = [f' Extent="{lo} {hi} 0 3 0 2"' if kind != "pvtu" else "" for lo, hi in ((0, 2), (2, 4))]
    whole = ' WholeExtent="0 4 0 3 0 2"' if kind != "pvtu" else ""
    text = f'<VTKFile type="P{word}" version="0.1"><P{word}{whole} GhostLevel="0"><PPointData/>'
    text += "".join(f'<Piece{extent} Source="part{k}.{kind[1:]}"/>' for k, extent in enumerate(extents))
    path = folder / f"v.{kind}"
    path.write_text(f"{text}</P{word}></VTKFile>")
    return path


def multiblock(folder: Path, images: bool = False) -> Path:
    made = image if images else hexahedra
    blocks = pv.MultiBlock(
        {"left": made(0, 2), "right": made(2, 4), "skin": hexahedra().extract_surface(algorithm=None)}
    )
    return write(vtkIOXML.vtkXMLMultiBlockDataWriter(), blocks, folder / "v.vtm")


def amr(folder: Path) -> Path:
    """Two levels: 4 x 4 x 4 cells of 1, and of those x < 2 again, as cells of 0.5 (their values 1 higher)."""
    found = vtkOverlappingAMR()
    found.Initialize([1, 1])
    found.SetOrigin((10.0, 20.0, 30.0))
    found.SetGridDescription(8)  # x, y and z
    for level, n, edge in ((0, (4, 4, 4), 1.0), (1, (4, 8, 8), 0.5)):
        found.SetSpacing(level, (edge,) * 3)
        grid = vtkUniformGrid()
        grid.SetDimensions(*(k + 1 for k in n))
        grid.SetSpacing(edge, edge, edge)
        grid.SetOrigin(10.0, 20.0, 30.0)
        axes = [o + edge * (np.arange(k) + 0.5) for o, k in zip((10, 20, 30), n, strict=True)]
        grid.GetCellData().SetScalars(pv.convert_array((ramp(*axes) + level).ravel(), name="cells"))
        found.SetAMRBox(level, 0, vtkAMRBox((0, 0, 0), tuple(k - 1 for k in n)))
        found.SetDataSet(level, 0, grid)
    return write(vtkIOXML.vtkXMLUniformGridAMRWriter(), found, folder / "v.vthb")


def hdf_root(file: h5py.File, kind: str) -> h5py.Group:
    root = file.create_group("VTKHDF")
    root.attrs["Version"] = np.array([2, 0])
    root.attrs.create("Type", kind.encode(), dtype=h5py.string_dtype("ascii", len(kind)))
    return root


def hdf_amr(folder: Path) -> Path:
    """The levels of `amr`, by h5py: https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format."""
    path = folder / "v.vtkhdf"
    with h5py.File(path, "w") as file:
        root = hdf_root(file, "OverlappingAMR")
        root.attrs["Origin"] = np.array([10.0, 20.0, 30.0])
        root.attrs.create("GridDescription", b"XYZ", dtype=h5py.string_dtype("ascii", 3))
        for level, n, edge in ((0, (4, 4, 4), 1.0), (1, (4, 8, 8), 0.5)):
            group = root.create_group(f"Level{level}")
            group.attrs["Spacing"] = np.full(3, edge)
            group["AMRBox"] = np.array([[0, n[0] - 1, 0, n[1] - 1, 0, n[2] - 1]])
            axes = [o + edge * (np.arange(k) + 0.5) for o, k in zip((10, 20, 30), n, strict=True)]
            group["CellData/cells"] = (ramp(*axes) + level).ravel()
            group.create_group("PointData")
            group.create_group("FieldData")
    return path


def collection(folder: Path, suffix: str = "vti") -> Path:
    """A ``.pvd`` of two steps, each a ``.vti``; or of two parts each, ``.vtu``."""
    rows = []
    for k, time in enumerate(TIMES):
        parts = [image(step=k)] if suffix == "vti" else [hexahedra(0, 2, k), hexahedra(2, 4, k)]
        for n, part in enumerate(parts):
            part.save(folder / f"s{k}_{n}.{suffix}")
            rows.append(f'<DataSet timestep="{time}" group="" part="{n}" file="s{k}_{n}.{suffix}"/>')
    path = folder / "v.pvd"
    path.write_text(
        f'<?xml version="1.0"?>\n<VTKFile type="Collection"><Collection>{"".join(rows)}</Collection></VTKFile>'
    )
    return path


def series(folder: Path, suffix: str) -> Path:
    """ParaView's JSON, of ``.vtk`` or ``.vtm``."""
    for k in range(2):
        if suffix == "vtk":
            image(step=k).save(folder / f"s{k}.vtk")
        else:
            blocks = pv.MultiBlock({"a": hexahedra(0, 2, k), "b": hexahedra(2, 4, k)})
            write(vtkIOXML.vtkXMLMultiBlockDataWriter(), blocks, folder / f"s{k}.vtm")
    rows = [{"name": f"s{k}.{suffix}", "time": time} for k, time in enumerate(TIMES)]
    path = folder / f"v.{suffix}.series"
    path.write_text(json.dumps({"file-series-version": "1.0", "files": rows}))
    return path


def hdf_image(folder: Path) -> Path:
    return write(vtkHDFWriter(), image(), folder / "v.vtkhdf")


def hdf_mesh(folder: Path) -> Path:
    return write(vtkHDFWriter(), hexahedra(), folder / "v.vtkhdf")


def hdf_steps(folder: Path) -> Path:
    """An image of two steps, by h5py: https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format."""
    path = folder / "v.vtkhdf"
    with h5py.File(path, "w") as file:
        root = hdf_root(file, "ImageData")
        root.attrs["WholeExtent"] = np.array([0, 4, 0, 3, 0, 2])
        root.attrs["Origin"], root.attrs["Spacing"] = np.array([X[0], Y[0], Z[0]]), np.array([0.25, 0.5, 2.0])
        root.attrs["Direction"] = np.eye(3).ravel()
        root.create_dataset("PointData/ramp", data=np.stack([ramp(X, Y, Z) + STEP * k for k in range(2)]))
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = 2
        steps["Values"] = np.array(TIMES)
        steps["PointDataOffsets/ramp"] = np.arange(2)
    return path


def exodus(folder: Path) -> Path:
    return write(vtkIOSSWriter(), hexahedra(), folder / "v.exo")


def xdmf2(folder: Path) -> Path:
    return write(vtkXdmfWriter(), hexahedra(), folder / "v.xmf")


def xdmf3(folder: Path) -> Path:
    """Two steps of an image, version 3, values in HDF5."""
    grids = ""
    with h5py.File(folder / "v.h5", "w") as file:
        for k, time in enumerate(TIMES):
            file[f"step{k}/ramp"] = ramp(X, Y, Z) + STEP * k
            grids += f"""<Grid Name="step{k}" GridType="Uniform"><Time Value="{time}"/>
<Topology TopologyType="3DCoRectMesh" Dimensions="3 4 5"/>
<Geometry GeometryType="ORIGIN_DXDYDZ">
<DataItem Format="XML" Dimensions="3" NumberType="Float" Precision="8">{Z[0]} {Y[0]} {X[0]}</DataItem>
<DataItem Format="XML" Dimensions="3" NumberType="Float" Precision="8">2.0 0.5 0.25</DataItem></Geometry>
<Attribute Name="ramp" AttributeType="Scalar" Center="Node">
<DataItem Format="HDF" Dimensions="3 4 5" NumberType="Float" Precision="8">v.h5:/step{k}/ramp</DataItem></Attribute>
</Grid>"""
    path = folder / "v.xdmf"
    path.write_text(
        '<?xml version="1.0"?>\n<Xdmf Version="3.0"><Domain><Grid Name="all" GridType="Collection" '
        f'CollectionType="Temporal">{grids}</Grid></Domain></Xdmf>'
    )
    return path


def numbers(values: np.ndarray) -> str:
    return "".join(f"{value:12.5e}\n" for value in np.ravel(values))


def ensight(folder: Path) -> Path:
    """EnSight Gold in ASCII: a block of 5 x 4 x 3 points, two steps of a variable of nodes, one of elements."""
    x, y, z = (np.broadcast_to(a, (3, 4, 5)) for a in (X, Y[:, None], Z[:, None, None]))
    (folder / "v.geo").write_text(
        "a ramp\nby hand\nnode id off\nelement id off\npart\n         1\nbox\nblock\n         5         4         3\n"
        + numbers(x) + numbers(y) + numbers(z)
    )  # fmt: skip
    for k in range(2):
        values = numbers(ramp(X, Y, Z) + STEP * k)
        (folder / f"v.ramp.{k:02d}").write_text(f"ramp\npart\n         1\nblock\n{values}")
        values = numbers(ramp(*map(centres, (X, Y, Z))) + STEP * k)
        (folder / f"v.cells.{k:02d}").write_text(f"cells\npart\n         1\nblock\n{values}")
    path = folder / "v.case"
    path.write_text(
        "FORMAT\ntype: ensight gold\nGEOMETRY\nmodel: v.geo\nVARIABLE\nscalar per node: 1 ramp v.ramp.**\n"
        "scalar per element: 1 cells v.cells.**\nTIME\ntime set: 1\nnumber of steps: 2\nfilename start number: 0\n"
        f"filename increment: 1\ntime values: {TIMES[0]} {TIMES[1]}\n"
    )
    return path


def foam_text(kind: str, name: str, body: str) -> str:
    return f"FoamFile\n{{\nversion 2.0;\nformat ascii;\nclass {kind};\nobject {name};\n}}\n{body}\n"


def openfoam(folder: Path) -> Path:
    """A case of 4 x 3 x 2 hexahedra, two times of a field of cells."""
    fields = {str(time): ramp(*map(centres, (X, Y, Z))) + STEP * k for k, time in enumerate(TIMES)}
    return write_openfoam(folder, (X, Y, Z), fields)


def _foam_faces(n: tuple[int, ...]) -> list[np.ndarray]:
    """Of each axis (faces, 6): four points, the cell on its lower side, that on its upper, -1 where none is."""
    points = np.arange(int(np.prod(np.add(n, 1)))).reshape(np.add(n, 1)[::-1]).transpose()  # x, y, z
    found = []
    for axis in range(3):
        grid = np.moveaxis(points, (axis, (axis + 1) % 3, (axis + 2) % 3), (0, 1, 2))
        four = [grid[:, :-1, :-1], grid[:, 1:, :-1], grid[:, 1:, 1:], grid[:, :-1, 1:]]
        cells = np.arange(int(np.prod(n))).reshape(n[::-1]).transpose()
        cells = np.moveaxis(cells, (axis, (axis + 1) % 3, (axis + 2) % 3), (0, 1, 2))
        edge = np.full((1, *cells.shape[1:]), -1)
        sides = np.concatenate([edge, cells]), np.concatenate([cells, edge])
        found.append(np.stack([part.ravel() for part in (*four, *sides)], axis=1))
    return found


def write_openfoam(folder: Path, axes: Sequence[np.ndarray], fields: dict[str, np.ndarray]) -> Path:
    """A case in ASCII of hexahedra between the planes of ``axes``, with the ``cells`` (z, y, x) of each time."""
    faces = np.concatenate(_foam_faces(tuple(len(axis) - 1 for axis in axes)))
    turned = faces[:, 4] < 0  # they point out of their owner
    faces[turned] = faces[turned][:, [3, 2, 1, 0, 5, 4]]
    inner = faces[faces[:, 5] >= 0]
    inner = inner[np.lexsort((inner[:, 5], inner[:, 4]))]
    faces = np.concatenate([inner, faces[faces[:, 5] < 0]])
    mesh = folder / "constant" / "polyMesh"
    mesh.mkdir(parents=True)
    (folder / "system").mkdir()
    x, y, z = axes
    places = [f"({a} {b} {c})" for c in z for b in y for a in x]
    for name, kind, rows in (
        ("points", "vectorField", places),
        ("faces", "faceList", ["4({} {} {} {})".format(*row) for row in faces[:, :4].tolist()]),
        ("owner", "labelList", list(map(str, faces[:, 4].tolist()))),
        ("neighbour", "labelList", list(map(str, inner[:, 5].tolist()))),
    ):
        (mesh / name).write_text(foam_text(kind, name, f"{len(rows)}\n(\n" + "\n".join(rows) + "\n)"))
    walls = f"1\n(\nwalls\n{{\ntype wall;\nnFaces {len(faces) - len(inner)};\nstartFace {len(inner)};\n}}\n)"
    (mesh / "boundary").write_text(foam_text("polyBoundaryMesh", "boundary", walls))
    control = (
        "application x; startFrom startTime; startTime 0; stopAt endTime; endTime 2; deltaT 0.25; writeInterval 1;"
    )
    (folder / "system" / "controlDict").write_text(foam_text("dictionary", "controlDict", control))
    for time, values in fields.items():
        (folder / time).mkdir()
        listed = "\n".join(map(str, values.ravel().tolist()))
        body = f"dimensions [0 0 0 0 0 0 0];\ninternalField nonuniform List<scalar>\n{values.size}\n(\n{listed}\n)\n;\n"
        body += "boundaryField\n{\nwalls\n{\ntype zeroGradient;\n}\n}"
        (folder / time / "cells").write_text(foam_text("volScalarField", "cells", body))
    path = folder / "v.foam"
    path.touch()
    return path


def plot3d(folder: Path) -> Path:
    """Coordinates and a function file in ASCII, described by ParaView's ``.p3d``."""
    x, y, z = (np.broadcast_to(a, (3, 4, 5)) for a in (X, Y[:, None], Z[:, None, None]))
    (folder / "v.xyz").write_text("5 4 3\n" + numbers(x) + numbers(y) + numbers(z))
    (folder / "v.f").write_text("5 4 3 1\n" + numbers(ramp(X, Y, Z)))
    path = folder / "v.p3d"
    path.write_text(json.dumps({"format": "ascii", "filenames": [{"time": 0, "xyz": "v.xyz", "function": "v.f"}]}))
    return path


def cgns(folder: Path) -> Path:
    points = [np.broadcast_to(a, (3, 4, 5)) for a in (X, Y[:, None], Z[:, None, None])]
    return write_cgns(folder / "v.cgns", points, {"ramp": ramp(X, Y, Z)}, {"cells": ramp(*map(centres, (X, Y, Z)))})


def write_cgns(
    path: Path, points: Sequence[np.ndarray], nodes: dict[str, np.ndarray], cells: dict[str, np.ndarray] | None = None
) -> Path:
    """A structured zone by h5py: https://cgns.github.io/standard/FMM/hdf5.html; nodes and cell centres, (z, y, x)."""

    def node(parent: Any, name: str, label: str, values: Any = None) -> Any:
        group = parent.create_group(name, track_order=True)
        kinds = {"int32": "I4", "int64": "I8", "float32": "R4", "float64": "R8", "int8": "C1"}
        data = np.frombuffer(values, np.int8) if isinstance(values, bytes) else values
        for key, text, size in (("name", name, 33), ("label", label, 33)):
            group.attrs.create(key, text.encode(), dtype=f"S{size}")
        group.attrs.create("type", b"MT" if data is None else kinds[data.dtype.name].encode(), dtype="S3")
        group.attrs.create("flags", np.array([1], np.int32))
        if data is not None:
            group.create_dataset(" data", data=data)
        return group

    with h5py.File(path, "w", track_order=True) as file:
        file.attrs.create("name", b"HDF5 MotherNode", dtype="S33")
        file.attrs.create("label", b"Root Node of HDF5 File", dtype="S33")
        file.attrs.create("type", b"MT", dtype="S3")
        file.create_dataset(" format", data=np.frombuffer(b"IEEE_LITTLE_32\0", np.int8))
        file.create_dataset(" hdf5version", data=np.frombuffer(b"HDF5 Version 1.8.15".ljust(33, b"\0"), np.int8))
        node(file, "CGNSLibraryVersion", "CGNSLibraryVersion_t", np.array([3.3], np.float32))
        base = node(file, "Base", "CGNSBase_t", np.array([3, 3], np.int32))
        size = np.array(points[0].shape[::-1])
        zone = node(base, "Zone", "Zone_t", np.array([size, size - 1, 0 * size], np.int32))
        node(zone, "ZoneType", "ZoneType_t", b"Structured")
        grid = node(zone, "GridCoordinates", "GridCoordinates_t")
        for k, a in enumerate(points):
            node(grid, f"Coordinate{'XYZ'[k]}", "DataArray_t", np.array(a, np.float64))
        for name, place, fields in (("Nodes", b"Vertex", nodes), ("Cells", b"CellCenter", cells or {})):
            found = node(zone, name, "FlowSolution_t")
            node(found, "GridLocation", "GridLocation_t", place)
            for label, values in fields.items():
                node(found, label, "DataArray_t", values)
    return path


def wavelet(n: int = 12) -> vtkRTAnalyticSource:
    """n x n x (n - 2) points from (3, -2, 5) on, which VTK's writer can ask for in parts."""
    source = vtkRTAnalyticSource()
    source.SetWholeExtent(3, n + 2, -2, n - 3, 5, n + 2)
    source.SetCenter(n / 2, n / 2, n / 2)
    return source


def parallel_image(folder: Path, source: Any, count: int, **settings: Any) -> Path:
    """A ``.pvti`` of ``count`` pieces that VTK's writer cut what an algorithm gives into."""
    writer = vtkIOParallelXML.vtkXMLPImageDataWriter()
    for key, value in settings.items():
        getattr(writer, f"Set{key}")(value)
    writer.SetInputConnection(source.GetOutputPort())
    writer.SetFileName(str(folder / "v.pvti"))
    writer.SetNumberOfPieces(count)
    writer.SetStartPiece(0)
    writer.SetEndPiece(count - 1)
    writer.Write()
    return folder / "v.pvti"
