"""Volumes as many files: DICOM series, TIFF slices, NRRD with several data files."""

import gzip
import json
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pydicom
import pytest
import tifffile
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, RLELossless, generate_uid

from tests.ramps import X, Y, Z, check_grid, ramp
from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, read_volume

VALUES = ramp(X, Y, Z)
LPS = ReadOptions(space="LPS")  # DICOM's own
SLOPE, INTERCEPT = 0.5, 4000.0
STORED = np.round((VALUES - INTERCEPT) / SLOPE).astype("<i2")


def header(rows: int, columns: int) -> Dataset:
    file = Dataset()
    file.file_meta = FileMetaDataset()
    file.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    file.file_meta.MediaStorageSOPClassUID = file.SOPClassUID = CTImageStorage
    file.file_meta.MediaStorageSOPInstanceUID = file.SOPInstanceUID = generate_uid()
    file.Modality = "CT"
    file.Rows, file.Columns, file.SamplesPerPixel, file.PhotometricInterpretation = rows, columns, 1, "MONOCHROME2"
    file.BitsAllocated, file.BitsStored, file.HighBit, file.PixelRepresentation = 16, 16, 15, 1
    return file


def write_series(folder: Path, uid: str = "1.2.3", number: int = 1, **changes) -> list[Dataset]:
    """The ramp as CT slices in shuffled files: instance numbers and names say nothing of the order."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for k, name in enumerate(("c", "a", "b")):
        file = header(len(Y), len(X))
        file.SeriesInstanceUID, file.SeriesNumber, file.SeriesDescription = uid, number, f"series {number}"
        file.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
        file.ImagePositionPatient = [X[0], Y[0], Z[k]]
        file.PixelSpacing = [Y[1] - Y[0], X[1] - X[0]]  # between rows, then between columns
        file.RescaleSlope, file.RescaleIntercept, file.SliceThickness = SLOPE, INTERCEPT, 7
        file.PixelData = STORED[k].tobytes()
        for key, change in changes.items():
            value = change(k) if callable(change) else change
            if value is None:
                del file[key]
            else:
                setattr(file, key, value)
        file.save_as(folder / f"{name}-{number}.dcm", enforce_file_format=True)
        written.append(file)
    return written


def test_dicom_folder(tmp_path: Path) -> None:
    write_series(tmp_path / "scan" / "inner")
    (tmp_path / "scan" / "notes.txt").write_text("not an image")
    volume = read_volume(str(tmp_path / "scan"), LPS)
    assert (volume.name, volume.data.dtype, volume.slope, volume.intercept) == ("scan", np.int16, SLOPE, INTERCEPT)
    check_grid(volume, atol=SLOPE)
    assert volume.direction == (1, 0, 0, 0, 1, 0, 0, 0, 1)


def test_dicom_one_file(tmp_path: Path) -> None:
    write_series(tmp_path)
    volume = read_volume(str(tmp_path / "a-1.dcm"), LPS)
    assert volume.dims == (5, 4, 1)
    assert volume.spacing == (0.25, 0.5, 7)
    assert volume.origin == (X[0], Y[0], Z[1])


def test_dicom_sagittal_order_and_direction(tmp_path: Path) -> None:
    # rows run along patient y, columns along -z: the normal, and with it the order, is along -x
    write_series(
        tmp_path, ImageOrientationPatient=[0, 1, 0, 0, 0, -1], ImagePositionPatient=lambda k: [2.0 * k, -3.0, 9.0]
    )
    volume = read_volume(str(tmp_path), LPS)
    assert volume.spacing == (0.25, 0.5, 2)
    assert volume.origin == (4, -3, 9)
    np.testing.assert_allclose(np.reshape(volume.direction, (3, 3)), [[0, 0, -1], [1, 0, 0], [0, -1, 0]])
    np.testing.assert_array_equal(volume.data, STORED[::-1])


def test_dicom_several_series(tmp_path: Path) -> None:
    write_series(tmp_path, "1.2.3", 1)
    write_series(tmp_path, "1.2.4", 2, RescaleIntercept=0)
    with pytest.raises(
        UsageError, match=r"several series: 1 'series 1' \(CT, 3 slices, 1\.2\.3\); 2 .*--series SERIES"
    ):
        read_volume(str(tmp_path))
    for wanted in ("2", "1.2.4", "series 2"):
        assert read_volume(str(tmp_path), ReadOptions(array=wanted)).intercept == 0
    refused(UsageError, "no one series '3'; it has 1 'series 1'", read_volume, str(tmp_path), ReadOptions(array="3"))


def test_dicom_scalings_that_differ_are_applied(tmp_path: Path) -> None:
    write_series(tmp_path, RescaleIntercept=lambda k: 100 * k, RescaleSlope=lambda k: 1 + k)
    volume = read_volume(str(tmp_path))
    assert (volume.data.dtype, volume.slope, volume.intercept) == (np.float32, 1, 0)
    for k in range(3):
        np.testing.assert_allclose(volume.data[k], STORED[k] * (1 + k) + 100 * k, rtol=1e-6)


def test_dicom_multi_frame(tmp_path: Path) -> None:
    file = header(len(Y), len(X))
    file.NumberOfFrames = 3
    shared, measures, orientation, scaling = Dataset(), Dataset(), Dataset(), Dataset()
    measures.PixelSpacing, orientation.ImageOrientationPatient = [0.5, 0.25], [1, 0, 0, 0, 1, 0]
    scaling.RescaleSlope, scaling.RescaleIntercept = SLOPE, INTERCEPT
    shared.PixelMeasuresSequence, shared.PlaneOrientationSequence = [measures], [orientation]
    shared.PixelValueTransformationSequence = [scaling]
    file.SharedFunctionalGroupsSequence = [shared]
    file.PerFrameFunctionalGroupsSequence = []
    order = (2, 0, 1)
    for k in order:
        frame, place = Dataset(), Dataset()
        place.ImagePositionPatient = [X[0], Y[0], Z[k]]
        frame.PlanePositionSequence = [place]
        file.PerFrameFunctionalGroupsSequence.append(frame)
    file.PixelData = STORED[list(order)].tobytes()
    file.save_as(tmp_path / "enhanced.dcm", enforce_file_format=True)
    check_grid(read_volume(str(tmp_path / "enhanced.dcm"), LPS), atol=SLOPE)


def test_dicom_compressed(tmp_path: Path) -> None:
    for file in write_series(tmp_path):
        file.compress(RLELossless)
        file.save_as(
            tmp_path / f"{'cab'[int((file.ImagePositionPatient[2] - 10) / 2)]}-1.dcm", enforce_file_format=True
        )
    assert pydicom.dcmread(tmp_path / "a-1.dcm").file_meta.TransferSyntaxUID == RLELossless
    check_grid(read_volume(str(tmp_path), LPS), atol=SLOPE)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ImagePositionPatient": lambda k: [0, 0, (0, 1, 3)[k]]}, "1 to 2 mm apart .*is a slice missing"),
        ({"ImagePositionPatient": lambda k: [k % 2, 0, k]}, "shift sideways unevenly"),
        ({"ImagePositionPatient": None}, "no ImagePositionPatient"),
        ({"ImageOrientationPatient": [1, 0, 0, 1, 0, 0]}, "right angles"),
        ({"PixelData": b"12"}, "cannot be read as DICOM|bytes"),
    ],
)
def test_dicom_refusals(tmp_path: Path, changes: dict, message: str) -> None:
    write_series(tmp_path / "scan", **changes)
    refused(DataError, message, read_volume, str(tmp_path / "scan"))


def test_dicom_without_its_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_series(tmp_path / "scan")
    monkeypatch.setitem(sys.modules, "pydicom", None)
    refused(DataError, r"needs pydicom .*pip install 'nibabel>=5' 'pydicom>=3'$", read_volume, str(tmp_path / "scan"))


def write_slices(folder: Path, values: np.ndarray) -> None:
    folder.mkdir(exist_ok=True)
    for k, plane in enumerate(values):
        spec = oiio.ImageSpec(plane.shape[1], plane.shape[0], 1, "float")
        output = oiio.ImageOutput.create(str(folder / f"slice_{k + 8}.tif"))  # 8, 9, 10: not the order of the names
        output.open(str(folder / f"slice_{k + 8}.tif"), spec)
        output.write_image(np.ascontiguousarray(plane[..., None]))
        output.close()


def test_tiff_slices_of_a_folder_and_a_glob(tmp_path: Path) -> None:
    values = VALUES.astype(np.float32)
    write_slices(tmp_path / "stack", values)
    for source, name in ((tmp_path / "stack", "stack"), (tmp_path / "stack" / "slice_*.tif", "slice")):
        volume = read_volume(str(source), ReadOptions(spacing=(1, 2, 3)))
        assert (volume.name, volume.spacing) == (name, (1, 2, 3))
        np.testing.assert_array_equal(volume.data, values)
    assert read_volume(str(tmp_path / "stack" / "slice_[89].tif")).dims == (5, 4, 2)
    for k in (8, 9, 10):
        told = {"axes": "YX", "PhysicalSizeX": 0.5, "PhysicalSizeY": 0.5, "PhysicalSizeZ": 3}
        tifffile.imwrite(tmp_path / "stack" / f"slice_{k}.tif", values[k - 8], ome=True, metadata=told)
    volume = read_volume(str(tmp_path / "stack"))
    np.testing.assert_array_equal(volume.data, values)
    assert volume.spacing == (0.5, 0.5, 3)


def test_tiff_slices_refusals(tmp_path: Path) -> None:
    write_slices(tmp_path / "stack", VALUES.astype(np.float32))
    refused(DataError, "no such file", read_volume, str(tmp_path / "none_*.tif"))
    refused(UsageError, "leave out --dims", read_volume, str(tmp_path / "stack" / "*.tif"), ReadOptions(dims=(1, 1, 1)))
    (tmp_path / "stack" / "notes.txt").write_text("x")
    refused(DataError, r"notes.txt is no slice", read_volume, str(tmp_path / "stack" / "*"))
    spec = oiio.ImageSpec(2, 2, 1, "float")
    output = oiio.ImageOutput.create(str(tmp_path / "stack" / "slice_9.tif"))
    output.open(str(tmp_path / "stack" / "slice_9.tif"), spec)
    output.write_image(np.zeros((2, 2, 1), np.float32))
    output.close()
    with pytest.raises(DataError, match=r"slice_9.tif: 2 x 2 float32; expected 5 x 4 float32 as in slice_8.tif"):
        read_volume(str(tmp_path / "stack"))


def nhdr(path: Path, named: str, encoding: str = "raw") -> str:
    path.write_text(
        "NRRD0005\ntype: double\nendian: little\ndimension: 3\nsizes: 5 4 3\nspace dimension: 3\n"
        "space directions: (0.25,0,0) (0,0.5,0) (0,0,2)\nspace origin: (0.5,-3,10)\n"
        f"encoding: {encoding}\ndata file: {named}\n"
    )
    return str(path)


@pytest.mark.parametrize(("encoding", "pack"), [("raw", bytes), ("gzip", gzip.compress)])
def test_nrrd_in_several_files(tmp_path: Path, encoding: str, pack) -> None:
    for k in range(3):
        (tmp_path / f"s{k:02d}.raw").write_bytes(pack(VALUES[k].astype("<f8").tobytes()))
    for named in ("s%02d.raw 0 2 1", "s%02d.raw 0 2 1 2", "LIST\ns00.raw\ns01.raw\ns02.raw"):
        check_grid(read_volume(nhdr(tmp_path / "v.nhdr", named, encoding)))
    np.testing.assert_array_equal(
        read_volume(nhdr(tmp_path / "v.nhdr", "s%02d.raw 2 0 -1", encoding)).data, VALUES[::-1]
    )
    (tmp_path / "rest.raw").write_bytes(pack(VALUES[1:].astype("<f8").tobytes()))
    (tmp_path / "whole.raw").write_bytes(pack(VALUES.astype("<f8").tobytes()))
    check_grid(read_volume(nhdr(tmp_path / "v.nhdr", "LIST 3\nwhole.raw", encoding)))
    for named, message in (
        ("LIST\ns00.raw\ns01.raw", "2 data files of 5 x 4 values; expected 5 x 4 x 3"),
        ("LIST\ns00.raw\ns01.raw\n../s02.raw", "own folder"),
        ("LIST", "0 names"),
        ("s%02d.raw 0 2 0", "MIN MAX STEP"),
        ("s%02d.raw 0 900000 1", "MIN MAX STEP"),
        ("s%02d.raw 1 3 1", "does not exist beside it"),
    ):
        refused(DataError, message, read_volume, nhdr(tmp_path / "v.nhdr", named, encoding))


def test_info_takes_folders_globs_and_inner_paths(vvgt, tmp_path: Path) -> None:
    write_series(tmp_path / "scan")
    write_slices(tmp_path / "stack", VALUES.astype(np.float32))
    np.savez(tmp_path / "v.npz", field=VALUES, other=VALUES)
    for source in ("scan", "stack", "stack/*.tif", "v.npz:/field"):
        assert json.loads(vvgt.ok("info", f"{tmp_path}/{source}", "--json").out)["dims"] == [5, 4, 3]
    (tmp_path / "empty").mkdir()
    assert "a folder; expected a volume file" in vvgt("info", tmp_path / "empty").error


@pytest.mark.parametrize(("spacing", "shift"), [(1.0, 0.0299), (5.0, 0.149), (0.2, 0.0299)])
def test_dicom_slices_may_be_off_by_a_hundredth_of_the_largest_edge_each(tmp_path, spacing, shift):
    """Three slices a millimetre apart, pixels of ``spacing``: the middle one is off to the side."""

    def read(off):
        place = lambda k: [1.5 * off * (k == 1), 0, k]  # noqa: E731 - of which two thirds are off the line of the three
        folder = tmp_path / f"{off:g}"
        write_series(folder, ImagePositionPatient=place, PixelSpacing=[spacing, spacing])
        return read_volume(str(folder), LPS)

    assert read(shift / 1.5).dims == (5, 4, 3)
    refused(DataError, "shift sideways unevenly", read, 1.02 * shift / 1.5 / 0.99)
