"""Where voxels are: affines against nibabel's, SimpleITK's and pydicom's, the same in every format."""

import tarfile
from pathlib import Path

import nibabel as nib
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk

from tests import anatomy
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, Volume, read_volume
from vvgt_cli.volume.space import axis_facts, world_axis

CORNERS = np.array([[i, j, k, 1.0] for i in (0, 21) for j in (0, 17) for k in (0, 14)])


def assert_placed(volume: Volume, affine: np.ndarray, atol: float = 1e-3) -> None:
    """Corner voxels within ``atol`` mm, and the values of the balls where they belong."""
    np.testing.assert_allclose(CORNERS @ volume.affine.T, CORNERS @ affine.T, atol=atol)
    np.testing.assert_array_equal(volume.data, anatomy.balls(affine))


@pytest.mark.parametrize("form", ["sform", "qform"])
@pytest.mark.parametrize("grid", anatomy.GRIDS)
def test_nifti_as_nibabel_has_it(tmp_path: Path, grid: str, form: str) -> None:
    affine = anatomy.place(anatomy.GRIDS[grid])
    path = anatomy.nifti(tmp_path / "v", anatomy.balls(affine), affine, form)
    np.testing.assert_allclose(nib.load(path).affine, affine, atol=1e-4)
    volume = read_volume(str(path))
    assert volume.space == "RAS"
    assert_placed(volume, nib.load(path).affine if form == "sform" else affine)
    np.testing.assert_allclose(CORNERS @ volume.affine.T, CORNERS @ nib.load(path).affine.T, atol=1e-3)


def test_nifti_prefers_the_sform_and_without_forms_has_no_space(tmp_path: Path) -> None:
    affine, other = anatomy.place(anatomy.OBLIQUE), anatomy.place(anatomy.CORONAL)
    image = nib.Nifti1Image(anatomy.balls(affine).transpose(2, 1, 0), None)
    image.header.set_zooms(anatomy.ZOOMS)
    image.set_qform(other, code=2)
    image.set_sform(affine, code=4)
    image.to_filename(tmp_path / "both.nii")
    np.testing.assert_allclose(read_volume(str(tmp_path / "both.nii")).affine, image.affine, atol=1e-4)
    image.set_sform(np.diag([1, 1, 0, 1]), code=1)  # flat: no place at all
    image.to_filename(tmp_path / "flat.nii")
    np.testing.assert_allclose(read_volume(str(tmp_path / "flat.nii")).affine, other, atol=1e-3)
    image.set_qform(None, code=0)
    image.set_sform(None, code=0)
    image.to_filename(tmp_path / "none.nii")
    volume = read_volume(str(tmp_path / "none.nii"))
    assert volume.space is None
    np.testing.assert_allclose(volume.affine, np.diag([*anatomy.ZOOMS, 1]))


def test_nifti_in_micrometres_is_in_mm(tmp_path: Path) -> None:
    affine = anatomy.place(anatomy.OBLIQUE)
    path = anatomy.nifti(tmp_path / "v", anatomy.balls(affine), affine)
    image = nib.load(path)
    image.header.set_xyzt_units("micron")
    image.to_filename(tmp_path / "small.nii")
    small = read_volume(str(tmp_path / "small.nii")).affine
    np.testing.assert_allclose(small[:3] * 1000, nib.load(path).affine[:3], rtol=1e-6)
    np.testing.assert_allclose(small[:3, 3], np.array(sitk_affine(tmp_path / "small.nii"))[:3, 3], rtol=1e-5)


def sitk_affine(path: Path) -> np.ndarray:
    """RAS affine by `TransformIndexToPhysicalPoint`."""
    image = sitk.ReadImage(str(path))
    zero = np.array(image.TransformIndexToPhysicalPoint((0, 0, 0)))
    far = [d - 1 for d in image.GetSize()]
    columns = [
        (np.array(image.TransformIndexToPhysicalPoint([far[a] if a == b else 0 for a in range(3)])) - zero) / far[b]
        for b in range(3)
    ]
    return anatomy.TO_LPS @ np.vstack([np.column_stack([*columns, zero]), [0, 0, 0, 1]])


@pytest.mark.parametrize("suffix", [".nrrd", ".mha", ".nii"])
@pytest.mark.parametrize("grid", anatomy.GRIDS)
def test_what_simpleitk_writes(tmp_path: Path, grid: str, suffix: str) -> None:
    affine = anatomy.place(anatomy.GRIDS[grid])
    path = anatomy.itk(tmp_path / f"v{suffix}", anatomy.balls(affine), affine)
    volume = read_volume(str(path))
    assert volume.space == "RAS"
    assert_placed(volume, affine)
    np.testing.assert_allclose(CORNERS @ volume.affine.T, CORNERS @ sitk_affine(path).T, atol=1e-3)


@pytest.mark.parametrize("space", ["right-anterior-superior", "left-posterior-superior", "LAS"])
@pytest.mark.parametrize("grid", ["axial", "oblique left"])
def test_nrrd_spaces(tmp_path: Path, grid: str, space: str) -> None:
    affine = anatomy.place(anatomy.GRIDS[grid])
    path = anatomy.nrrd(tmp_path / "v.nrrd", anatomy.balls(affine), affine, space)
    assert_placed(read_volume(str(path)), affine, 1e-9)
    np.testing.assert_allclose(CORNERS @ sitk_affine(path).T, CORNERS @ affine.T, atol=1e-3)


def test_nrrd_of_left_handed_coordinates_is_made_right_handed(tmp_path: Path) -> None:
    affine = anatomy.place(anatomy.OBLIQUE)
    path = anatomy.nrrd(tmp_path / "v.nrrd", anatomy.balls(affine), affine, "3D-left-handed")
    volume = read_volume(str(path))
    assert volume.space is None
    assert_placed(volume, affine, 1e-9)


def test_metaimage_lists_axes_one_after_the_other_and_has_a_space_where_it_names_one(tmp_path: Path) -> None:
    header = "ObjectType = Image\nNDims = 3\nDimSize = 2 2 2\nElementType = MET_UCHAR\nElementSpacing = 2 3 4\n{}"
    matrix = "TransformMatrix = 0 1 0 0 0 1 1 0 0\nOffset = 7 8 9\n"  # i along y, j along z, k along x, LPS
    expected = [[0, 0, -4, -7], [-2, 0, 0, -8], [0, 3, 0, 9]]
    cases = {
        matrix: expected,
        matrix + "AnatomicalOrientation = RAI\n": expected,
        matrix + "AnatomicalOrientation = ???\n": [[0, 0, 4, 7], [2, 0, 0, 8], [0, 3, 0, 9]],
        "AnatomicalOrientation = RAI\n": [[-2, 0, 0, 0], [0, -3, 0, 0], [0, 0, 4, 0]],
        "": [[2, 0, 0, 0], [0, 3, 0, 0], [0, 0, 4, 0]],
    }
    for text, affine in cases.items():
        path = tmp_path / "v.mha"
        path.write_bytes(header.format(text).encode() + b"ElementDataFile = LOCAL\n" + bytes(8))
        np.testing.assert_array_equal(read_volume(str(path)).affine[:3], affine)


@pytest.mark.parametrize("grid", anatomy.GRIDS)
def test_dicom_as_its_headers_have_it(tmp_path: Path, grid: str) -> None:
    """Left-handed grids are series in reversed order: sorted along the normal, they become right-handed."""
    affine = anatomy.place(anatomy.GRIDS[grid])
    volume = read_volume(str(anatomy.dicom(tmp_path / "scan", anatomy.balls(affine), affine)))
    assert np.linalg.det(volume.axes) == pytest.approx(1, abs=1e-6)
    found = set()
    for path in (tmp_path / "scan").iterdir():  # every corner of every slice by PS3.3, equation C.7.6.2.1-1
        file = pydicom.dcmread(path)
        across, down = np.array(file.ImageOrientationPatient, float).reshape(2, 3)
        position = np.array(file.ImagePositionPatient, float)
        between = np.array(file.PixelSpacing, float)
        k = round(float((np.linalg.inv(volume.affine) @ [*(position * (-1, -1, 1)), 1])[2]))
        found.add(k)
        np.testing.assert_array_equal(volume.data[k], file.pixel_array)
        for i, j in ((0, 0), (21, 0), (0, 17), (21, 17)):
            expected = (position + across * between[1] * i + down * between[0] * j) * (-1, -1, 1)
            np.testing.assert_allclose((volume.affine @ [i, j, k, 1])[:3], expected, atol=1e-3)
    assert found == set(range(15))


def test_a_tilted_gantry_is_an_affine_map(tmp_path: Path) -> None:
    affine = anatomy.place(anatomy.AXIAL)
    affine[1, 2] = 0.7  # each slice 0.7 mm further to anterior
    volume = read_volume(str(anatomy.dicom(tmp_path / "scan", anatomy.balls(affine), affine)))
    assert volume.sheared
    flipped = np.linalg.inv(volume.affine) @ affine  # index to index: DICOM's rows and columns are kept
    np.testing.assert_allclose(flipped, np.eye(4), atol=1e-6)
    assert_placed(volume, affine)


@pytest.mark.parametrize("grid", anatomy.GRIDS)
def test_vti_as_vtk_has_it(tmp_path: Path, grid: str) -> None:
    affine = anatomy.place(anatomy.GRIDS[grid])
    volume = read_volume(str(anatomy.vti(tmp_path / "v.vti", anatomy.balls(affine), affine)))
    assert volume.space is None
    assert_placed(volume, affine, 1e-5)


@pytest.mark.parametrize(
    ("grid", "rows"),  # of the files' matrices in tests/fixtures/vdb/write_vdb.cc, which act on rows
    [
        ("turned", [[0, 2, 0], [-3, 0, 0], [0, 0, 4], [7, 8, 9]]),
        ("mirrored", [[1, 0, 0], [0, -2, 0], [0, 0, 3.5], [0, 0, 0]]),
        ("affine", [[2, 0, 0], [0, 3, 0], [0, 0, 4], [5, 6, 7]]),
        ("sheared", [[1, 0, 0], [0.5, 1, 0], [0, 0, 1], [0, 0, 0]]),
    ],
)
def test_openvdb(tmp_path: Path, grid: str, rows: list[list[float]]) -> None:
    with tarfile.open(Path(__file__).parent / "fixtures" / "vdb" / "grids.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    volume = read_volume(str(next(tmp_path.rglob("transforms.vdb"))), ReadOptions(array=grid))
    low = np.linalg.inv(np.array(rows)[:3].T) @ (volume.affine[:3, 3] - rows[3])  # index of the first voxel: whole
    np.testing.assert_allclose(low, np.round(low), atol=1e-9)
    np.testing.assert_allclose(volume.affine[:3, :3], np.array(rows)[:3].T, atol=1e-12)
    assert volume.sheared == (grid == "sheared")


def test_the_other_space_and_volumes_without_one(tmp_path: Path) -> None:
    affine = anatomy.place(anatomy.OBLIQUE)
    path = anatomy.nifti(tmp_path / "v", anatomy.balls(affine), affine)
    lps = read_volume(str(path), ReadOptions(space="LPS"))
    assert lps.space == "LPS"
    np.testing.assert_allclose(lps.affine, anatomy.TO_LPS @ read_volume(str(path)).affine)
    plain = anatomy.vti(tmp_path / "v.vti", anatomy.balls(affine), affine)
    with pytest.raises(UsageError, match="--space RAS: v states no anatomical space; leave it out"):
        read_volume(str(plain), ReadOptions(space="RAS"))


def test_axes_in_words() -> None:
    facts = axis_facts(anatomy.place(anatomy.SAGITTAL * (1, 1, -1)), "RAS")
    assert (facts["axes"], facts["handedness"]) == ({"i": "A-P", "j": "S-I", "k": "R-L"}, "left")
    lps = axis_facts(anatomy.TO_LPS @ anatomy.place(anatomy.SAGITTAL), "LPS")
    assert (lps["axes"], lps["handedness"]) == ({"i": "A-P", "j": "S-I", "k": "L-R"}, "right")
    turned = axis_facts(anatomy.place(anatomy.turned(0, 0, np.radians(-20))), None)["axes"]
    assert turned == {"i": "x (20 degrees off)", "j": "y (20 degrees off)", "k": "z"}


@pytest.mark.parametrize(
    ("name", "ras", "lps"),
    [("superior", "z", "z"), ("inferior", "-z", "-z"), ("right", "x", "-x"), ("left", "-x", "x"),
     ("anterior", "y", "-y"), ("posterior", "-y", "y"), ("-y", "-y", "-y")],
)  # fmt: skip
def test_directions_of_the_body(name: str, ras: str, lps: str) -> None:
    assert (world_axis(name, "RAS"), world_axis(name, "LPS")) == (ras, lps)


@pytest.mark.parametrize(
    "direction",
    [(1.0, 0, 0, 0, 1, 0, 0, 1, 0), (np.nan, 0, 0, 0, 1, 0, 0, 0, 1), (1.0, 0, 0)],
)
def test_axes_in_a_plane_are_refused(direction: tuple[float, ...]) -> None:
    with pytest.raises(DataError, match="axes that do not lie in a plane"):
        Volume(np.zeros((2, 2, 2)), direction=direction)
