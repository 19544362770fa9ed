"""How stored values become data values, in NetCDF, HDF5 and Zarr, as netCDF4 and xarray decode them."""

import itertools
import shutil
from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest
import xarray

from vvgt_cli.volume import ReadOptions, read_volume

MARKS = (-1, -7, -3, -6, 0, 5, 50, 51, 100, 101, 120, -100)  # what attributes call missing, or a limit


def decoded(path: Path, **how) -> np.ndarray:
    volume = read_volume(str(path), ReadOptions(**how))
    return volume.data[:].astype(float) * volume.slope + volume.intercept


@pytest.mark.parametrize("unsigned", [None, "true"])
@pytest.mark.parametrize("kind", ["i1", "i2", "i4"])
def test_packed_integers_as_netcdf4_masks_them(tmp_path: Path, kind: str, unsigned: str | None) -> None:
    dtype = np.dtype(kind)
    stored = np.resize(MARKS, (3, 4, 5)).astype(dtype)
    choices = ((-1, 100), (None, -3), (None, (0, -6), (5, 50)), ({}, {"scale_factor": -0.5, "add_offset": 10.0}))
    for k, (fill, missing, limits, scaling) in enumerate(itertools.product(*choices)):
        if limits == (0, -6) and unsigned is None:
            continue
        path, as_hdf5 = tmp_path / f"{k}.nc", tmp_path / f"{k}.h5"
        with netCDF4.Dataset(path, "w") as file:
            for name, size in zip("zyx", stored.shape, strict=True):
                file.createDimension(name, size)
            packed = file.createVariable("v", kind, tuple("zyx"), fill_value=dtype.type(fill))
            packed.setncatts(scaling | ({"_Unsigned": unsigned} if unsigned else {}))
            packed.setncatts({"missing_value": dtype.type(missing)} if missing else {})
            packed.setncatts({"valid_range": np.array(limits, dtype)} if limits else {})
            packed.set_auto_maskandscale(False)
            packed[:] = stored
        with netCDF4.Dataset(path) as file:
            expected = np.ma.filled(file["v"][:].astype(float), np.nan)
        shutil.copy(path, as_hdf5)
        with h5py.File(as_hdf5, "a") as file:
            del file.attrs["_NCProperties"]
        for source, blocks in ((path, False), (path, True), (as_hdf5, False)):
            np.testing.assert_allclose(decoded(source, stored=blocks), expected, rtol=1e-6, err_msg=str((k, source)))


@pytest.mark.parametrize(
    ("limits", "kept"),
    [
        (np.array([0.0, 2.0]), [0, 1, 2, 3, 4]),  # of the type of the scaling: data values
        (np.array([0.0, 0.9], "f4"), [0, 1]),  # fractions
        (np.array([0.0, 2.0], "f4"), [0, 1, 2]),
        (np.array([0, 2], "i2"), [0, 1, 2]),
    ],
)
def test_limits_of_packed_values_count_in_the_values_of_their_type(tmp_path: Path, limits, kept: list) -> None:
    with h5py.File(tmp_path / "v.h5", "w") as file:
        file["v"] = np.resize(np.arange(6, dtype="i2"), (2, 3, 4))
        file["v"].attrs["scale_factor"], file["v"].attrs["valid_range"] = 0.5, limits
    found = decoded(tmp_path / "v.h5")
    assert np.unique(found[np.isfinite(found)] / 0.5).tolist() == kept


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("how", [{"dtype": "i2", "scale_factor": 0.1, "add_offset": 5.0}, {"dtype": "f4"}])
def test_zarr_marks_missing_values_as_xarray_does(tmp_path: Path, version: int, how: dict) -> None:
    values = np.arange(60.0).reshape(3, 4, 5)
    values[0, 0, :2] = np.nan
    data = xarray.Dataset({"v": (tuple("zyx"), values)}, {"x": 0.5 * np.arange(5), "y": np.arange(4) + 1.0})
    packed = {"v": how | {"_FillValue": -999}, "x": {"dtype": "i2", "scale_factor": 0.25, "add_offset": 1.0}}
    data.to_zarr(tmp_path / "v.zarr", zarr_format=version, consolidated=False, encoding=packed)
    expected = xarray.open_zarr(tmp_path / "v.zarr", consolidated=False)["v"]
    for blocks in (False, True):
        volume = read_volume(str(tmp_path / "v.zarr"), ReadOptions(stored=blocks))
        assert (volume.spacing, volume.origin) == ((0.5, 1, 1), (0, 1, 0))
        np.testing.assert_allclose(decoded(tmp_path / "v.zarr", stored=blocks), expected, rtol=1e-5)


@pytest.mark.parametrize("prefix", ["", "counts_"])
def test_fields_of_nexus_are_scaled(tmp_path: Path, prefix: str) -> None:
    with h5py.File(tmp_path / "v.nxs", "w") as file:
        group = file.create_group("entry/data")
        group.attrs.update({"NX_class": "NXdata", "signal": "counts", "axes": ["z", "y", "x"]})
        group["counts"] = np.resize(np.arange(50, dtype="u2"), (3, 4, 5))
        group[f"{prefix}scaling_factor"], group[f"{prefix}offset"] = 0.5, -10.0
        for name, size in zip("zyx", (3, 4, 5), strict=True):
            group[name] = np.arange(size) * 2.0
        stored = group["counts"][()].astype(float)
    np.testing.assert_allclose(decoded(tmp_path / "v.nxs"), (stored - 10) * 0.5)


def test_geometry_of_dream3d_and_of_groups(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "v.dream3d", "w") as file:
        file["DataContainers/Image/CellData/Phase"] = np.zeros((3, 4, 5, 1), "f4")
        geometry = file.create_group("DataContainers/Image/_SIMPL_GEOMETRY")
        geometry["SPACING"], geometry["ORIGIN"] = np.array([0.25, 0.5, 2.0]), np.array([1.0, 2.0, 3.0])
    volume = read_volume(str(tmp_path / "v.dream3d"))
    assert (volume.spacing, volume.origin) == ((0.25, 0.5, 2), (1.125, 2.25, 4))
    with h5py.File(tmp_path / "v.h5", "w") as file:
        file["a/b"] = np.zeros((3, 4, 5))
        file["a"].attrs["voxel_size"] = [1.0, 2, 3]
    with pytest.warns(UserWarning, match="attributes voxel_size are not read; --spacing X Y Z sets it"):
        read_volume(str(tmp_path / "v.h5"))
