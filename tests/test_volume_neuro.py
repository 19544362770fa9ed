"""MGH, Analyze and MINC against nibabel and the files of MINC's own tools that it brings; sequences of 3D Slicer."""

import re
import sys
from pathlib import Path

import h5py
import netCDF4
import nibabel as nib
import numpy as np
import pytest
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkIOMINC import vtkMINCImageWriter

from tests.refused import refused
from vvgt_cli.errors import DataError, SeveralSteps, UsageError
from vvgt_cli.volume import ReadOptions, Volume, read_volume
from vvgt_cli.volume.stored import Stored, read_block

VALUES = np.random.default_rng(2).integers(0, 100, (5, 4, 3))  # nibabel's axes: x, y, z
OBLIQUE = nib.affines.from_matvec(
    nib.eulerangles.euler2mat(0.3, -0.2, 0.5) @ [[-2, 0, 0], [0, 0, 1.5], [0, -0.7, 0]], [10.5, -20.25, 30]
)
MINC = Path(nib.__file__).parent / "tests" / "data"


def xyz(volume: Volume) -> np.ndarray:
    """Data values in nibabel's axes."""
    return (np.asarray(volume.data[:]) * volume.slope + volume.intercept).transpose(2, 1, 0)


@pytest.mark.parametrize("code", ["u1", "i2", "i4", "f4"])
@pytest.mark.parametrize("suffix", [".mgh", ".mgz"])
def test_mgh_as_nibabel_writes_it(tmp_path: Path, code: str, suffix: str) -> None:
    source = str(tmp_path / f"v{suffix}")
    nib.save(nib.MGHImage(VALUES.astype(code), OBLIQUE), source)
    volume = read_volume(source)
    np.testing.assert_array_equal(xyz(volume), VALUES)
    np.testing.assert_allclose(volume.affine, OBLIQUE, atol=1e-4)
    assert (volume.space, isinstance(volume.data, np.memmap)) == ("RAS", suffix == ".mgh")


def test_mgh_without_good_ras_is_coronal(tmp_path: Path) -> None:
    path = tmp_path / "v.mgh"
    nib.save(nib.MGHImage(VALUES.astype("f4"), OBLIQUE), str(path))
    content = bytearray(path.read_bytes())
    content[28:30] = bytes(2)
    path.write_bytes(content)
    expected = [[-1, 0, 0, 2.5], [0, 0, 1, -1.5], [0, -1, 0, 2]]  # FreeSurfer's own; nibabel has the transpose
    np.testing.assert_allclose(read_volume(str(path)).affine[:3], expected)


@pytest.mark.parametrize("suffix", [".mgh", ".mgz"])
def test_mgh_frames_are_a_series(tmp_path: Path, suffix: str) -> None:
    source = str(tmp_path / f"v{suffix}")
    nib.save(nib.MGHImage(np.stack([VALUES, 2 * VALUES], 3).astype("f4"), np.eye(4)), source)
    with pytest.raises(SeveralSteps) as found:
        read_volume(source)
    assert found.value.steps == 2
    np.testing.assert_array_equal(xyz(read_volume(source, ReadOptions(time=1))), 2 * VALUES)


FREESURFER = (
    "#No. Label Name: R G B A\n0 Unknown 0 0 0 0\n17 Left-Hippocampus 220 216 20 0\n53 Right-Hippocampus 220 216 20 0\n"
)


def test_aseg_is_shown_by_the_table_of_freesurfer(tmp_path: Path, vvgt) -> None:
    labels = np.zeros((12, 12, 12), np.int32)
    labels[2:5, 3:9, 3:9], labels[7:10, 3:9, 3:9] = 17, 53
    nib.save(nib.MGHImage(labels, OBLIQUE), str(tmp_path / "aseg.mgz"))
    (tmp_path / "FreeSurferColorLUT.txt").write_text(FREESURFER)
    assert "label_map" in vvgt.ok("info", tmp_path / "aseg.mgz").out.decode()
    source = ("init", tmp_path / "aseg.mgz", "--labels", tmp_path / "FreeSurferColorLUT.txt", "--max-gaussians", 300)
    for name, blocks in (("whole", ()), ("blocks", ("--blocks", 32))):
        vvgt.ok(*source, "-o", tmp_path / f"{name}.ply", *blocks)
    assert (tmp_path / "whole.ply").read_bytes().count(b"\n") > 10
    vvgt.ok("info", tmp_path / "blocks.ply")


KINDS = {"analyze": nib.AnalyzeImage, "spm99": nib.Spm99AnalyzeImage, "spm2": nib.Spm2AnalyzeImage}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("order", ["<", ">"])
def test_analyze_as_nibabel_writes_it(tmp_path: Path, kind: str, order: str) -> None:
    """Sizes, values, SPM's scaling and origin; axes are as stored, which is what nibabel turns about x."""
    maker = KINDS[kind]
    header = maker.header_class(endianness=order)
    header.set_data_dtype(np.dtype(order + "i2"))
    header.set_data_shape(VALUES.shape)
    header.set_zooms((2, 3, 4))
    if kind != "analyze":
        header["origin"][:3] = (2, 3, 1)
    scale = 1.0 if kind == "analyze" else 0.5
    image = maker((VALUES * scale).astype("i2" if kind == "analyze" else "f4"), None, header)
    if kind != "analyze":
        image.header.set_slope_inter(scale, 0)
    image.to_filename(tmp_path / "v.img")
    for name in ("v.hdr", "v.img"):
        with pytest.warns(UserWarning, match="does not say which side is left"):
            volume = read_volume(str(tmp_path / name))
        np.testing.assert_allclose(xyz(volume), nib.load(tmp_path / "v.img").get_fdata(), rtol=1e-6)
        assert volume.space is None
        assert volume.spacing == (2, 3, 4)
        expected = (0, 0, 0) if kind == "analyze" else (-2, -6, 0)
        np.testing.assert_allclose(volume.origin, expected)


def test_analyze_says_so_on_one_line(tmp_path: Path, vvgt) -> None:
    nib.AnalyzeImage(VALUES.astype("i2"), None).to_filename(tmp_path / "v.img")
    with pytest.warns(UserWarning, match="^v.hdr: Analyze does not say which side is left; .*$") as said:
        vvgt.ok("info", tmp_path / "v.hdr")
    assert len(said) == 1
    (tmp_path / "v.hdr").unlink()
    assert "without its .hdr" in vvgt("info", tmp_path / "v.img").error


def test_the_img_of_a_nifti_pair(tmp_path: Path) -> None:
    nib.Nifti1Pair(VALUES.astype("i2"), OBLIQUE).to_filename(tmp_path / "v.img")
    volume = read_volume(str(tmp_path / "v.img"), ReadOptions(crop="1:3,:,:"))
    np.testing.assert_array_equal(xyz(volume), VALUES[1:3])
    assert volume.space == "RAS"


@pytest.mark.parametrize(
    ("name", "least", "most", "mean"),  # as mincstats has them
    [
        ("tiny.mnc", 0.20784314, 0.74901961, 0.60602819),
        ("small.mnc", 0.1185331417, 92.87690699, 31.2127952),
        ("minc1_1_scale.mnc", 0.2082842439, 0.2094327615, 0.2091292083),
        ("minc2_1_scale.mnc", 0.2082842439, 0.2094327615, 0.2091292083),
    ],
)
def test_minc(name: str, least: float, most: float, mean: float) -> None:
    volume = read_volume(str(MINC / name))
    found = [float(f(volume.data.astype("f8"))) for f in (np.min, np.max, np.mean)]
    np.testing.assert_allclose(found, (least, most, mean), rtol=1e-6)
    image = nib.load(MINC / name)
    corner = [volume.affine @ [i, j, k, 1] for k, j, i in ((0, 0, 0), (3, 5, 7))]
    np.testing.assert_allclose(corner, [image.affine @ [k, j, i, 1] for k, j, i in ((0, 0, 0), (3, 5, 7))], atol=1e-4)
    assert (volume.space, volume.data.dtype) == ("RAS", np.float32)
    lazy = read_volume(str(MINC / name), ReadOptions(stored=True))
    assert isinstance(lazy.data, Stored)
    part = read_block(lazy, np.array([3, 2, 1]), np.array([9, 8, 7]))
    np.testing.assert_array_equal(part, volume.data[1:7, 2:8, 3:9])


@pytest.mark.parametrize("name", ["minc1_4d.mnc", "minc2_4d.mnc"])
def test_minc_over_time(name: str) -> None:
    with pytest.raises(SeveralSteps) as found:
        read_volume(str(MINC / name))
    assert found.value.steps == 2
    volume = read_volume(str(MINC / name), ReadOptions(time=1))
    np.testing.assert_allclose(volume.data, nib.load(MINC / name).get_fdata()[1], rtol=1e-6)
    refused(UsageError, "0 to 1", read_volume, str(MINC / name), ReadOptions(time=2))


@pytest.mark.parametrize("axes", ["vzyx", "zyxv", "tzyxv", "vtzyx"])
@pytest.mark.parametrize("version", [1, 2])
def test_minc_vectors_are_components(tmp_path: Path, axes: str, version: int) -> None:
    """A deformation grid of minctracc: x, y and z of a displacement along vector_dimension, which is first or last."""
    sizes = {"v": 3, "t": 2, "z": 6, "y": 5, "x": 4}
    names = {"v": "vector_dimension", "t": "time"} | {a: f"{a}space" for a in "xyz"}
    values = np.random.default_rng(0).integers(-99, 99, [sizes[a] for a in axes]).astype("i2")
    path, dimensions = tmp_path / "grid_0.mnc", ",".join(names[a] for a in axes)
    if version == 1:
        with netCDF4.Dataset(path, "w", format="NETCDF3_CLASSIC") as file:
            for a in axes:
                file.createDimension(names[a], sizes[a])
                file.createVariable(names[a], "i4", ()).varid = "MINC standard variable"
            image = file.createVariable("image", "i2", dimensions.split(","))
            image.signtype, image.valid_range = "signed__", np.array([-100, 100], "i2")
            image[:] = values
            for name, end in (("image-min", -10), ("image-max", 10)):
                file.createVariable(name, "f8", ())[...] = end
    else:
        with h5py.File(path, "w") as file:
            group = file.create_group("minc-2.0/image/0")
            file.create_group("minc-2.0/dimensions")
            group["image"] = values
            group["image"].attrs["dimorder"], group["image"].attrs["valid_range"] = dimensions, [-100.0, 100.0]
            group["image-min"], group["image-max"] = -10.0, 10.0
    time, order = (1 if "t" in axes else None), [axes.index(a) for a in "tvzyx" if a in axes]
    expected = (values.transpose(order)[time or 0] if "t" in axes else values.transpose(order)) / 10
    refused(UsageError, "each voxel has 3 components", read_volume, str(path), ReadOptions(time=time))
    for stored in (False, True):
        for k in range(3):
            part = read_volume(str(path), ReadOptions(component=k, time=time, stored=stored))
            np.testing.assert_allclose(part.data[:], expected[k], rtol=1e-6)
        norm = read_volume(str(path), ReadOptions(component="magnitude", time=time, stored=stored))
        np.testing.assert_allclose(norm.data[:], np.linalg.norm(expected, axis=0), rtol=1e-6)


def sequence(kinds: str = "list domain domain domain") -> bytes:
    """A sequence as 3D Slicer writes it: three frames, the values of a voxel one behind the other."""
    text = (
        "NRRD0005\n# Complete NRRD file format specification at:\ntype: short\ndimension: 4\n"
        "space: left-posterior-superior\nsizes: 3 5 4 3\n"
        "space directions: none (2,0,0) (0,3,0) (0,0,4)\n"
        f'kinds: {kinds}\nlabels: "frame" "" "" ""\nendian: little\nencoding: raw\nspace origin: (1,2,3)\n'
        "axis 0 index type:=numeric\naxis 0 index values:=0 1 2\n\n"
    )
    frames = np.stack([VALUES + 1000 * t for t in range(3)], axis=-1).transpose(2, 1, 0, 3)
    return text.encode() + frames.astype("<i2").tobytes()


def test_slicers_sequence_is_a_series(tmp_path: Path) -> None:
    source = tmp_path / "v.seq.nrrd"
    source.write_bytes(sequence())
    with pytest.raises(SeveralSteps) as found:
        read_volume(str(source))
    assert found.value.steps == 3
    for how in (ReadOptions(time=2), ReadOptions(component=2)):
        volume = read_volume(str(source), how)
        np.testing.assert_array_equal(xyz(volume), VALUES + 2000)
        np.testing.assert_allclose(volume.affine[:3, 3], (-1, -2, 3))
    refused(UsageError, "0 to 2", read_volume, str(source), ReadOptions(time=3))


def test_other_lists_are_components(tmp_path: Path) -> None:
    (tmp_path / "v.nrrd").write_bytes(sequence())
    refused(UsageError, "3 components", read_volume, str(tmp_path / "v.nrrd"))
    refused(UsageError, "no axis of time", read_volume, str(tmp_path / "v.nrrd"), ReadOptions(component=1, time=1))
    (tmp_path / "v.nrrd").write_bytes(sequence("time domain domain domain"))
    np.testing.assert_array_equal(xyz(read_volume(str(tmp_path / "v.nrrd"), ReadOptions(time=1))), VALUES + 1000)
    unsaid = re.sub(rb"(space|kinds|labels)[^\n]*\n", b"", sequence())  # as many values as slices: the first axis
    (tmp_path / "v.nrrd").write_bytes(unsaid)
    np.testing.assert_array_equal(xyz(read_volume(str(tmp_path / "v.nrrd"), ReadOptions(component=1))), VALUES + 1000)


def test_minc_2_without_h5py_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    refused(DataError, r"needs h5py .*pip install 'h5py>=[\d.]+'$", read_volume, str(MINC / "minc2_1_scale.mnc"))


@pytest.mark.parametrize("code", ["u1", "i2", "f4"])
def test_minc_1_as_vtk_writes_it(tmp_path: Path, code: str) -> None:
    """Without the names by which nibabel knows MINC, nor ends of slices: values as they are stored."""
    values = np.ascontiguousarray(VALUES.transpose(2, 1, 0)).astype(code)
    image, array = vtkImageData(), numpy_to_vtk(values.ravel())
    image.SetDimensions(5, 4, 3)
    image.SetSpacing(0.5, 1.5, 2)
    image.SetOrigin(1, -2, 3)
    image.GetPointData().SetScalars(array)
    writer = vtkMINCImageWriter()
    writer.SetInputData(image)
    writer.SetFileName(str(tmp_path / "v.mnc"))
    writer.Write()
    volume = read_volume(str(tmp_path / "v.mnc"))
    np.testing.assert_array_equal(volume.data, values)
    np.testing.assert_allclose(volume.affine, [[0.5, 0, 0, 1], [0, 1.5, 0, -2], [0, 0, 2, 3], [0, 0, 0, 1]])
    assert volume.space == "RAS"


@pytest.mark.parametrize(("unit", "scale", "said"), [(b"um", 1e-3, 0), (b"cm", 10.0, 0), (b"px", 1.0, 1)])
def test_minc_lengths_are_in_its_units(
    tmp_path: Path, recwarn: pytest.WarningsRecorder, unit: bytes, scale: float, said: int
) -> None:
    netcdf = pytest.importorskip("netCDF4")
    with netcdf.Dataset(tmp_path / "v.mnc", "w", format="NETCDF3_CLASSIC") as file:
        for axis, n in (("zspace", 3), ("yspace", 4), ("xspace", 5)):
            file.createDimension(axis, n)
            file.createVariable(axis, "i4", ()).setncatts(
                {"varid": "MINC standard variable", "units": unit.decode(), "step": -2.0, "start": 7.0}
            )
        file.createVariable("image", "f4", ("zspace", "yspace", "xspace"))[:] = VALUES.transpose(2, 1, 0)
    affine = read_volume(str(tmp_path / "v.mnc")).affine
    np.testing.assert_allclose(affine[:3], scale * np.array([[-2, 0, 0, 7], [0, -2, 0, 7], [0, 0, -2, 7]]))
    assert sum("'px' is not a known unit" in str(w.message) for w in recwarn) == said


def test_minc_1_without_steps(tmp_path: Path) -> None:
    (tmp_path / "v.mnc").write_bytes((MINC / "minc1_1_scale.mnc").read_bytes().replace(b"step", b"stop"))
    assert read_volume(str(tmp_path / "v.mnc")).spacing == pytest.approx((1, 1, 1))


@pytest.mark.parametrize(("old", "new", "message"), [
    (b"regular__", b"irregular", "irregular steps"),
    (b"zspace", b"qspace", "expected three in space"),
])  # fmt: skip
def test_minc_1_that_is_no_regular_volume(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    (tmp_path / "v.mnc").write_bytes((MINC / "minc1_1_scale.mnc").read_bytes().replace(old, new))
    refused(DataError, message, read_volume, str(tmp_path / "v.mnc"))
