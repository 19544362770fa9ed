"""DICOM segmentations, written by highdicom: label maps with their own tables, over their scans; contours refused."""

import sys
from pathlib import Path

import highdicom as hd
import numpy as np
import pydicom
import pytest
from highdicom.color import CIELabColor
from pydicom.dataset import Dataset
from pydicom.sr.codedict import codes
from pydicom.uid import UID, generate_uid

from tests.refused import refused
from tests.test_volume_slices import header, write_series
from vvgt_cli.dvr.layers import common_grid, grid_of
from vvgt_cli.errors import DataError, SeveralComponents, UsageError
from vvgt_cli.field.layered import layers_of, open_content
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import read_ply
from vvgt_cli.look.label_files import read_labels
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.dicom.segmentation import is_segmentation_file

SHAPE = (6, 8, 10)
TILT = np.radians(20)
ROWS = [1, 0, 0, 0, np.cos(TILT), np.sin(TILT)]  # directions along a row and down a column, LPS
NORMAL = np.cross(ROWS[:3], ROWS[3:])
CORNER, PIXEL, STEP = np.array([-5.0, 7.0, 20.0]), (0.8, 0.5), 2.0  # between rows and columns, mm; between slices
SMALL = ("--max-gaussians", 300, "--screen", 64, "--steps", 0)
REFERENCE = "1.2.826.77"
LIVER, SPLEEN = (255, 51, 0), (0, 0, 255)


def scan(folder: Path, reference: str = REFERENCE) -> list[Dataset]:
    """CT slices of a tilted grid; values rise along the slices."""
    folder.mkdir()
    files = []
    for k in range(SHAPE[0]):
        file = header(*SHAPE[1:])
        file.StudyInstanceUID, file.SeriesInstanceUID, file.FrameOfReferenceUID = "1.2.5", "1.2.6", reference
        for name in ("PatientID", "PatientName", "PatientBirthDate", "PatientSex", "AccessionNumber", "StudyID"):
            setattr(file, name, "")
        file.StudyDate = file.StudyTime = ""
        file.ImageOrientationPatient, file.PixelSpacing = ROWS, list(PIXEL)
        file.ImagePositionPatient = [float(v) for v in CORNER + k * STEP * NORMAL]
        file.SliceThickness, file.RescaleSlope, file.RescaleIntercept = STEP, 1, 0
        file.PixelData = np.full(SHAPE[1:], 100 * k, "<i2").tobytes()
        file.save_as(folder / f"{k}.dcm", enforce_file_format=True)
        files.append(file)
    return files


def described(number: int, name: str, rgb: tuple[int, int, int] | None) -> hd.seg.SegmentDescription:
    return hd.seg.SegmentDescription(
        number, name, codes.SCT.Organ, codes.SCT.Organ, hd.seg.SegmentAlgorithmTypeValues.MANUAL,
        display_color=None if rgb is None else CIELabColor.from_rgb(*rgb),
    )  # fmt: skip


def organs(overlap: bool = False) -> np.ndarray:
    """(z, y, x, 2) masks of two boxes that touch, or overlap; slices 0 and 5 hold neither."""
    masks = np.zeros((*SHAPE, 2), np.uint8)
    masks[1:5, 2:6, 1:5, 0] = 1
    masks[2:5, 2:7, 4 if overlap else 5 : 9, 1] = 1
    return masks


def write_seg(path: Path, files: list[Dataset], pixels: np.ndarray, kind: str = "BINARY", **given) -> None:
    names = given.pop("names", (("liver", LIVER), ("spleen", SPLEEN)))
    hd.seg.Segmentation(
        source_images=files[::-1], pixel_array=pixels[::-1], segmentation_type=kind,
        segment_descriptions=[described(n, *one) for n, one in enumerate(names, 1)],
        series_instance_uid=generate_uid(), series_number=9, sop_instance_uid=generate_uid(), instance_number=1,
        manufacturer="m", manufacturer_model_name="n", software_versions="1", device_serial_number="1", **given,
    ).save_as(path)  # fmt: skip


def palette() -> hd.PaletteColorLUTTransformation:
    """Black, liver, spleen."""
    luts = [
        hd.PaletteColorLUT(0, np.array([0, LIVER[c], SPLEEN[c]], np.uint8), name)
        for c, name in enumerate(("red", "green", "blue"))
    ]
    return hd.PaletteColorLUTTransformation(*luts)


@pytest.mark.parametrize("kind", ["BINARY", "LABELMAP", "PALETTE"])
def test_a_segmentation_is_a_label_map_on_the_grid_of_its_scan(tmp_path: Path, kind: str) -> None:
    files, path = scan(tmp_path / "ct"), tmp_path / "organs.dcm"
    if kind == "PALETTE":
        bare = (("liver", None), ("spleen", None))
        write_seg(path, files, organs(), "LABELMAP", names=bare, palette_color_lut_transformation=palette())
    else:
        write_seg(path, files, organs(), kind)
    ct, seg = read_volume(str(tmp_path / "ct")), read_volume(str(path))
    expected = organs()[..., 0] + 2 * organs()[..., 1]
    index = np.argwhere(expected)[:, ::-1]  # of the scan's voxels
    world = ct.affine @ np.c_[index, np.ones(len(index))].T
    own = np.linalg.inv(seg.affine) @ world
    np.testing.assert_allclose(own, np.round(own), atol=1e-4)
    x, y, z = np.round(own[:3]).astype(int)
    np.testing.assert_array_equal(seg.data[z, y, x], expected[expected > 0])
    assert (seg.data > 0).sum() == (expected > 0).sum()
    table = read_labels(str(path))
    shown = [(e.number, e.name, e.opacity) for e in table.labels if e.number]
    assert shown == [(1, "liver", 1.0), (2, "spleen", 1.0)]
    rgb = np.array([e.color for e in table.labels if e.number])
    np.testing.assert_allclose(rgb, np.array([LIVER, SPLEEN]) / 255, atol=2.5 / 255)
    assert is_segmentation_file(str(path))
    assert not is_segmentation_file(str(tmp_path / "ct" / "0.dcm"))


def test_without_colours_they_are_distinct(tmp_path: Path) -> None:
    write_seg(tmp_path / "s.dcm", scan(tmp_path / "ct"), organs(), names=(("a", None), ("b", None)))
    table = read_labels(str(tmp_path / "s.dcm"))
    assert len({e.color for e in table.labels}) == 2


@pytest.mark.filterwarnings("error:.*frame of reference")
def test_a_scan_with_its_segmentation(tmp_path: Path) -> None:
    write_seg(tmp_path / "s.dcm", scan(tmp_path / "ct"), organs())
    source = load(
        SourceRequest(str(tmp_path / "ct"), tf="gray:0,0.01", layers=(SourceRequest(str(tmp_path / "s.dcm")),))
    )
    grid = grid_of(source.layers, source.volume)
    assert grid.shape[:3] == SHAPE
    red = grid[..., 0] > 1.5 * grid[..., 2]
    np.testing.assert_array_equal(red, organs()[..., 0] > 0)
    scan(tmp_path / "other", "1.2.3.4")
    other = open_content(str(tmp_path / "other"), ReadOptions())
    layers = layers_of(other, "gray", None) + layers_of(
        open_content(str(tmp_path / "s.dcm"), ReadOptions()), None, None
    )
    with pytest.warns(UserWarning, match="s: of another frame of reference"):
        common_grid(layers)


def test_by_command(vvgt, tmp_path: Path) -> None:
    write_seg(tmp_path / "s.dcm", scan(tmp_path / "ct"), organs())
    with pytest.warns(UserWarning, match="s: read as a label map by its segments"):
        done = vvgt("init", tmp_path / "s.dcm", "--light", "none", *SMALL[:4], "-o", tmp_path / "a.ply")
    assert done.code == 0, done.err
    colors = read_ply(str(tmp_path / "a.ply"))[0].colors
    assert (colors[:, 0] - colors[:, 2] > 0.9).any()
    assert (colors[:, 2] - colors[:, 0] > 0.9).any()
    split = ("--split-labels", "-o", tmp_path / "s_{}.ply")
    vvgt.ok("convert", tmp_path / "s.dcm", *SMALL, *split)
    assert sorted(p.name for p in tmp_path.glob("s_*.ply")) == ["s_1-liver.ply", "s_2-spleen.ply"]
    assert "label_map" in vvgt("info", tmp_path / "s.dcm").out.decode()


def test_segments_that_overlap_add_up(vvgt, tmp_path: Path) -> None:
    path = tmp_path / "s.dcm"
    write_seg(path, scan(tmp_path / "ct"), organs(overlap=True))
    refused(SeveralComponents, "2 segments that overlap", read_volume, str(path))
    source = load(SourceRequest(str(path)))
    grid = grid_of(source.layers, source.volume)
    both = organs(overlap=True).sum(axis=3) == 2
    own = np.round(np.linalg.inv(source.volume.affine) @ read_volume(str(tmp_path / "ct")).affine).astype(int)
    z, y, x = np.argwhere(both)[0]
    i, j, k, _ = own @ [x, y, z, 1]
    assert grid[..., 3].max() == pytest.approx(grid[k, j, i, 3])
    assert grid[k, j, i, 0] == pytest.approx(grid[k, j, i, 2], rel=0.05)  # as much of red as of blue
    assert set(np.unique(read_volume(str(path), ReadOptions(component=1)).data)) == {0, 2}
    source = load(SourceRequest(str(path), ReadOptions(component=1)))
    assert [layer.tf.labels[-1].name for layer in source.layers] == ["spleen"]
    refused(UsageError, "no segment 2; expected --component 0 to 1", read_volume, str(path), ReadOptions(component=2))


def test_what_is_no_label_map_is_refused_in_a_line(tmp_path: Path, monkeypatch) -> None:
    files = scan(tmp_path / "ct")
    write_seg(tmp_path / "f.dcm", files, organs() / 2.0, "FRACTIONAL")
    refused(DataError, r"of fractions; expected one of bits or of labels", read_volume, str(tmp_path / "f.dcm"))
    refused(DataError, r"expected a table of labels", read_labels, str(tmp_path / "ct" / "0.dcm"))
    write_seg(tmp_path / "s.dcm", files, organs())
    refused(UsageError, "on a grid of its own", read_volume, str(tmp_path / "s.dcm"), ReadOptions(dims=(3, 3, 3)))
    refused(UsageError, "has 1 time step", read_volume, str(tmp_path / "s.dcm"), ReadOptions(time=7))
    whole = (tmp_path / "s.dcm").read_bytes()
    for size in (300, 1000, len(whole) // 2, len(whole) - 9):
        (tmp_path / "cut.dcm").write_bytes(whole[:size])
        refused(DataError, r"cut\.dcm", load, SourceRequest(str(tmp_path / "cut.dcm")))
    monkeypatch.setitem(sys.modules, "highdicom", None)
    for read in (read_volume, read_labels):
        refused(DataError, r"needs highdicom .*pip install 'highdicom>=.*' 'pydicom>=", read, str(tmp_path / "s.dcm"))


def test_folders_of_segmentations_and_contours_say_what_to_give(tmp_path: Path) -> None:
    labels = []
    for name in ("liver", "spleen"):
        labels.append(Dataset())
        labels[-1].SegmentLabel = name
    write_series(
        tmp_path / "seg", SOPClassUID=UID("1.2.840.10008.5.1.4.1.1.66.4"), Modality="SEG", SegmentSequence=labels
    )
    with pytest.raises(DataError, match=r"\(DICOM SEG\) of 2 segments \(liver, spleen\); give its file, .*a-1\.dcm"):
        read_volume(str(tmp_path / "seg"))
    write_series(tmp_path / "rt", Modality="RTSTRUCT", Rows=None, Columns=None)
    said = (
        r"no DICOM images \(3 RTSTRUCT\).*of contours \(RTSTRUCT\) nothing is filled: export them as a label map or SEG"
    )
    for source in (tmp_path / "rt", tmp_path / "rt" / "a-1.dcm"):
        refused(DataError, said if source.is_dir() else said.replace("3", "1"), read_volume, str(source))
    assert pydicom.dcmread(tmp_path / "rt" / "a-1.dcm").Modality == "RTSTRUCT"
