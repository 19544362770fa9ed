"""vtk.js folders, written by VTK."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, read_volume


def write(folder: Path, packed: bool = False) -> pv.ImageData:
    from vtkmodules.vtkIOExport import vtkJSONDataSetWriter

    image = pv.ImageData(dimensions=(6, 5, 4), spacing=(1, 2, 3), origin=(10, 20, 30))
    image["v"] = np.arange(120, dtype="f4")
    image["w"] = np.arange(360, dtype="i2").reshape(120, 3)
    image.direction_matrix = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    writer = vtkJSONDataSetWriter()
    writer.SetInputData(image)
    writer.GetArchiver().SetArchiveName(str(folder))
    writer.Write()
    for file in list((folder / "data").iterdir()) if packed else []:
        file.with_name(file.name + ".gz").write_bytes(gzip.compress(file.read_bytes()))
        file.unlink()
    return image


@pytest.mark.parametrize("packed", [False, True])
def test_an_image_with_its_place(tmp_path: Path, packed: bool) -> None:
    image = write(tmp_path / "v", packed)
    volume = read_volume(str(tmp_path / "v"), ReadOptions(array="v"))
    np.testing.assert_array_equal(volume.data.ravel(), image["v"])
    for x, y, z in ((0, 0, 0), (5, 0, 0), (0, 4, 0), (2, 3, 3)):
        point = image.GetPoint(image.ComputePointId((x, y, z)))
        np.testing.assert_allclose((volume.affine @ [x, y, z, 1])[:3], point, atol=1e-9)
    w = read_volume(str(tmp_path / "v"), ReadOptions(array="w", component=2))
    np.testing.assert_array_equal(w.data.ravel(), image["w"][:, 2])
    refused(UsageError, r"several arrays .*v \(point data, float32, 1 component\); w", read_volume, str(tmp_path / "v"))


def test_what_is_not_an_image_or_not_whole(tmp_path: Path) -> None:
    write(tmp_path / "v")
    index = tmp_path / "v" / "index.json"
    found = json.loads(index.read_text())
    index.write_text(json.dumps(found | {"vtkClass": "vtkPolyData"}))
    refused(DataError, "a vtkPolyData; expected vtkImageData", read_volume, str(tmp_path / "v"))
    index.write_text(json.dumps(found | {"extent": [0, 9, 0, 4, 0, 3]}))
    refused(DataError, "bytes", read_volume, str(tmp_path / "v"), ReadOptions(array="v"))
    found["pointData"]["arrays"][0]["data"]["ref"]["id"] = "../../secret"
    index.write_text(json.dumps(found))
    refused(DataError, "own folder", read_volume, str(tmp_path / "v"), ReadOptions(array="v"))
