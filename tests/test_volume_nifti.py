"""NIfTI against nibabel: types, byte orders, scaling, geometry, series."""

from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, Volume, read_volume
from vvgt_cli.volume.label_maps import recognised

TYPES = ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"]
VALUES = np.random.default_rng(2).integers(0, 100, (5, 4, 3))  # nibabel's axes: x, y, z


def data_values(volume: Volume) -> np.ndarray:
    """slope * stored + intercept, in nibabel's axes (x, y, z)."""
    return (volume.data.astype(np.float64) * volume.slope + volume.intercept).transpose(2, 1, 0)


def save(path: Path, values: np.ndarray, *, version: int = 1, slope: float = 1, inter: float = 0, order: str = "<"):
    kind = {1: nib.Nifti1Image, 2: nib.Nifti2Image}[version]
    header = kind.header_class(endianness=order)
    header.set_data_dtype(values.dtype.newbyteorder(order))
    image = kind(values, np.diag([2, 3, 4, 1]), header)
    image.header.set_slope_inter(slope, inter)
    image.to_filename(path)
    return str(path)


@pytest.mark.parametrize("code", TYPES)
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("version", [1, 2])
def test_types(tmp_path: Path, code: str, order: str, version: int) -> None:
    source = save(tmp_path / "v.nii", VALUES.astype(code), version=version, order=order)
    volume = read_volume(source)
    expected = nib.load(source)
    assert isinstance(volume.data, np.memmap)
    assert volume.data.dtype == expected.get_data_dtype()
    np.testing.assert_array_equal(data_values(volume), expected.get_fdata())
    assert volume.spacing == tuple(map(float, expected.header.get_zooms()))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
@pytest.mark.parametrize(("slope", "inter"), [(2.5, -7.0), (-0.125, 3.0), (1.0, 10.0)])
def test_stored_value_scaling(tmp_path: Path, version: int, suffix: str, slope: float, inter: float) -> None:
    """nibabel scales on reading, as the format demands; VTK's reader does not."""
    source = save(tmp_path / f"v{suffix}", VALUES.astype("i2"), version=version, slope=slope, inter=inter)
    volume = read_volume(source)
    assert (volume.slope, volume.intercept) == (slope, inter)
    np.testing.assert_allclose(data_values(volume), nib.load(source).get_fdata(), rtol=1e-12)


def test_colours_are_not_scaled(tmp_path: Path) -> None:
    """As nifti1.h has it."""
    colors = np.zeros(VALUES.shape, [("R", "u1"), ("G", "u1"), ("B", "u1")])
    colors["G"] = VALUES
    nib.Nifti1Image(colors, np.eye(4)).to_filename(source := tmp_path / "v.nii")
    patch(str(source), 112, np.array([2.5, -7.0], "<f4"))
    for component in (1, "magnitude"):
        np.testing.assert_array_equal(data_values(read_volume(str(source), ReadOptions(component=component))), VALUES)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("shape", [(5,), (5, 4), (5, 4, 3, 1, 1, 1, 1)])
def test_one_to_seven_axes(tmp_path: Path, shape: tuple[int, ...], version: int) -> None:
    values = np.arange(np.prod(shape), dtype="u1").reshape(shape)
    volume = read_volume(save(tmp_path / "v.nii", values, version=version))
    assert volume.dims == (*shape, 1, 1)[:3]
    np.testing.assert_array_equal(data_values(volume).ravel(), values.ravel())


@pytest.mark.parametrize("slope", [0.0, float("nan")])
def test_slope_zero_is_no_scaling(tmp_path: Path, slope: float) -> None:
    source = save(tmp_path / "v.nii", VALUES.astype("i2"))
    patch(source, 112, np.array([slope, 5], "<f4"))
    volume = read_volume(source)
    assert (volume.slope, volume.intercept) == (1, 0)
    np.testing.assert_array_equal(data_values(volume), nib.load(source).get_fdata())


def patch(source: str, at: int, values: np.ndarray) -> None:
    """Overwrite bytes of a file."""
    body = bytearray(Path(source).read_bytes())
    body[at : at + values.nbytes] = values.tobytes()
    Path(source).write_bytes(body)


def test_spacing_signs_and_zeros(tmp_path: Path) -> None:
    source = save(tmp_path / "v.nii", VALUES.astype("u1"))
    patch(source, 252, np.zeros(2, "<i2"))  # neither qform nor sform
    patch(source, 80, np.array([-2, 3, 0], "<f4"))
    refused(DataError, "try --spacing X Y Z", read_volume, source)
    assert read_volume(source, ReadOptions(spacing=(1, 1, 2))).spacing == (1, 1, 2)
    patch(source, 88, np.array([-4], "<f4"))
    assert read_volume(source).spacing == (2, 3, 4)


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_series(tmp_path: Path, suffix: str) -> None:
    series = np.stack([VALUES, VALUES + 100], -1).astype("i2")
    source = save(tmp_path / f"v{suffix}", series, slope=0.5, inter=-3)
    refused(UsageError, r"2 time steps; .*--time N", read_volume, source)
    expected = nib.load(source).get_fdata()
    for step in (0, 1):
        volume = read_volume(source, ReadOptions(component=step))
        np.testing.assert_array_equal(data_values(volume), expected[..., step])
        assert isinstance(volume.data, np.memmap) == (suffix == ".nii")
        np.testing.assert_array_equal(read_volume(source, ReadOptions(time=step)).data, volume.data)
    for options, message in (
        ({"time": 2}, "expected a time step from 0 to 1"),
        ({"time": 0, "component": 1}, "leave out --component 1"),
        ({"component": "T1"}, "not component 'T1'"),
    ):
        refused(UsageError, message, read_volume, source, ReadOptions(**options))
    norm = read_volume(source, ReadOptions(component="magnitude"))
    np.testing.assert_allclose(data_values(norm), np.linalg.norm(expected, axis=-1), rtol=1e-6)
    single = save(tmp_path / f"one{suffix}", series[..., :1])
    np.testing.assert_array_equal(data_values(read_volume(single)), series[..., 0])


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_vectors_over_time(tmp_path: Path, suffix: str) -> None:
    both = np.stack([np.stack([VALUES + 10 * t + 100 * c for t in range(2)], -1) for c in range(3)], -1).astype("i2")
    source = save(tmp_path / f"v{suffix}", both)
    for time in range(2):
        for component in range(3):
            volume = read_volume(source, ReadOptions(time=time, component=component))
            np.testing.assert_array_equal(data_values(volume), both[..., time, component])
    norm = read_volume(source, ReadOptions(time=1, component="magnitude"))
    np.testing.assert_allclose(data_values(norm), np.linalg.norm(both[..., 1, :].astype(float), axis=-1), rtol=1e-6)
    refused(UsageError, "2 time steps", read_volume, source, ReadOptions(component=1))
    refused(UsageError, "3 components", read_volume, source, ReadOptions(time=1))


@pytest.mark.parametrize(("intent", "version"), [("vector", 1), ("displacement vector", 2), (2006, 1)])
def test_a_fourth_axis_of_vectors_is_not_time(tmp_path: Path, intent: str | int, version: int) -> None:
    """FSL's warps (2006) and others of an intent that is a vector have their components along the fourth axis."""
    values = np.random.default_rng(1).normal(size=(4, 5, 6, 3)).astype("f4")
    image = (nib.Nifti1Image if version == 1 else nib.Nifti2Image)(values, np.eye(4))
    image.header.set_intent(intent, allow_unknown=True)
    nib.save(image, tmp_path / "v.nii")
    refused(UsageError, "3 components", read_volume, str(tmp_path / "v.nii"))
    norm = read_volume(str(tmp_path / "v.nii"), ReadOptions(component="magnitude"))
    np.testing.assert_allclose(norm.data, np.linalg.norm(values, axis=3).T, rtol=1e-6)
    np.testing.assert_array_equal(read_volume(str(tmp_path / "v.nii"), ReadOptions(component=2)).data, values[..., 2].T)
    refused(UsageError, "1 time step", read_volume, str(tmp_path / "v.nii"), ReadOptions(time=1))


@pytest.mark.parametrize(("code", "labels"), [("i2", True), ("f4", False)])
def test_labels_by_their_intent(tmp_path: Path, code: str, labels: bool) -> None:
    image = nib.Nifti1Image(np.arange(60).reshape(3, 4, 5).astype(code) % 3, np.eye(4))
    image.header.set_intent("label")
    nib.save(image, tmp_path / "v.nii")
    assert recognised(read_volume(str(tmp_path / "v.nii"))) == labels


def test_pair(tmp_path: Path) -> None:
    nib.Nifti1Pair(VALUES.astype("i2"), np.eye(4)).to_filename(tmp_path / "v.img")
    np.testing.assert_array_equal(data_values(read_volume(str(tmp_path / "v.hdr"))), VALUES)
    (tmp_path / "v.img").unlink()
    refused(DataError, r"without its .img file", read_volume, str(tmp_path / "v.hdr"))


def test_content_beats_name(tmp_path: Path) -> None:
    source = save(tmp_path / "v.nii", VALUES.astype("u1"))
    wrong = tmp_path / "v.tif"
    wrong.write_bytes(Path(source).read_bytes())
    np.testing.assert_array_equal(data_values(read_volume(str(wrong))), VALUES)


@pytest.mark.parametrize(
    ("at", "values", "message"),
    [
        (40, np.array([3, 32767, 32767, 32767], "<i2"), "the file has"),
        (40, np.array([9], "<i2"), "1 to 7 axes"),
        (40, np.array([3, 0, 4, 5], "<i2"), "at least 1 voxel"),
        (70, np.array([128], "<i2"), "need 532 bytes"),
        (70, np.array([32], "<i2"), "complex64"),
        (108, np.array([np.nan], "<f4"), "vox_offset"),
        (108, np.array([1e9], "<f4"), "the file has"),
        (112, np.array([np.inf], "<f4"), "scl_slope inf"),
    ],
)
def test_lies(tmp_path: Path, at: int, values: np.ndarray, message: str) -> None:
    source = save(tmp_path / "v.nii", VALUES.astype("u1"))
    patch(source, at, values)
    refused(DataError, message, read_volume, source)
