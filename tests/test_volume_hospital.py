"""DICOM as hospitals have it: mosaics, several volumes in a series, rounded and uneven places, files without preamble,
copies, nuclear medicine, look-up tables, archives. Beside dcm2niix, SimpleITK and pydicom.
"""

import shutil
import struct
import subprocess
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from pydicom.dataset import Dataset
from pydicom.uid import ExplicitVRBigEndian, ExplicitVRLittleEndian, ImplicitVRLittleEndian

from tests.refused import refused
from tests.test_volume_slices import header
from vvgt_cli.errors import DataError, SeveralSteps, UsageError
from vvgt_cli.volume import ReadOptions, Volume, read_volume
from vvgt_cli.volume.registry import time_steps

STACK = np.arange(4 * 6 * 5).reshape(4, 6, 5).astype("<i2")  # z, y, x
OBLIQUE = [0.8, 0.6, 0.0, -0.36, 0.48, 0.8]
LPS = ReadOptions(space="LPS")


def image(pixels: np.ndarray, position: Any, **changes: Any) -> Dataset:
    """One MR image; a change of None removes the attribute."""
    file = header(*pixels.shape[-2:])
    stated = {
        "Modality": "MR", "SeriesInstanceUID": "1.2.3", "StudyInstanceUID": "1.2", "SeriesNumber": 4, "PatientID": "p",
        "ImageOrientationPatient": [1, 0, 0, 0, 1, 0], "ImagePositionPatient": list(map(float, position)),
        "PixelSpacing": [1.5, 0.5], "SliceThickness": 2, "ImageType": ["ORIGINAL", "PRIMARY", "M", "ND"],
        "PixelData": pixels.astype("<i2").tobytes(),
    }  # fmt: skip
    for key, value in (stated | changes).items():
        if value is not None:
            setattr(file, key, value)
        elif key in file:
            del file[key]
    return file


def save(file: Dataset, path: Path, preamble: bool = True) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if preamble:
        file.save_as(path, enforce_file_format=True)
        return
    syntax = file.file_meta.TransferSyntaxUID
    bare = Dataset()
    bare.update({e.tag: e for e in file})
    bare.save_as(path, implicit_vr=syntax == ImplicitVRLittleEndian, little_endian=syntax != ExplicitVRBigEndian)


def series(folder: Path, volumes: list[dict[str, Any]], interleaved: bool = False, **common: Any) -> str:
    """Volumes whose images differ by 1000 each, in the order of instance numbers; slices 2 mm apart."""
    n = len(volumes)
    for t, changes in enumerate(volumes):
        for k, plane in enumerate(STACK):
            number = (k * n + t if interleaved else t * len(STACK) + k) + 1
            file = image(plane + 1000 * t, (0, 0, 2 * k), **{"InstanceNumber": number, **common, **changes})
            save(file, folder / f"{number * 7919 % 997:03d}.dcm")
    return str(folder)


def by_dcm2niix(source: Path, out: Path) -> list[nibabel.Nifti1Image]:
    """What dcm2niix makes of a folder."""
    dcm2niix = pytest.importorskip("dcm2niix")
    out.mkdir()
    subprocess.run([dcm2niix.bin, "-z", "n", "-f", "%s_%e", "-o", out, source], check=True, capture_output=True)
    return [nibabel.load(file) for file in sorted(out.glob("*.nii"))]


def check_same(ours: Volume, theirs: nibabel.Nifti1Image, time: int | None = None) -> None:
    """Every voxel has its value at the same place of the patient."""
    values = np.asarray(theirs.dataobj)
    values = values if time is None else values[..., time]
    assert ours.dims == values.shape[:3]
    index = np.indices(ours.dims).reshape(3, -1)
    place = ours.affine[:3, :3] @ index + ours.affine[:3, 3:]
    there = np.linalg.inv(theirs.affine) @ np.vstack([place, np.ones(place.shape[1])])
    np.testing.assert_allclose(there[:3], np.round(there[:3]), atol=1e-3)
    x, y, z = np.round(there[:3]).astype(int)
    np.testing.assert_array_equal(ours.data[index[2], index[1], index[0]], values[x, y, z])


def csa(**tags: list[str]) -> bytes:
    """Siemens' CSA header of version 2 (nibabel's documentation of it)."""
    out = b"SV10\4\3\2\1" + struct.pack("<2I", len(tags), 77)
    for name, words in tags.items():
        out += struct.pack("<64si4s3i", name.encode(), len(words), b"FD\0\0", 3, 6, 77)
        for word in [*words, *[""] * (6 - len(words))]:
            data = word.encode() + b"\0" if word else b""
            out += struct.pack("<4i", len(data), len(data), 77, len(data)) + data.ljust(-(-len(data) // 4) * 4, b"\0")
    return out


def mosaic(
    slices: int, normal: float | None = None, private: bool = True, padding: tuple[int, int] = (0, 0), **changes: Any
) -> Dataset:
    """Tiles of 4 rows and 6 columns, each of its own number, and ``padding`` below and on the right of them.

    ``normal`` is 1 or -1 times that of rows and columns.
    """
    edge = int(np.ceil(np.sqrt(slices)))
    tiles = np.zeros((edge, 4, edge, 6), "<i2")
    for k in range(slices):
        tiles[k // edge, :, k % edge] = 100 * (k + 1) + np.arange(24).reshape(4, 6)
    kind = ["ORIGINAL", "PRIMARY", "M", "ND", "MOSAIC"]
    picture = np.pad(tiles.reshape(4 * edge, 6 * edge), [(0, n) for n in padding], constant_values=7)
    file = image(picture, (10, -20, 30), **{
        "Manufacturer": "SIEMENS", "ImageType": kind, "SpacingBetweenSlices": 2.5, "ImageOrientationPatient": OBLIQUE,
        **changes,
    })  # fmt: skip
    if private:
        file.private_block(0x19, "SIEMENS MR HEADER", create=True).add_new(0x0A, "US", slices)
    if normal is not None:
        across = normal * np.cross(OBLIQUE[:3], OBLIQUE[3:])
        block = file.private_block(0x29, "SIEMENS CSA HEADER", create=True)
        words = {"NumberOfImagesInMosaic": [str(slices)], "SliceNormalVector": [f"{v:.8f}" for v in across]}
        block.add_new(0x10, "OB", csa(**words))
    return file


@pytest.mark.parametrize(
    ("slices", "normal", "private"),
    [(3, None, True), (4, 1.0, False), (4, -1.0, True), (7, 1.0, True), (1, None, True)],
)
def test_mosaics_as_in_dcm2niix(tmp_path: Path, slices: int, normal: float | None, private: bool) -> None:
    save(mosaic(slices, normal, private), tmp_path / "in" / "m.dcm")
    ours = read_volume(str(tmp_path / "in"))
    assert ours.dims == (6, 4, slices)
    np.testing.assert_allclose(ours.spacing, (0.5, 1.5, 2.5 if slices > 1 else 2))
    if slices > 1:
        check_same(ours, by_dcm2niix(tmp_path / "in", tmp_path / "out")[0])


@pytest.mark.parametrize(("slices", "padding"), [(7, (2, 2)), (13, (0, 3)), (4, (1, 0))])
def test_mosaics_with_padding_lie_where_nibabel_puts_them(
    tmp_path: Path, slices: int, padding: tuple[int, int]
) -> None:
    """Tiles are whole pixels; nibabel (and dcm2niix) give their size and place, but do not read such pixels rightly."""
    from nibabel.nicom.dicomwrappers import MosaicWrapper

    save(mosaic(slices, 1.0, True, padding), tmp_path / "m.dcm")
    ours, theirs = read_volume(str(tmp_path)), MosaicWrapper(pydicom.dcmread(tmp_path / "m.dcm"), n_mosaic=slices)
    assert ours.dims == (*theirs.image_shape[1::-1], slices)
    np.testing.assert_array_equal(
        ours.data, 100 * np.arange(1, slices + 1)[:, None, None] + np.arange(24).reshape(4, 6)
    )
    np.testing.assert_allclose(ours.origin, theirs.image_position * [-1, -1, 1], atol=1e-4)


def test_mosaics_over_time_are_a_series(tmp_path: Path) -> None:
    for t in range(3):
        file = mosaic(4, 1.0, InstanceNumber=t + 1, AcquisitionNumber=t + 1)
        file.PixelData = (np.frombuffer(file.PixelData, "<i2") + 1000 * t).tobytes()
        save(file, tmp_path / "in" / f"{2 - t}.dcm")
    theirs = by_dcm2niix(tmp_path / "in", tmp_path / "out")[0]
    for t in range(3):
        check_same(read_volume(str(tmp_path / "in"), ReadOptions(time=t)), theirs, t)


def test_a_mosaic_that_does_not_say_how_many_slices_it_has(tmp_path: Path) -> None:
    save(mosaic(4, private=False), tmp_path / "m.dcm")
    with pytest.raises(DataError, match=r"does not say how many slices .*NumberOfImagesInMosaic: try dcm2niix"):
        read_volume(str(tmp_path / "m.dcm"))
    save(mosaic(4, Rows=1, PixelData=None), tmp_path / "n.dcm")
    with pytest.raises(DataError, match="a mosaic of 12 x 1 pixels with 4 slices; expected 2 tiles a side"):
        read_volume(str(tmp_path / "n.dcm"))


SPLITS = [  # what differs between volumes, and their names
    ([{"TemporalPositionIdentifier": t} for t in (1, 2, 3)],
     ["TemporalPositionIdentifier 1", "TemporalPositionIdentifier 2"]),
    ([{"EchoTime": e} for e in (4.92, 7.38)], ["EchoTime 4.92 ms", "EchoTime 7.38 ms"]),
    ([{"DiffusionBValue": b} for b in (0.0, 500.0, 1000.0)], ["DiffusionBValue 0 s/mm2", "DiffusionBValue 500 s/mm2"]),
    ([{"ImageType": ["ORIGINAL", "PRIMARY", p, "ND"]} for p in "MP"], ["magnitude", "phase"]),
    ([{"TriggerTime": t} for t in (0.0, 51.5)], ["TriggerTime 0 ms", "TriggerTime 51.5 ms"]),
    ([{"AcquisitionNumber": n} for n in (1, 2)], ["AcquisitionNumber 1", "AcquisitionNumber 2"]),
    ([{}, {}, {}], ["volume 0", "volume 1"]),
    ([{"EchoTime": e, "ImageType": ["ORIGINAL", "PRIMARY", p, "ND"]} for e in (4.5, 9.0) for p in "MP"],
     ["EchoTime 4.5 ms, magnitude", "EchoTime 4.5 ms, phase"]),
    ([{"DiffusionBValue": b, "AcquisitionNumber": n} for n, b in enumerate((0.0, 700.0, 700.0, 0.0))],
     ["AcquisitionNumber 0", "AcquisitionNumber 1"]),
]  # fmt: skip


@pytest.mark.parametrize("interleaved", [False, True])
@pytest.mark.parametrize(("volumes", "names"), SPLITS)
def test_several_volumes_of_a_series(tmp_path: Path, volumes: list, names: list[str], interleaved: bool) -> None:
    source = series(tmp_path, volumes, interleaved)
    with pytest.raises(
        SeveralSteps, match=rf"{len(volumes)} volumes in one series; expected one: try --time N"
    ) as caught:
        read_volume(source)
    assert caught.value.names[:2] == names
    assert len(time_steps(source, ReadOptions())) == len(volumes)
    for t in range(len(volumes)):
        np.testing.assert_array_equal(read_volume(source, ReadOptions(time=t)).data, STACK + 1000 * t)
    for wanted in (names[1], f"4/{names[1]}", f"1.2.3/{names[1]}"):
        np.testing.assert_array_equal(read_volume(source, ReadOptions(array=wanted)).data, STACK + 1000)
    refused(UsageError, "no volume 'other'; it has ", read_volume, source, ReadOptions(array="4/other"))
    with pytest.raises(UsageError, match=rf"--time 9: expected a time step from 0 to {len(volumes) - 1}"):
        read_volume(source, ReadOptions(time=9))


def test_times_as_in_dcm2niix(tmp_path: Path) -> None:
    changes = [{"TemporalPositionIdentifier": t + 1, "AcquisitionNumber": t + 1} for t in range(3)]
    source = series(tmp_path / "in", changes, ImageOrientationPatient=[1, 0, 0, 0, -1, 0])
    theirs = by_dcm2niix(tmp_path / "in", tmp_path / "out")[0]
    assert theirs.shape == (5, 6, 4, 3)
    for t in range(3):
        check_same(read_volume(source, ReadOptions(time=t)), theirs, t)


def test_one_image_that_was_taken_again_is_skipped(tmp_path: Path) -> None:
    series(tmp_path, [{"AcquisitionNumber": 1}])
    save(image(STACK[0] + 7, (0, 0, 0), AcquisitionNumber=2, InstanceNumber=9), tmp_path / "again.dcm")
    with pytest.warns(UserWarning, match="skipped 1 images in places of others"):
        np.testing.assert_array_equal(read_volume(str(tmp_path)).data, STACK)


def test_copies_of_an_image_count_once(tmp_path: Path) -> None:
    series(tmp_path, [{}])
    for file in sorted(tmp_path.iterdir())[:2]:
        shutil.copy(file, tmp_path / f"{file.stem} (1).dcm")
    with pytest.warns(UserWarning, match="skipped 2 files that are copies of others"):
        np.testing.assert_array_equal(read_volume(str(tmp_path)).data, STACK)


def test_images_that_share_a_number_by_mistake_are_no_copies(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(read_volume(series(tmp_path, [{}], SOPInstanceUID="1.2.3.4")).data, STACK)


@pytest.mark.parametrize(
    ("step", "digits", "n"), [(1 / 3, 2, 12), (1 / 3, 1, 30), (0.625, 1, 20), (1.25, 1, 9), (2.0, 4, 5)]
)
def test_rounded_positions_as_in_simpleitk(tmp_path: Path, step: float, digits: int, n: int) -> None:
    for k in range(n):
        save(
            image(STACK[k % 4], (0, 0, 0), ImagePositionPatient=["0", "0", f"{step * k:.{digits}f}"]),
            tmp_path / f"{k}.dcm",
        )
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(tmp_path)))
    theirs, ours = reader.Execute(), read_volume(str(tmp_path), LPS)
    np.testing.assert_allclose(ours.spacing, theirs.GetSpacing(), rtol=1e-6)
    np.testing.assert_array_equal(ours.data, sitk.GetArrayFromImage(theirs))


@pytest.mark.parametrize("missing", [1, 5, 10])
def test_a_missing_slice_is_never_taken_for_rounding(tmp_path: Path, missing: int) -> None:
    for k in range(12):
        if k != missing:
            save(image(STACK[k % 4], (0, 0, 0), ImagePositionPatient=["0", "0", f"{k}"]), tmp_path / f"{k}.dcm")
    with pytest.raises(
        DataError, match=r"slices 1 to 2 mm apart .*is a slice missing\? --dims X Y Z .*--spacing X Y Z"
    ):
        read_volume(str(tmp_path))


def test_uneven_slices_are_resampled_or_taken_as_even(tmp_path: Path) -> None:
    heights = (0.0, 2.0, 3.0, 7.0)
    for k, z in enumerate(heights):
        plane = np.round(100 * z + 10 * np.arange(6)[:, None] + np.arange(5)[None])
        file = image(
            plane, np.array([5, 6, 7]) + z * np.cross(OBLIQUE[:3], OBLIQUE[3:]), ImageOrientationPatient=OBLIQUE
        )
        save(file, tmp_path / f"{k}.dcm")
    even = read_volume(str(tmp_path), replace(LPS, spacing=(0.5, 1.5, 3)))
    assert (even.dims, even.spacing, even.origin) == ((5, 6, 4), (0.5, 1.5, 3), (5, 6, 7))
    volume = read_volume(str(tmp_path), replace(LPS, dims=(4, 5, 14)))
    assert volume.dims == (4, 5, 14)
    np.testing.assert_allclose(volume.spacing, (0.5, 1.5, 0.5))
    index = np.indices(volume.dims).reshape(3, -1)
    place = volume.affine[:3, :3] @ index + volume.affine[:3, 3:] - [[5], [6], [7]]
    x, y, z = np.column_stack([OBLIQUE[:3], OBLIQUE[3:], np.cross(OBLIQUE[:3], OBLIQUE[3:])]).T @ place
    np.testing.assert_allclose(volume.data[index[2], index[1], index[0]], 100 * z + 10 * y / 1.5 + x / 0.5, atol=1e-3)
    with pytest.raises(UsageError, match="its slices lie at even distances; leave out --dims"):
        read_volume(series(tmp_path / "even", [{}]), ReadOptions(dims=(2, 2, 2)))


@pytest.mark.parametrize("syntax", [ImplicitVRLittleEndian, ExplicitVRLittleEndian, ExplicitVRBigEndian])
@pytest.mark.parametrize("among", [False, True])
def test_files_without_preamble(tmp_path: Path, syntax: pydicom.uid.UID, among: bool) -> None:
    for k, plane in enumerate(STACK):
        values = plane.astype(">i2" if syntax == ExplicitVRBigEndian else "<i2")
        file = image(plane, (0, 0, 2 * k), PixelData=values.tobytes())
        file.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian if among and k else syntax
        if among and k:
            file.PixelData = plane.astype("<i2").tobytes()
        save(file, tmp_path / f"{k}", preamble=among and k > 0)
    np.testing.assert_array_equal(read_volume(str(tmp_path)).data, STACK)
    np.testing.assert_array_equal(read_volume(str(tmp_path / "0")).data, STACK[:1])
    assert pydicom.dcmread(tmp_path / "0", force=True).Rows == 6


def test_text_and_raw_values_are_no_dicom_without_preamble(tmp_path: Path) -> None:
    from vvgt_cli.volume.dicom.series import is_dicom

    for content in (b"", b"\x08\0\5\0" * 300, bytes(2000), bytes(range(256)) * 8, b"\x08\0\4\0\6\0\0\0" * 9):
        assert not is_dicom(content[:1024]), content[:20]


def nuclear(n: int, **changes: Any) -> Dataset:
    detector = Dataset()
    detector.ImagePositionPatient, detector.ImageOrientationPatient = [1, 2, 3], [1, 0, 0, 0, 1, 0]
    values = np.concatenate([STACK, STACK + 1000])[:n]
    return image(values, (0, 0, 0), **{
        "Modality": "NM", "NumberOfFrames": n, "DetectorInformationSequence": [detector], "SpacingBetweenSlices": 2,
        "ImagePositionPatient": None, "ImageOrientationPatient": None, **changes,
    })  # fmt: skip


def test_frames_of_nuclear_medicine(tmp_path: Path) -> None:
    save(nuclear(4), tmp_path / "a.dcm")
    volume = read_volume(str(tmp_path / "a.dcm"), LPS)
    assert (volume.spacing, volume.origin) == ((0.5, 1.5, 2), (1, 2, 3))
    np.testing.assert_array_equal(volume.data, STACK)
    theirs = sitk.ReadImage(str(tmp_path / "a.dcm"))
    np.testing.assert_allclose(volume.spacing, theirs.GetSpacing())
    np.testing.assert_array_equal(volume.data, sitk.GetArrayFromImage(theirs))
    save(nuclear(4, SpacingBetweenSlices=-2), tmp_path / "b.dcm")
    down = read_volume(str(tmp_path / "b.dcm"), LPS)  # PS3.3, C.8.4.8: stacked against the normal
    assert down.origin == (1, 2, -3)
    np.testing.assert_array_equal(down.data, STACK[::-1])
    save(nuclear(4, SliceVector=[3, 1, 2, 4]), tmp_path / "c.dcm")
    np.testing.assert_array_equal(read_volume(str(tmp_path / "c.dcm")).data, STACK[[1, 2, 0, 3]])


def test_gated_frames_of_nuclear_medicine_are_volumes(tmp_path: Path) -> None:
    save(nuclear(8, SliceVector=[1, 2, 3, 4] * 2, TimeSlotVector=[1] * 4 + [2] * 4), tmp_path / "a.dcm")
    with pytest.raises(SeveralSteps) as caught:
        read_volume(str(tmp_path / "a.dcm"))
    assert caught.value.names == ["TimeSlotVector 1", "TimeSlotVector 2"]
    np.testing.assert_array_equal(read_volume(str(tmp_path / "a.dcm"), ReadOptions(time=1)).data, STACK + 1000)


def test_frames_in_time_and_frames_without_a_place(tmp_path: Path) -> None:
    save(nuclear(4, FrameIncrementPointer=0x00181063, FrameTime=40), tmp_path / "a.dcm")
    refused(DataError, r"4 frames of a film .*expected slices of a volume", read_volume, str(tmp_path / "a.dcm"))
    save(nuclear(4, DetectorInformationSequence=None), tmp_path / "b.dcm")
    with pytest.raises(DataError, match=r"no ImagePositionPatient.*or --spacing X Y Z to stack images"):
        read_volume(str(tmp_path / "b.dcm"))
    volume = read_volume(str(tmp_path / "b.dcm"), ReadOptions(spacing=(1, 1, 3)))
    assert (volume.dims, volume.spacing, volume.space) == ((5, 6, 4), (1, 1, 3), None)
    np.testing.assert_array_equal(volume.data, STACK)
    save(nuclear(4, SpacingBetweenSlices=None, SliceThickness=None), tmp_path / "c.dcm")
    with pytest.raises(DataError, match="frames without SpacingBetweenSlices; expected it, or --spacing X Y Z"):
        read_volume(str(tmp_path / "c.dcm"))


def test_enhanced_frames_of_several_times(tmp_path: Path) -> None:
    file = image(np.concatenate([STACK, STACK + 1000]), (0, 0, 0), NumberOfFrames=8, ImagePositionPatient=None)
    file.PerFrameFunctionalGroupsSequence = []
    for f in range(8):
        group, place, content = Dataset(), Dataset(), Dataset()
        place.ImagePositionPatient, content.TemporalPositionIndex = [0, 0, 2.0 * (f % 4)], f // 4 + 1
        group.PlanePositionSequence, group.FrameContentSequence = [place], [content]
        file.PerFrameFunctionalGroupsSequence.append(group)
    save(file, tmp_path / "a.dcm")
    np.testing.assert_array_equal(read_volume(str(tmp_path / "a.dcm"), ReadOptions(time=1)).data, STACK + 1000)


def test_modality_look_up_tables_as_in_pydicom(tmp_path: Path) -> None:
    from pydicom.pixels import apply_modality_lut

    table = Dataset()
    table.LUTDescriptor, table.ModalityLUTType = [200, 0, 16], "US"
    table.add_new("LUTData", "OW", (3 * np.arange(200) + 5).astype("<u2").tobytes())
    volume = read_volume(series(tmp_path, [{}], ModalityLUTSequence=[table], PixelRepresentation=0))
    np.testing.assert_array_equal(volume.data, 3 * STACK + 5)
    one = pydicom.dcmread(next(iter(sorted(tmp_path.iterdir()))))
    k = int(one.InstanceNumber) - 1
    np.testing.assert_array_equal(volume.data[k], apply_modality_lut(one.pixel_array, one))


def test_zip_archives_and_dicomdir(tmp_path: Path) -> None:
    source = series(tmp_path / "in", [{}])
    for name, front in (("a.zip", ""), ("b.zip", "study/series/")):
        with zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(front + "readme.txt", "not an image")
            for file in Path(source).iterdir():
                archive.write(file, front + file.name)
        volume = read_volume(str(tmp_path / name))
        np.testing.assert_array_equal(volume.data, STACK)
        assert volume.name == name[0]
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as archive:
        archive.writestr("readme.txt", "not an image")
    refused(DataError, r"\(no DICOM files\).*unpack a zip of other files", read_volume, str(tmp_path / "c.zip"))
    shutil.copy(next(Path(source).iterdir()), Path(source) / "DICOMDIR")
    np.testing.assert_array_equal(read_volume(f"{source}/DICOMDIR").data, STACK)


def test_raw_values_that_begin_like_dicom_are_raw_where_they_are_said_to_be(tmp_path: Path) -> None:
    save(image(STACK[0], (0, 0, 0)), tmp_path / "v")
    size = (tmp_path / "v").stat().st_size
    assert read_volume(str(tmp_path / "v"), ReadOptions(dims=(size, 1, 1), dtype="uint8")).dims == (size, 1, 1)


def test_places_with_different_numbers_of_images(tmp_path: Path) -> None:
    series(tmp_path, [{}, {}, {}])
    next(iter(sorted(tmp_path.iterdir()))).unlink()
    with pytest.raises(DataError, match="11 images in 4 places, 2 to 3 in each, and no attribute tells volumes apart"):
        read_volume(str(tmp_path))


def real_world(slope: float, intercept: float, unit: str) -> Dataset:
    mapping, code = Dataset(), Dataset()
    mapping.RealWorldValueSlope, mapping.RealWorldValueIntercept = slope, intercept
    code.CodeValue, code.CodingSchemeDesignator, code.CodeMeaning = unit, "UCUM", unit
    mapping.MeasurementUnitsCodeSequence = [code]
    return mapping


@pytest.mark.parametrize("rescale", [{}, {"RescaleSlope": 1, "RescaleIntercept": 0, "RescaleType": "US"}])
def test_real_world_values_where_no_other_scale_is_stated(tmp_path: Path, rescale: dict) -> None:
    mapping = [real_world(0.5, 3.0, "mm2/s")]
    volume = read_volume(series(tmp_path, [{}], RealWorldValueMappingSequence=mapping, **rescale))
    np.testing.assert_array_equal(volume.data * volume.slope + volume.intercept, STACK * 0.5 + 3)
    assert (volume.value_unit, volume.hounsfield) == ("mm2/s", False)


def test_real_world_values_beside_another_scale_are_said(tmp_path: Path) -> None:
    told = {"RealWorldValueMappingSequence": [real_world(0.5, 3.0, "mm2/s")], "RescaleSlope": 2, "RescaleIntercept": 1}
    with pytest.warns(UserWarning, match="its RealWorldValueMapping is not applied"):
        volume = read_volume(series(tmp_path, [{}], **told))
    assert (volume.slope, volume.intercept, volume.value_unit) == (2, 1, "")


@pytest.mark.parametrize(("slopes", "scales"), [((2, 1, 4, 2), (0.5,)), ((1, 1, 1, 1), (0.5, 3.0))])
def test_real_world_values_are_of_all_slices_or_none(tmp_path: Path, slopes: tuple, scales: tuple) -> None:
    mappings = [real_world(scale, 3.0, "mm2/s") for scale in scales]
    for k, (plane, slope) in enumerate(zip(STACK, slopes, strict=True)):
        told = {"RealWorldValueMappingSequence": mappings, "RescaleSlope": slope, "RescaleIntercept": 0}
        save(image(plane, (0, 0, 2 * k), InstanceNumber=k + 1, **told), tmp_path / f"{k}.dcm")
    with pytest.warns(UserWarning, match="its RealWorldValueMapping is not applied") as said:
        volume = read_volume(str(tmp_path))
    np.testing.assert_array_equal(volume.data * volume.slope + volume.intercept, STACK * np.reshape(slopes, (4, 1, 1)))
    assert (volume.value_unit, len(said)) == ("", 1)


def test_parametric_maps_as_in_highdicom(tmp_path: Path) -> None:
    import highdicom
    from highdicom.pm import ParametricMap, RealWorldValueMapping
    from pydicom.sr.codedict import codes

    unit = codes.UCUM.NoUnits
    mapping = RealWorldValueMapping("a", "b", unit=unit, value_range=(0, 255), slope=0.5, intercept=3.0)
    asked = {"PatientName": "", "PatientBirthDate": "", "PatientSex": "", "StudyID": "", "StudyDate": "",
             "StudyTime": "", "AccessionNumber": "", "ReferringPhysicianName": "", "FrameOfReferenceUID": "1.2.9",
             "PositionReferenceIndicator": "", "InstanceNumber": 1}  # fmt: skip
    source = [image(plane, (0, 0, 2 * k), SOPInstanceUID=f"1.2.{k}", **asked) for k, plane in enumerate(STACK)]
    who = {"manufacturer": "m", "manufacturer_model_name": "n", "software_versions": "1", "device_serial_number": "1"}
    made = ParametricMap(
        source, STACK.astype("u2"), "1.2.7", 2, "1.2.8", 1, contains_recognizable_visual_features=False,
        real_world_value_mappings=[mapping], window_center=1, window_width=2, **who,
    )  # fmt: skip
    made.save_as(tmp_path / "v.dcm")
    volume = read_volume(str(tmp_path / "v.dcm"))
    theirs = highdicom.imread(tmp_path / "v.dcm").get_volume().array
    np.testing.assert_array_equal(volume.data * volume.slope + volume.intercept, STACK * 0.5 + 3)
    assert sorted(theirs.ravel()) == sorted((STACK * 0.5 + 3).ravel())


def test_values_in_the_high_bits_are_refused(tmp_path: Path) -> None:
    path = series(tmp_path, [{}], BitsStored=12, HighBit=15)
    refused(DataError, "HighBit 15 with BitsStored 12; expected 11", read_volume, path)
