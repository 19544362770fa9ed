"""NRRD and MetaImage files of SimpleITK and VTK, as VTK's own readers and SimpleITK have them."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkIOImage import vtkMetaImageReader, vtkMetaImageWriter, vtkNrrdReader

from tests import anatomy
from vvgt_cli.volume import ReadOptions, read_volume

SUFFIXES = (".nrrd", ".nhdr", ".mha", ".mhd")
TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")


def vtk_image(path: Path) -> vtkImageData:
    reader = vtkNrrdReader() if path.suffix in (".nrrd", ".nhdr") else vtkMetaImageReader()
    assert reader.CanReadFile(str(path))
    reader.SetFileName(str(path))
    reader.Update()
    return reader.GetOutput()


def vtk_values(image: vtkImageData) -> np.ndarray:
    return vtk_to_numpy(image.GetPointData().GetScalars()).reshape(image.GetDimensions()[::-1])


def values_of(kind: str) -> np.ndarray:
    """No two alike, negative ones and large ones among them where the type has such."""
    values = np.arange(np.prod(anatomy.DIMS)).reshape(anatomy.DIMS[::-1])
    info = np.iinfo(kind) if np.dtype(kind).kind in "iu" else np.finfo(np.float32)
    if np.dtype(kind).itemsize == 1:
        return (values % 251 + int(info.min)).astype(kind)
    return (values * (float(info.max) / values.size / 2) + (float(info.min) / 3)).astype(kind)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("kind", TYPES)
def test_values_spacing_and_origin_of_what_simpleitk_writes(tmp_path, kind, suffix, compressed) -> None:
    path, values = tmp_path / f"v{suffix}", values_of(kind)
    image = sitk.GetImageFromArray(values)
    image.SetSpacing((0.5, 1.25, 3.0))
    image.SetOrigin((-7.0, 11.5, 13.0))
    sitk.WriteImage(image, str(path), useCompression=compressed)
    theirs, ours = vtk_image(path), read_volume(str(path), ReadOptions(space="LPS"))
    assert ours.data.dtype == values.dtype
    np.testing.assert_array_equal(ours.data, vtk_values(theirs))
    np.testing.assert_array_equal(ours.data, values)
    np.testing.assert_allclose(ours.spacing, theirs.GetSpacing(), rtol=1e-12)
    np.testing.assert_allclose(ours.origin, theirs.GetOrigin(), rtol=1e-12)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("suffix", [".mha", ".mhd"])
@pytest.mark.parametrize("kind", ["uint8", "int16", "float32", "float64"])
def test_what_vtk_writes(tmp_path: Path, kind: str, suffix: str, compressed: bool) -> None:
    path, values = tmp_path / f"v{suffix}", values_of(kind)
    image = vtkImageData()
    image.SetDimensions(*anatomy.DIMS)
    image.SetSpacing(0.5, 1.25, 3.0)
    image.SetOrigin(-7.0, 11.5, 13.0)
    image.GetPointData().SetScalars(numpy_to_vtk(values.ravel(), deep=True))
    writer = vtkMetaImageWriter()
    writer.SetFileName(str(path))
    writer.SetCompression(compressed)
    writer.SetInputData(image)
    writer.Write()
    theirs, ours = vtk_image(path), read_volume(str(path))
    assert isinstance(ours.data, np.memmap) != compressed
    np.testing.assert_array_equal(ours.data, values)
    np.testing.assert_array_equal(ours.data, vtk_values(theirs))
    np.testing.assert_allclose(ours.spacing, theirs.GetSpacing(), rtol=1e-12)
    with_sitk = sitk.ReadImage(str(path))
    expected = ReadOptions(space="LPS") if ours.space else ReadOptions()
    np.testing.assert_allclose(read_volume(str(path), expected).origin, with_sitk.GetOrigin(), rtol=1e-12)


@pytest.mark.parametrize("suffix", [".nrrd", ".mha"])
def test_components_of_what_simpleitk_writes(tmp_path: Path, suffix: str) -> None:
    values = np.random.default_rng(3).normal(size=(4, 5, 6, 3)).astype(np.float32)
    path = tmp_path / f"v{suffix}"
    sitk.WriteImage(sitk.GetImageFromArray(values, isVector=True), str(path))
    for component in range(3):
        ours = read_volume(str(path), ReadOptions(component=component))
        np.testing.assert_array_equal(ours.data, values[..., component])
        if suffix == ".mha":  # VTK 9.7 takes the second axis of such a NRRD file for x
            theirs = vtk_to_numpy(vtk_image(path).GetPointData().GetScalars()).reshape(values.shape)
            np.testing.assert_array_equal(ours.data, theirs[..., component])


@pytest.mark.parametrize("components", [1, 3])
def test_hdf5_of_itk_lies_where_its_metaimage_does(tmp_path: Path, components: int) -> None:
    values = np.random.default_rng(0).random((2, 3, 4, components))
    image = sitk.GetImageFromArray(values if components > 1 else values[..., 0], isVector=components > 1)
    image.SetSpacing((0.5, 0.6, 2.0))
    image.SetOrigin((1.0, 2.0, 3.0))
    image.SetDirection((0.36, 0.48, -0.8, -0.8, 0.6, 0.0, 0.48, 0.64, 0.6))
    how = ReadOptions(component=components - 1) if components > 1 else ReadOptions()
    for name in ("v.h5", "v.mha"):
        sitk.WriteImage(image, str(tmp_path / name))
    ours, theirs = (read_volume(str(tmp_path / name), how) for name in ("v.h5", "v.mha"))
    np.testing.assert_array_equal(ours.data, values[..., -1])
    np.testing.assert_allclose(ours.affine, theirs.affine, atol=1e-12)
    assert ours.space == theirs.space == "RAS"
