"""VTK meshes and grids, written by VTK: resampled, checked against a field that is linear in position."""

from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from vtkmodules.vtkIOHDF import vtkHDFWriter
from vtkmodules.vtkIOLegacy import vtkDataSetWriter

from tests.ramps import X, Y, Z, axes_of, check_ramp
from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.registry import contents

BOUNDS = [(X[0], X[-1]), (Y[0], Y[-1]), (Z[0], Z[-1])]


def with_ramp(mesh: pv.DataSet) -> pv.DataSet:
    x, y, z = np.asarray(mesh.points).T
    mesh.point_data["ramp"] = 1 + 2 * x + 30 * y + 500 * z
    mesh.point_data["vector"] = np.column_stack([x, y, z])
    return mesh


def rectilinear() -> pv.RectilinearGrid:
    return with_ramp(pv.RectilinearGrid(X**2 / X[-1] * 0 + X, np.array([-3.0, -2.8, -2.0, -1.5]), Z))


def structured() -> pv.StructuredGrid:
    return with_ramp(pv.StructuredGrid(*np.meshgrid(X, Y, Z, indexing="ij")))


def tetrahedra() -> pv.UnstructuredGrid:
    return with_ramp(structured().delaunay_3d())


def legacy(mesh: pv.DataSet, path: Path, *, binary: bool, version: int = 51) -> None:
    writer = vtkDataSetWriter()
    writer.SetFileVersion(version)
    writer.SetInputData(mesh)
    writer.SetFileName(str(path))
    (writer.SetFileTypeToBinary if binary else writer.SetFileTypeToASCII)()
    writer.Write()


def hdf(mesh: pv.DataSet, path: Path) -> None:
    writer = vtkHDFWriter()
    writer.SetInputData(mesh)
    writer.SetFileName(str(path))
    writer.Write()


@pytest.mark.parametrize(("make", "suffix"), [(rectilinear, "vtr"), (structured, "vts"), (tetrahedra, "vtu")])
@pytest.mark.parametrize("form", ["xml", "ascii", "binary", "old"])
def test_every_mesh_and_coding(tmp_path: Path, make, suffix: str, form: str) -> None:
    path = tmp_path / ("v." + (suffix if form == "xml" else "vtk"))
    if form == "xml":
        make().save(path)
    else:
        legacy(make(), path, binary=form != "ascii", version=42 if form == "old" else 51)
    volume = read_volume(str(path), ReadOptions(dims=(8, 7, 6), array="ramp"))
    assert volume.dims == (8, 7, 6)
    assert volume.name == "v (resampled to 8 x 7 x 6)"
    for along, (lo, hi) in zip(axes_of(volume), BOUNDS, strict=True):  # voxels fill the box
        step = (hi - lo) / len(along)
        np.testing.assert_allclose(along, lo + step / 2 + step * np.arange(len(along)), rtol=1e-6)
    assert np.isfinite(volume.data).all()
    check_ramp(volume, atol=0.1)


def test_without_dims_voxels_are_cubes_about_as_many_as_cells(tmp_path: Path) -> None:
    structured().save(tmp_path / "v.vts")
    volume = read_volume(str(tmp_path / "v.vts"), ReadOptions(array="ramp"))
    nx, ny, nz = volume.dims
    assert 4 * 3 * 2 <= nx * ny * nz <= 2 * 4 * 3 * 2
    assert max(volume.spacing) < 1.5 * min(volume.spacing)
    check_ramp(volume, atol=0.1)


def test_outside_of_the_mesh_is_nan_and_cell_data_constant(tmp_path: Path) -> None:
    ball = pv.Sphere(radius=1.0).delaunay_3d()
    ball.clear_data()
    ball.cell_data["where"] = np.asarray(ball.cell_centers().points)[:, 0] > 0
    ball.cell_data["where"] = ball.cell_data["where"].astype("u1")
    ball.save(tmp_path / "v.vtu")
    volume = read_volume(str(tmp_path / "v.vtu"), ReadOptions(dims=(20, 20, 20)))
    assert abs(np.isfinite(volume.data).mean() - np.pi / 6) < 0.05
    assert np.isnan(volume.data[0, 0, 0])
    assert set(np.unique(volume.data[np.isfinite(volume.data)])) == {0.0, 1.0}
    assert np.nanmean(volume.data[:, :, 12:]) > 0.8
    assert np.nanmean(volume.data[:, :, :8]) < 0.2


def test_vtkhdf_meshes_and_images(tmp_path: Path) -> None:
    hdf(tetrahedra(), tmp_path / "v.vtkhdf")
    volume = read_volume(str(tmp_path / "v.vtkhdf"), ReadOptions(dims=(8, 7, 6), array="ramp"))
    check_ramp(volume, atol=0.1)
    hdf(pv.Sphere(), tmp_path / "s.hdf")
    refused(DataError, r"a surface \(vtkPolyData\)", read_volume, str(tmp_path / "s.hdf"))


def test_components_and_choices(tmp_path: Path) -> None:
    path = tmp_path / "v.vts"
    structured().save(path)
    along = read_volume(str(path), ReadOptions(dims=(4, 3, 2), array="vector", component=1))
    np.testing.assert_allclose(along.data[0, :, 0], axes_of(along)[1], rtol=1e-6)
    for options, message in (
        (ReadOptions(array="vector"), r"array 'vector' has 3 components .*--component 0 to 2"),
        (ReadOptions(array="vector", component=3), "not component 3"),
        (ReadOptions(array="none"), "no array 'none'"),
        (ReadOptions(array="ramp", spacing=(1, 1, 1)), "leave out --spacing"),
        (ReadOptions(array="ramp", dtype="uint8"), "leave out --dtype"),
    ):
        refused(UsageError, message, read_volume, str(path), options)


def test_a_warning_of_vtk_is_a_message(tmp_path: Path) -> None:
    legacy(rectilinear(), tmp_path / "v.vtk", binary=True)
    body = (tmp_path / "v.vtk").read_bytes()
    (tmp_path / "v.vtk").write_bytes(body.replace(b"Version 5.1", b"Version 9.9"))
    how = ReadOptions(array="ramp", dims=(3, 3, 3))
    with pytest.warns(UserWarning, match="VTK says: Reading file version: 9.9 with older reader"):
        check_ramp(read_volume(str(tmp_path / "v.vtk"), how))
    (tmp_path / "v.vtk").write_bytes(body[:-200])
    refused(DataError, "whole", read_volume, str(tmp_path / "v.vtk"), how)


def test_arrays_of_a_mesh_are_listed_with_their_options(tmp_path: Path, vvgt) -> None:
    mesh = tetrahedra()
    mesh.point_data["ramp"][:] = 7
    mesh.save(tmp_path / "v.vtu")
    rows = contents(str(tmp_path / "v.vtu"), ReadOptions())["arrays"]
    assert rows[0]["range"] == [7, 7]
    assert [(row["array"], row["components"], row["option"]) for row in rows] == [
        ("ramp", 1, "--array ramp"),
        ("vector", 3, "--array vector"),
    ]
    assert b"--array vector" in vvgt("info", tmp_path / "v.vtu").out


def test_lies_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "v.vtu"
    tetrahedra().save(path, binary=False)
    text = path.read_text()
    for old, new, message in (
        ('NumberOfPoints="60"', 'NumberOfPoints="6000000000"', "whole"),
        ('NumberOfCells="', 'NumberOfCells="9000000', "whole"),
        ("<Cells>", "<Sells>", "damaged"),
    ):
        path.write_text(text.replace(old, new))
        refused(DataError, message, read_volume, str(path), ReadOptions(array="ramp"))
    legacy(tetrahedra(), tmp_path / "v.vtk", binary=False, version=42)
    text = (tmp_path / "v.vtk").read_text()
    for old, new, message in (
        ("POINTS 60 ", "POINTS 6000000000 ", "whole"),
        ("\n4 ", "\n4 777", "name points that do not exist"),
    ):
        assert old in text
        (tmp_path / "v.vtk").write_text(text.replace(old, new, 1))
        refused(DataError, message, read_volume, str(tmp_path / "v.vtk"), ReadOptions(array="ramp"))
