"""DICOM folders as scanners leave them: scouts, several orientations, dose grids, segmentations, other codings."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydicom.encaps import encapsulate
from pydicom.uid import HTJ2K, MPEG2MPML, UID, JPEG2000Lossless, JPEGBaseline8Bit, JPEGLosslessSV1, JPEGLSLossless

from tests.ramps import X, Y, check_grid
from tests.refused import refused
from tests.test_volume_slices import SLOPE, header, write_series
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions
from vvgt_cli.volume import read_volume as read_placed

SAGITTAL, CORONAL = [0, 1, 0, 0, 0, -1], [1, 0, 0, 0, 0, -1]
SCOUT = ["ORIGINAL", "PRIMARY", "LOCALIZER"]


def read_volume(source, options=None):
    """In the space of the files: the ramps are along its axes."""
    return read_placed(source, replace(options or ReadOptions(), space="LPS"))


def write_scouts(folder: Path, number: int, uid: str = "1.2.3", **changes) -> None:
    """Sagittal slices of other names in the same folder."""
    places = {"ImageOrientationPatient": SAGITTAL, "ImagePositionPatient": lambda k: [5.0 * k, 0, 0]}
    write_series(folder, uid, number, **{"SeriesNumber": 1, **places, **changes})


def test_scouts_in_the_series_are_left_out_and_that_is_said(tmp_path: Path) -> None:
    write_series(tmp_path)
    write_scouts(tmp_path, 7, ImageType=SCOUT)
    with pytest.warns(UserWarning, match=r"skipped.*1/2: 3 sagittal slices of 5 x 4, localiser$"):
        check_grid(read_volume(str(tmp_path)), atol=SLOPE)


@pytest.mark.parametrize("count", [1, 2])
def test_fewer_slices_than_make_a_stack_are_left_out(tmp_path: Path, count: int) -> None:
    """Scouts that are not called so."""
    write_series(tmp_path)
    write_scouts(tmp_path / "other", 7)
    for k, name in enumerate(("a-7.dcm", "b-7.dcm", "c-7.dcm")):
        (tmp_path / "other" / name).rename(tmp_path / name)
        if k >= count:
            (tmp_path / name).unlink()
    said = rf"skipped.*1/2: {count} sagittal slice{'s' * (count > 1)} of 5 x 4$"
    with pytest.warns(UserWarning, match=said):
        check_grid(read_volume(str(tmp_path)), atol=SLOPE)


def test_several_orientations_are_told_apart(tmp_path: Path) -> None:
    write_series(tmp_path)
    write_scouts(tmp_path, 7)
    write_scouts(tmp_path, 8, ImageOrientationPatient=CORONAL, ImagePositionPatient=lambda k: [0, 5.0 * k, 0])
    listing = r"1/1: 3 axial slices of 5 x 4; 1/2: 3 sagittal slices of 5 x 4; 1/3: 3 coronal.*--series SERIES/STACK"
    refused(UsageError, listing, read_volume, str(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_grid(read_volume(str(tmp_path), ReadOptions(array="1/1")), atol=SLOPE)
        assert read_volume(str(tmp_path), ReadOptions(array="1.2.3/2")).spacing == (0.25, 0.5, 5)
        check_grid(read_volume(f"{tmp_path}:/1/1"), atol=SLOPE)
    refused(UsageError, "no stack 1/4; it has 1/1: 3 axial", read_volume, str(tmp_path), ReadOptions(array="1/4"))
    refused(UsageError, "no one series '9/1'", read_volume, str(tmp_path), ReadOptions(array="9/1"))


def test_info_lists_stacks(tmp_path: Path, vvgt) -> None:
    write_series(tmp_path)
    write_scouts(tmp_path, 7)
    said = vvgt.ok("info", tmp_path)
    assert "--series 1/1, name 3 axial slices of 5 x 4, dims 5 4 3" in said.out.decode()
    assert "--series 1/2, name 3 sagittal slices of 5 x 4" in said.out.decode()


def test_pixel_spacings_are_told_apart(tmp_path: Path) -> None:
    write_series(tmp_path, PixelSpacing=lambda k: [1, 1 + k])
    with pytest.raises(UsageError, match=r"differ in size, orientation or pixel spacing: 1/1: 1 axial slice of 5 x 4"):
        read_volume(str(tmp_path))


def test_series_of_scouts_segmentations_and_pictures_are_left_out(tmp_path: Path) -> None:
    write_series(tmp_path)
    write_scouts(tmp_path, 7, "1.2.7", SeriesNumber=7, ImageType=SCOUT)
    write_series(tmp_path, "1.2.8", 8, SOPClassUID=UID("1.2.840.10008.5.1.4.1.1.66.4"), Modality="SEG")
    write_series(tmp_path, "1.2.9", 9, ImagePositionPatient=None, Modality="OT")
    said = r"skipped: 7 'series 7' \(CT, 3 slices, 1\.2\.7\); 8 .*\(SEG, .*; 9 .*\(OT, "
    with pytest.warns(UserWarning, match=said):
        check_grid(read_volume(str(tmp_path)), atol=SLOPE)
    write_series(tmp_path, "1.2.4", 2)
    with pytest.raises(UsageError, match=r"several series: 1 .*CT, 3 slices.*choose one by number, UID or description"):
        read_volume(str(tmp_path))


@pytest.mark.parametrize("heights", [False, True])
def test_dose_grid(tmp_path: Path, heights: bool) -> None:
    file = header(len(Y), len(X))
    file.Modality, file.SeriesInstanceUID, file.SeriesNumber = "RTDOSE", "1.2.3", 1
    file.SOPClassUID = file.file_meta.MediaStorageSOPClassUID = UID("1.2.840.10008.5.1.4.1.1.481.2")
    file.BitsAllocated = file.BitsStored = 32
    file.HighBit, file.PixelRepresentation = 31, 0
    file.NumberOfFrames, file.DoseGridScaling, file.DoseUnits = 3, 2e-4, "GY"
    file.ImageOrientationPatient, file.ImagePositionPatient = [1, 0, 0, 0, 1, 0], [X[0], Y[0], 10.0]
    file.PixelSpacing = [0.5, 0.25]
    file.GridFrameOffsetVector = [10.0, 12.0, 14.0] if heights else [0.0, 2.0, 4.0]
    values = np.arange(60, dtype="<u4").reshape(3, 4, 5) * 1000
    file.PixelData = values.tobytes()
    path = tmp_path / "dose.dcm"
    file.save_as(path, enforce_file_format=True)
    volume = read_volume(str(path))
    np.testing.assert_array_equal(volume.data, values)
    assert (volume.slope, volume.intercept) == (2e-4, 0)
    assert (volume.spacing, volume.origin) == ((0.25, 0.5, 2), (X[0], Y[0], 10))
    file.GridFrameOffsetVector = [0.0, 2.0]
    file.save_as(path, enforce_file_format=True)
    refused(DataError, "a dose grid of 3 planes with 2 offsets", read_volume, str(path))


@pytest.mark.parametrize(
    ("syntax", "package"),
    [
        (JPEGLSLossless, "try: pip install pyjpegls$"),
        (JPEG2000Lossless, "try: pip install pylibjpeg pylibjpeg-openjpeg$"),
        (HTJ2K, "try: pip install pylibjpeg pylibjpeg-openjpeg$"),
        (JPEGBaseline8Bit, "try: pip install pylibjpeg pylibjpeg-libjpeg$"),
        (JPEGLosslessSV1, "try: pip install pylibjpeg pylibjpeg-libjpeg$"),
        (MPEG2MPML, "convert them to an uncompressed syntax first$"),
    ],
)
def test_codings_name_their_package(tmp_path: Path, syntax: UID, package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from pydicom.pixels.decoders import base

    for decoder in base._PIXEL_DATA_DECODERS.values():  # as if nothing but pydicom were installed
        monkeypatch.setattr(decoder[0], "_available", {})
    for file in write_series(tmp_path):
        file.file_meta.TransferSyntaxUID = syntax
        file.PixelData = encapsulate([b"\xff\xd8\xff\xd9"])
        file["PixelData"].VR = "OB"
        name = f"{'cab'[int((file.ImagePositionPatient[2] - 10) / 2)]}-1.dcm"
        file.save_as(tmp_path / name, enforce_file_format=True)
    assert syntax.name in refused(DataError, package, read_volume, str(tmp_path))


def test_a_folder_of_several_formats_asks_for_one_file(tmp_path: Path) -> None:
    for name in ("a.nii", "b.nii.gz", "c.nrrd", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
    refused(DataError, r"found 2 NIfTI \(a.nii, b.nii.gz\); 1 NRRD \(c.nrrd\): give one of", read_volume, str(tmp_path))
    write_series(tmp_path / "inner")
    (tmp_path / "inner" / "a-1.dcm").rename(tmp_path / "one")  # without a name that says what it is
    refused(DataError, r"2 NIfTI .*; 1 NRRD \(c.nrrd\); 1 DICOM \(one\)", read_volume, str(tmp_path))
    scan = tmp_path / "scan"
    write_series(scan)
    (scan / "mask.nii").write_bytes(b"x")  # few of another format are no matter
    check_grid(read_volume(str(scan)), atol=SLOPE)
