"""`.pvti`: pieces as blocks, the same volume as the `.vti` of the same field, whatever is wrong with a piece."""

import itertools
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

from tests import vtk_files as files
from tests.refused import refused
from vvgt_cli.errors import DataError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.registry import contents
from vvgt_cli.volume.stored import Stored, is_file_backed
from vvgt_cli.volume.vtk import pieces as vtk_pieces

PLAIN = {"DataMode": 2, "EncodeAppendedData": False, "CompressorType": 0}  # raw, appended
CODINGS = {"plain": PLAIN, "packed": {"DataMode": 2, "CompressorType": 1}, "ascii": {"DataMode": 0}}


def whole(folder: Path, source: Any) -> Path:
    source.UpdateWholeExtent()
    return files.write(vtkXMLImageDataWriter(), source.GetOutput(), folder / "v.vti", **PLAIN)


@pytest.mark.parametrize("coding", CODINGS)
@pytest.mark.parametrize("ghosts", [0, 1])
def test_pieces_are_the_image(tmp_path: Path, coding: str, ghosts: int) -> None:
    source = files.wavelet()
    path = files.parallel_image(tmp_path, source, 8, GhostLevel=ghosts, **CODINGS[coding])
    image, found = (read_volume(str(p)) for p in (whole(tmp_path, source), path))
    assert found.data.dtype == image.data.dtype == np.float32
    assert (found.origin, found.spacing, found.direction, found.name) == (
        image.origin, image.spacing, image.direction, image.name,
    )  # fmt: skip
    np.testing.assert_array_equal(found.data, image.data)
    stored = read_volume(str(path), ReadOptions(stored=True))
    assert isinstance(stored.data, Stored)
    assert is_file_backed(stored)
    np.testing.assert_array_equal(stored.data[3:7, 2:9, 5:6], image.data[3:7, 2:9, 5:6])


def by_hand(folder: Path, cuts: tuple[int, ...] = (0, 2, 4), marks: dict[int, int] | None = None) -> Path:
    """Pieces along x of the image of tests/vtk_files.py; ``marks`` are ghost marks of the first cell of a piece."""
    rows = ""
    for k, (lo, hi) in enumerate(itertools.pairwise(cuts)):
        part = files.image(lo, hi)
        part.extent = (lo, hi, 0, 3, 0, 2)
        part.origin = files.image().origin
        if marks is not None:
            part.cell_data["vtkGhostType"] = np.eye(1, part.n_cells, dtype=np.uint8)[0] * np.uint8(marks.get(k, 0))
        part.save(folder / f"p{k}.vti")
        rows += f'<Piece Extent="{lo} {hi} 0 3 0 2" Source="p{k}.vti"/>'
    ghosts = '<PDataArray type="UInt8" Name="vtkGhostType"/>' if marks is not None else ""
    path = folder / "v.pvti"
    path.write_text(
        '<VTKFile type="PImageData"><PImageData WholeExtent="0 4 0 3 0 2" GhostLevel="0" Origin="0.5 -3 10" '
        f'Spacing="0.25 0.5 2"><PPointData><PDataArray type="Float64" Name="ramp"/></PPointData><PCellData>'
        f'<PDataArray type="Float64" Name="cells"/>{ghosts}</PCellData>{rows}</PImageData></VTKFile>'
    )
    return path


def test_contents_tell_arrays_ranges_and_pieces(tmp_path: Path, vvgt) -> None:
    found = contents(str(by_hand(tmp_path)), ReadOptions())
    values = read_volume(str(tmp_path / "v.pvti"), ReadOptions(array="ramp")).data
    assert found["blocks"] == [{"pieces": 2, "first": "p0.vti"}]
    assert [(row["array"], row["option"]) for row in found["arrays"]] == [
        ("ramp", "--array ramp"), ("cells", "--array cells"),
    ]  # fmt: skip
    assert found["arrays"][0]["range"] == [values.min(), values.max()]
    told = vvgt("info", str(tmp_path / "v.pvti")).out.decode()
    assert "several arrays" in told
    assert "--array cells" in told


def test_points_and_cells_lie_where_they_do_in_the_whole(tmp_path: Path) -> None:
    files.image().save(tmp_path / "w.vti")
    for array in ("ramp", "cells"):
        volume = read_volume(str(by_hand(tmp_path)), ReadOptions(array=array))
        expected = read_volume(str(tmp_path / "w.vti"), ReadOptions(array=array))
        np.testing.assert_allclose(volume.origin, expected.origin, atol=0.01)
        np.testing.assert_array_equal(volume.data, expected.data)


def test_a_direction_that_only_pieces_have(tmp_path: Path) -> None:
    path = by_hand(tmp_path)
    turned = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    for k in range(2):
        part = pv.read(tmp_path / f"p{k}.vti")
        part.direction_matrix = np.reshape(turned, (3, 3))
        part.save(tmp_path / f"p{k}.vti")
    volume = read_volume(str(path), ReadOptions(array="cells"))
    assert volume.direction == turned
    np.testing.assert_allclose(volume.origin, [0.5 - 0.25, -3 + 0.125, 11], atol=0.01)


def test_hidden_cells_are_nan(tmp_path: Path) -> None:
    path = by_hand(tmp_path, marks={0: 1, 1: 32})
    for stored in (False, True):
        volume = read_volume(str(path), ReadOptions(array="cells", stored=stored))
        assert np.argwhere(np.isnan(volume.data[:, :, :])).tolist() == [[0, 0, 2]]
    points = read_volume(str(path), ReadOptions(array="ramp"))
    assert not np.isnan(points.data).any()  # each has another cell beside it
    duplicates = by_hand(tmp_path, marks={0: 1, 1: 1})
    assert not np.isnan(read_volume(str(duplicates), ReadOptions(array="cells")).data).any()


def test_a_box_reads_the_pieces_that_it_meets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    volume = read_volume(str(by_hand(tmp_path, (0, 1, 2, 3, 4))), ReadOptions(array="cells", stored=True))
    opened: list[str] = []
    real = vtk_pieces.scan
    monkeypatch.setattr(vtk_pieces, "scan", lambda file: opened.append(file.name) or real(file))
    volume.data[:, :, 1:3]
    assert opened == ["p1.vti", "p2.vti"]
    volume.data[:, 0:1, 1:2]
    assert opened == ["p1.vti", "p2.vti"]  # kept
    monkeypatch.setattr(vtk_pieces, "OPEN", 1)
    volume.data[:, :, 0:1]
    volume.data[:, :, 1:2]
    assert opened == ["p1.vti", "p2.vti", "p0.vti", "p1.vti"]


def _edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("p1.vti", "gone.vti", "'gone.vti' does not exist beside it"),
        ("p1.vti", "../../etc/passwd", "expected a file in the header's own folder"),
        ("p1.vti", "p0.vti", "expected the place that v.pvti gives it"),
        ('"2 4 0 3 0 2"', '"2 3 0 3 0 2"', "lie in none of its pieces"),
        ('"2 4 0 3 0 2"', '"2 5 0 3 0 2"', "expected one within"),
        ('type="Float64" Name="cells"', 'type="Float32" Name="cells"', "as v.pvti says"),
        ('WholeExtent="0 4 0 3 0 2"', 'WholeExtent="0 4000000 0 3000000 0 2000000"', "memory|lie in none"),
    ],
)
def test_what_can_be_wrong_with_an_index(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = by_hand(tmp_path)
    _edit(path, old, new)
    with pytest.raises(Exception, match=message) as raised:
        read_volume(str(path), ReadOptions(array="cell" if new == 'Name="cell"' else "cells"))
    assert isinstance(raised.value, DataError)
    assert "\n" not in str(raised.value)


def test_pieces_that_are_elsewhere_or_cut(tmp_path: Path) -> None:
    path = by_hand(tmp_path)
    part = pv.read(tmp_path / "p1.vti")
    part.origin = (0.5, -3, 10.5)
    part.save(tmp_path / "p1.vti")
    refused(DataError, r"expected the place that v\.pvti gives it", read_volume, str(path), ReadOptions(array="cells"))
    by_hand(tmp_path)
    content = (tmp_path / "p1.vti").read_bytes()
    (tmp_path / "p1.vti").write_bytes(content[: len(content) // 3])
    refused(DataError, r"p1\.vti", read_volume, str(path), ReadOptions(array="cells"))


def test_very_many_pieces_are_read_one_by_one(tmp_path: Path) -> None:
    n = 100_000
    rows = "".join(f'<Piece Extent="{k} {k + 1} 0 1 0 1" Source="p{k}.vti"/>' for k in range(n))
    part = pv.ImageData(dimensions=(2, 2, 2))
    part.cell_data["c"] = np.array([7.0])
    for k in (0, n - 1):
        part.extent = (k, k + 1, 0, 1, 0, 1)
        part.save(tmp_path / f"p{k}.vti")
    path = tmp_path / "v.pvti"
    path.write_text(
        f'<VTKFile type="PImageData"><PImageData WholeExtent="0 {n} 0 1 0 1" Origin="0 0 0" Spacing="1 1 1"><PCellData>'
        f'<PDataArray type="Float64" Name="c"/></PCellData>{rows}</PImageData></VTKFile>'
    )
    volume = read_volume(str(path), ReadOptions(stored=True))
    assert volume.dims == (n, 1, 1)
    assert volume.data[:, :, n - 1 : n].tolist() == [[[7.0]]]
    with pytest.raises(DataError, match=r"'p5\.vti' does not exist"):
        volume.data[:, :, 5:6]


@pytest.mark.parametrize("more", [(), ("--blocks", "16"), ("--blocks", "32", "--workers", "2")])
def test_the_same_bytes_as_of_one_file(tmp_path: Path, vvgt, more: tuple[str, ...]) -> None:
    source = files.wavelet(24)
    whole(tmp_path, source)
    files.parallel_image(tmp_path, source, 64, **PLAIN)
    made = []
    for name in ("v.vti", "v.pvti"):
        output = tmp_path / f"{name}.ply"
        vvgt("init", str(tmp_path / name), "-o", str(output), "--max-gaussians", "500", *more)
        made.append(output.read_bytes())
        shutil.rmtree(tmp_path / f".{name}.ply.blocks", ignore_errors=True)
    assert made[0] == made[1]
