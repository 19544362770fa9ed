"""Indexes of VTK files, and other programs' files that VTK reads (tests/vtk_files.py): places, values, steps."""

import json
import re
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import pyvista as pv
from vtkmodules import vtkIOXML

from tests import vtk_files as files
from tests.ramps import X, Y, Z, axes_of, check_grid, ramp
from tests.refused import refused
from vvgt_cli.errors import DataError, SeveralSteps, UsageError
from vvgt_cli.volume import ReadOptions, Volume, read_volume
from vvgt_cli.volume.registry import contents, time_steps
from vvgt_cli.volume.stored import Stored

BOUNDS = [(X[0], X[-1]), (Y[0], Y[-1]), (Z[0], Z[-1])]
MM = 0.01
Make = Callable[[Path], Path]
MESHES: dict[str, Make] = {
    "pvtu": lambda f: files.pieces(f, "pvtu"),
    "pvtr": lambda f: files.pieces(f, "pvtr"),
    "pvts": lambda f: files.pieces(f, "pvts"),
    "vtm": files.multiblock,
    "vtkhdf": files.hdf_mesh,
    "exodus": files.exodus,
    "xdmf 2": files.xdmf2,
    "cgns": files.cgns,
}
STEPS: dict[str, Make] = {
    "pvd of parts": lambda f: files.collection(f, "vtu"),
    "vtm.series": lambda f: files.series(f, "vtm"),
    "ensight": files.ensight,
    "openfoam": files.openfoam,
}
IMAGES: dict[str, Make] = {"vtm of images": lambda f: files.multiblock(f, images=True), "vtkhdf": files.hdf_image}
IMAGE_STEPS: dict[str, Make] = {
    "pvd": files.collection,
    "vtk.series": lambda f: files.series(f, "vtk"),
    "vtkhdf": files.hdf_steps,
    "xdmf 3": files.xdmf3,
}


def check_place(volume: Volume) -> None:
    """Voxels fill the box of the mesh."""
    for along, (lo, hi), n in zip(axes_of(volume), BOUNDS, volume.dims, strict=True):
        step = (hi - lo) / n
        np.testing.assert_allclose(along, lo + step / 2 + step * np.arange(n), atol=MM)


def check_samples(path: Path, step: int | None, *arrays: str) -> None:
    """Points are interpolated, cells are what they are; everything is where it belongs."""
    rise = files.STEP * (step or 0)
    for array in arrays:
        dims = (8, 6, 4) if array == "ramp" else (4, 3, 2)
        volume = read_volume(str(path), ReadOptions(array=array, dims=dims, time=step))
        assert volume.dims == dims
        assert volume.name.endswith(f"(resampled to {' x '.join(map(str, dims))})")
        check_place(volume)
        np.testing.assert_allclose(volume.data, ramp(*axes_of(volume)) + rise, atol=0.05)


@pytest.mark.parametrize("suffix", ["vts", "vtu"])
def test_a_mesh_that_was_cut_off_within_its_last_values_is_a_line(tmp_path: Path, suffix: str) -> None:
    writer = vtkIOXML.vtkXMLStructuredGridWriter() if suffix == "vts" else vtkIOXML.vtkXMLUnstructuredGridWriter()
    data = files.image().cast_to_structured_grid() if suffix == "vts" else files.hexahedra()
    writer.SetCompressorTypeToNone()
    path = files.write(writer, data, tmp_path / f"a.{suffix}", EncodeAppendedData=False)
    assert read_volume(str(path), ReadOptions(array="ramp", dims=(4, 3, 2))).dims == (4, 3, 2)
    path.write_bytes(path.read_bytes()[:-60])
    refused(DataError, "was cut off", read_volume, str(path), ReadOptions(array="ramp", dims=(4, 3, 2)))


@pytest.mark.parametrize("kind", MESHES)
def test_meshes_of_several_files_and_programs_are_resampled(tmp_path: Path, kind: str) -> None:
    check_samples(MESHES[kind](tmp_path), None, "ramp", *["cells"] * (kind in ("pvtu", "exodus", "cgns")))


@pytest.mark.parametrize("kind", STEPS)
def test_steps_of_meshes_are_chosen_by_time(tmp_path: Path, kind: str) -> None:
    path = STEPS[kind](tmp_path)
    assert time_steps(str(path), ReadOptions()) == [(time, "") for time in files.TIMES]
    for step in range(2):
        check_samples(path, step, "cells" if step or kind == "openfoam" else "ramp")
    with pytest.raises(SeveralSteps) as raised:
        read_volume(str(path), ReadOptions(array="cells"))
    assert tuple(raised.value.times) == files.TIMES


@pytest.mark.parametrize("kind", IMAGES)
def test_images_are_read_as_they_are(tmp_path: Path, kind: str) -> None:
    path = IMAGES[kind](tmp_path)
    check_grid(read_volume(str(path), ReadOptions(array="ramp")))
    cells = read_volume(str(path), ReadOptions(array="cells"))
    assert cells.dims == (4, 3, 2)
    np.testing.assert_allclose(cells.origin, [X[0] + 0.125, Y[0] + 0.25, Z[0] + 1], atol=MM)
    np.testing.assert_allclose(cells.data, ramp(*axes_of(cells)))


@pytest.mark.parametrize("make", [files.hdf_image, files.hdf_steps])
def test_vtkhdf_images_stay_in_their_file_and_are_what_vtk_reads(tmp_path, monkeypatch, make) -> None:
    path, time = make(tmp_path), 1 if make is files.hdf_steps else None
    arrays = ("ramp",) if time else ("ramp", "cells")
    found = {}
    for array in arrays:
        stored = read_volume(str(path), ReadOptions(array=array, time=time, stored=True))
        assert isinstance(stored.data, Stored)
        found[array] = read_volume(str(path), ReadOptions(array=array, time=time))
        np.testing.assert_array_equal(stored.data[1:2, 1:3, 2:3], found[array].data[1:2, 1:3, 2:3])
    with pytest.raises(UsageError, match="leave out --dims"):
        read_volume(str(path), ReadOptions(array="ramp", time=time, dims=(8, 6, 4)))
    monkeypatch.setitem(sys.modules, "h5py", None)  # not installed: by VTK, as a whole
    for array in arrays:
        volume = read_volume(str(path), ReadOptions(array=array, time=time, stored=True))
        np.testing.assert_array_equal(volume.data, found[array].data)
        assert volume.data.dtype == found[array].data.dtype
        np.testing.assert_allclose(volume.affine, found[array].affine)
        assert volume.name == found[array].name


def test_a_component_of_a_vtkhdf_image(tmp_path: Path) -> None:
    path = files.hdf_image(tmp_path)
    with h5py.File(path, "r+") as file:
        ramp = file["VTKHDF/PointData/ramp"][()]
        file["VTKHDF/PointData/pair"] = np.stack([ramp, 2 * ramp], axis=-1)
        file["VTKHDF/PointData/short"] = ramp[:-1]
    for stored in (False, True):
        volume = read_volume(str(path), ReadOptions(array="pair", component=1, stored=stored))
        np.testing.assert_array_equal(volume.data[:], 2 * ramp)
    for options, text in (
        (ReadOptions(array="pair"), "2 components"),
        (ReadOptions(array="pair", component=2), "not component 2"),
        (ReadOptions(array="none"), "no array 'none'"),
    ):
        refused(UsageError, text, read_volume, str(path), options)
    refused(DataError, "of shape", read_volume, str(path), ReadOptions(array="short"))


@pytest.mark.parametrize("kind", IMAGE_STEPS)
def test_steps_of_images(tmp_path: Path, kind: str) -> None:
    path = IMAGE_STEPS[kind](tmp_path)
    for step in range(2):
        volume = read_volume(str(path), ReadOptions(array="ramp", time=step))
        for along, expected in zip(axes_of(volume), (X, Y, Z), strict=True):
            np.testing.assert_allclose(along, expected, atol=MM)
        np.testing.assert_allclose(volume.data, ramp(X, Y, Z) + files.STEP * step)
    with pytest.raises(SeveralSteps) as raised:
        read_volume(str(path), ReadOptions(array="ramp"))
    assert tuple(raised.value.times) == files.TIMES


@pytest.mark.parametrize("make", [files.amr, files.hdf_amr])
def test_the_finest_level_wins_where_there_is_one(tmp_path: Path, make: Make) -> None:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        volume = read_volume(str(make(tmp_path)))
    assert [re.sub(r"^.*: ", "", str(one.message)) for one in told] == [
        "resampled to 8 x 8 x 8 voxels of 0.5 x 0.5 x 0.5, by its cells (--dims X Y Z decides)"
    ]
    assert volume.dims == (8, 8, 8)
    np.testing.assert_allclose(volume.origin, [10.25, 20.25, 30.25], atol=MM)
    fine, (x, y, z) = volume.data[:, :, :4], axes_of(volume)
    np.testing.assert_allclose(fine, ramp(x[:4], y, z) + 1)
    coarse = [np.floor(a) + 0.5 for a in (x[4:], y, z)]
    np.testing.assert_allclose(volume.data[:, :, 4:], ramp(*coarse))


def test_a_decomposed_case(tmp_path: Path) -> None:
    path = files.openfoam(tmp_path)
    (tmp_path / "processor0").mkdir()
    for name in ("constant", *map(str, files.TIMES)):
        (tmp_path / name).rename(tmp_path / "processor0" / name)
    check_samples(path, 1, "cells")
    (tmp_path / "processor0").rename(tmp_path / "elsewhere")
    refused(DataError, "no case beside it", read_volume, str(path))


def test_plot3d_with_functions(tmp_path: Path) -> None:
    path = files.plot3d(tmp_path)
    for name in ("v.p3d", "v.xyz"):
        volume = read_volume(str(tmp_path / name), ReadOptions(dims=(8, 6, 4)))
        check_place(volume)
        np.testing.assert_allclose(volume.data, ramp(*axes_of(volume)), rtol=1e-6)
    path.write_text(json.dumps({**json.loads(path.read_text()), "filenames": [{"xyz": "v.xyz"}]}))
    refused(DataError, "coordinates alone; expected values beside them", read_volume, str(path))


def test_flat_pieces_are_joined(tmp_path: Path) -> None:
    for k in range(2):
        piece = pv.ImageData(dimensions=(5, 5, 1), origin=(4 * k, 0, 0))
        piece.point_data["v"] = np.full(25, k + 1.0)
        piece.save(tmp_path / f"p{k}.vti")
    rows = "".join(f'<DataSet index="{k}" file="p{k}.vti"/>' for k in range(2))
    text = f'<VTKFile type="vtkMultiBlockDataSet"><vtkMultiBlockDataSet>{rows}</vtkMultiBlockDataSet></VTKFile>'
    (tmp_path / "v.vtm").write_text(text)
    volume = read_volume(str(tmp_path / "v.vtm"), ReadOptions(dims=(9, 5, 1)))
    assert volume.dims == (9, 5, 1)
    assert set(np.asarray(volume.data)[0, 2, [0, -1]]) == {1.0, 2.0}


def test_hidden_cells_are_nan(tmp_path: Path) -> None:
    for k, block in enumerate((files.hexahedra(0, 2), files.image(2, 4))):
        marks = np.zeros(block.n_cells, np.uint8)
        marks[0] = 32
        block.cell_data["vtkGhostType"] = marks
        block.save(tmp_path / f"b{k}.{'vti' if k else 'vtu'}")
    rows = '<DataSet index="0" file="b0.vtu"/><DataSet index="1" file="b1.vti"/>'
    text = f'<VTKFile type="vtkMultiBlockDataSet"><vtkMultiBlockDataSet>{rows}</vtkMultiBlockDataSet></VTKFile>'
    (tmp_path / "v.vtm").write_text(text)
    for array in ("cells", "ramp"):
        volume = read_volume(str(tmp_path / "v.vtm"), ReadOptions(array=array, dims=(4, 3, 2)))
        assert np.argwhere(np.isnan(volume.data)).tolist() == [[0, 0, 0], [0, 0, 2]]
    collection = "".join(f'<DataSet timestep="{time}" file="b1.vti"/>' for time in ("0", "inf"))
    (tmp_path / "v.pvd").write_text(f'<VTKFile type="Collection"><Collection>{collection}</Collection></VTKFile>')
    refused(DataError, "a time step that is not finite", read_volume, str(tmp_path / "v.pvd"))
    for name in ("b0.vtu", "b1.vti"):
        dims = (2, 3, 2) if name == "b0.vtu" else None
        alone = read_volume(str(tmp_path / name), ReadOptions(array="cells", dims=dims))
        assert np.argwhere(np.isnan(alone.data)).tolist() == [[0, 0, 0]]


def test_contents_say_what_there_is_and_how_to_choose_it(tmp_path: Path) -> None:
    found = contents(str(STEPS["pvd of parts"](tmp_path)), ReadOptions())
    assert [(row["time"], row["option"]) for row in found["steps"]] == [(0.5, "--time 0"), (1.25, "--time 1")]
    rows = {row["array"]: row for row in found["arrays"]}
    values = ramp(X, Y, Z)
    assert rows["ramp"] == {
        "array": "ramp", "data": "point", "dtype": "float64", "components": 1, "range": [values.min(), values.max()],
        "blocks": 2, "option": "--array ramp",
    }  # fmt: skip
    assert [(row["type"], row["cells"]) for row in found["blocks"]] == [("UnstructuredGrid", 12)] * 2


def test_info_shows_steps_and_then_the_step_that_is_chosen(tmp_path: Path, vvgt) -> None:
    path = str(IMAGE_STEPS["pvd"](tmp_path))
    refused(UsageError, "--time 2: expected a time step from 0 to 1", read_volume, path, ReadOptions(time=2))
    listed = json.loads(vvgt("info", path, "--json").out)
    assert [row["option"] for row in listed["steps"]] == ["--time 0", "--time 1"]
    assert "2 time steps" in listed["choice"]
    one = json.loads(vvgt("info", path, "--json", "--time", "1", "--array", "ramp").out)
    assert one["dims"] == [5, 4, 3]
    assert one["range"] == [float(ramp(X, Y, Z).min()) + files.STEP, float(ramp(X, Y, Z).max()) + files.STEP]


def test_a_missing_choice_of_an_array_is_usage(tmp_path: Path, vvgt) -> None:
    """And `vvgt info` lists the arrays then, with the option for each."""
    path = str(files.exodus(tmp_path))
    refused(UsageError, "choose one with --array NAME", read_volume, path)
    told = json.loads(vvgt("info", path, "--json").out)
    assert told["kind"] == "several volumes"
    assert [row["option"] for row in told["arrays"]] == ["--array ramp", "--array cells"]


def test_a_series_is_converted_with_its_times(tmp_path: Path, vvgt) -> None:
    path = str(IMAGE_STEPS["vtk.series"](tmp_path))
    how = ("--max-gaussians", "50", "--screen", "64", "--steps", "0")
    told = vvgt("convert", path, "--array", "ramp", "-o", str(tmp_path / "p_{:02d}.ply"), *how).err
    assert "v.vtk.series time 0 (0.5): frame 1 of 2" in told
    assert "v.vtk.series time 1 (1.25): frame 2 of 2" in told
    assert {"p_00.ply", "p_01.ply"} <= {file.name for file in tmp_path.iterdir()}


def index(folder: Path, *names: str) -> Path:
    rows = "".join(f'<DataSet index="{k}" file="{name}"/>' for k, name in enumerate(names))
    text = f'<VTKFile type="vtkMultiBlockDataSet"><vtkMultiBlockDataSet>{rows}</vtkMultiBlockDataSet></VTKFile>'
    (folder / "v.vtm").write_text(text)
    return folder / "v.vtm"


@pytest.mark.parametrize(
    ("names", "text"),
    [
        (["b0.vti", "gone.vti"], "'gone.vti' does not exist beside it"),
        (["b0.vti", "../../etc/passwd"], "expected a file in the header's own folder"),
        (["b0.vti", "/etc/passwd"], "expected a file in the header's own folder"),
        (["b0.vti", "v.vtm"], "an index that names itself"),
        (["v.vtm"], "an index that names itself"),
        (["b0.vti", "a.txt"], "no dataset of VTK's"),
        ([], "an index that names no files"),
    ],
)
def test_an_index_of_what_is_not_there(tmp_path: Path, names: list[str], text: str) -> None:
    files.image().save(tmp_path / "b0.vti")
    (tmp_path / "a.txt").write_text("hello")
    refused(DataError, text, read_volume, str(index(tmp_path, *names)), ReadOptions(array="ramp"))


def test_an_index_of_very_many_files(tmp_path: Path) -> None:
    refused(DataError, "more than 100000 files", read_volume, str(index(tmp_path, *["b0.vti"] * 100_001)))
    files.image().save(tmp_path / "b0.vti")
    with pytest.raises(DataError, match=r"'gone\.vti' does not exist"):
        read_volume(str(index(tmp_path, *["b0.vti"] * 50, *["gone.vti"] * 99_950)))


def test_case_files_name_nothing_elsewhere(tmp_path: Path) -> None:
    path = files.ensight(tmp_path)
    text = path.read_text()
    for old, new in (("v.geo", "/etc/passwd"), ("v.ramp.**", "../v.ramp.**")):
        path.write_text(text.replace(old, new))
        with pytest.raises(DataError, match=r"expected (a file|files) in (the header's|its) own folder"):
            read_volume(str(path), ReadOptions(time=0))
    path = files.xdmf3(tmp_path)
    path.write_text(path.read_text().replace("v.h5:", "../v.h5:"))
    refused(DataError, "in the header's own folder", read_volume, str(path), ReadOptions(time=0))
    path.write_text('<!DOCTYPE Xdmf [<!ENTITY a "b">]><Xdmf/>')
    refused(DataError, "its XML declares entities", read_volume, str(path))


def test_a_reader_that_breaks_down_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from vvgt_cli.volume.vtk import child as vtk_child

    path = files.exodus(tmp_path)
    for code, text in (
        ("import os; os.kill(os.getpid(), 11)", r"broke down \(SIGSEGV\)"),
        ("import os; os.kill(os.getpid(), 24)", "was stopped"),
        ("raise SystemExit(3)", r"broke down \(status 3\)"),
    ):
        monkeypatch.setattr(vtk_child, "START", code)
        refused(DataError, text, read_volume, str(path))


def test_a_reader_that_sleeps_for_good_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As one does that waits for a lock of its own: no limit of processor time ends it."""
    from vvgt_cli.volume.vtk import child as vtk_child

    monkeypatch.setattr(vtk_child, "IDLE", 0.4)
    monkeypatch.setattr(vtk_child, "LOOK", 0.1)
    monkeypatch.setattr(vtk_child, "START", "import threading; threading.Event().wait(60)")
    begin = time.monotonic()
    refused(DataError, "standstill", read_volume, str(files.exodus(tmp_path)), ReadOptions(array="ramp"))
    assert time.monotonic() - begin < 30


def test_memory_and_time_of_a_reader_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from vvgt_cli.volume.vtk import child as vtk_child

    path = files.hdf_mesh(tmp_path)
    monkeypatch.setattr(vtk_child, "free_memory", lambda: 1 << 20)
    refused(DataError, r"memory|no dataset", read_volume, str(path), ReadOptions(array="ramp", dims=(64, 64, 64)))
    monkeypatch.undo()
    endless = "c.answer = lambda request: exec('while True: pass')"
    monkeypatch.setattr(vtk_child, "SECONDS", 0)
    monkeypatch.setattr(vtk_child, "A_VOXEL", 0)
    monkeypatch.setattr(vtk_child, "START", f"import vvgt_cli.volume.vtk.child as c; {endless}; c.main()")
    refused(DataError, "was stopped", read_volume, str(path), ReadOptions(array="ramp"))


def test_surfaces_alone_are_no_volume(tmp_path: Path) -> None:
    for name in ("s.vtp", "t.vtp"):
        pv.Sphere().save(tmp_path / name)
    refused(DataError, r"a surface \(vtkPolyData\)", read_volume, str(index(tmp_path, "s.vtp", "t.vtp")))
