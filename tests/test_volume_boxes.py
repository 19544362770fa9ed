"""Compressed `.vti` and NetCDF box by box: what they are in memory; classic NetCDF's variables in their file."""

from pathlib import Path

import netCDF4
import numpy as np
import pytest
from test_volume_labelled import AXES, VALUES, write_netcdf
from test_volume_vtk import RNG, image, write_vti
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonDataModel import vtkImageData

from tests.ramps import X, Y, Z
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.arrays.netcdf import check_header
from vvgt_cli.volume.stored import Stored, read_block


@pytest.mark.parametrize("compressor", ["ZLib", "LZ4", "LZMA"])
@pytest.mark.parametrize("mode", ["appended-raw", "appended-base64"])
@pytest.mark.parametrize("big", [False, True])
def test_packed_vti_box_by_box(tmp_path: Path, compressor: str, mode: str, big: bool) -> None:
    """Many blocks, whose ends lie within rows; of vectors a component."""
    values = RNG.integers(0, 9, (40, 39, 41))
    data = vtkImageData()
    data.SetDimensions(41, 39, 40)
    for name, field in (("vectors", np.repeat(values[..., None], 3, 3) + np.array([0, 10, 20])), ("b", values)):
        array = numpy_to_vtk(field.astype("f4").reshape(values.size, -1), deep=True)
        array.SetName(name)
        data.GetPointData().AddArray(array)
    path = write_vti(tmp_path / "v.vti", data, mode, compressor, big)
    for options, expected in (({"array": "b"}, values), ({"array": "vectors", "component": 1}, values + 10)):
        lazy = read_volume(path, ReadOptions(stored=True, **options))
        assert isinstance(lazy.data, Stored)
        assert lazy.data.dtype == np.dtype("f4")
        np.testing.assert_array_equal(lazy.data[:], expected)
        part = read_block(lazy, np.array([1, 2, 3]), np.array([40, 3, 38]))
        np.testing.assert_array_equal(part, expected[3:38, 2:3, 1:40])
    with pytest.raises(UsageError, match="3 components"):
        read_volume(path, ReadOptions(stored=True, array="vectors"))
    magnitude = read_volume(path, ReadOptions(stored=True, array="vectors", component="magnitude"))
    assert isinstance(magnitude.data, Stored)
    np.testing.assert_allclose(
        magnitude.data[:], np.sqrt(values**2 + (values + 10) ** 2 + (values + 20) ** 2), rtol=1e-6
    )


@pytest.mark.parametrize(("old", "new"), [(b"vtkZLib", b"vtkLZMA"), (b'"0 4 0 3 0 2"', b'"0 4 0 3 0 1"'), (b"x", b"y")])
def test_packed_vti_that_lies_in_blocks(tmp_path: Path, old: bytes, new: bytes) -> None:
    path = Path(write_vti(tmp_path / "v.vti", image(a=RNG.integers(0, 100, (3, 4, 5)).astype("i2")), compressor="ZLib"))
    data = path.read_bytes()
    if old == b"x":  # within the packed values
        data = data[:-60] + bytes(byte ^ 0x55 for byte in data[-60:-40]) + data[-40:]
    path.write_bytes(data.replace(old, new) if old != b"x" else data)
    with pytest.raises(DataError, match=r"damaged|no table of"):
        read_volume(str(path), ReadOptions(stored=True)).data[:]


@pytest.mark.parametrize("form", ["NETCDF4", "NETCDF3_CLASSIC"])
@pytest.mark.parametrize("array", ["plain", "inner/packed"])
def test_netcdf_in_blocks_is_what_it_is_in_memory(tmp_path: Path, form: str, array: str) -> None:
    """In any order of axes, descending, chunked or not, scaled, in a group, over time."""
    if form != "NETCDF4" and "/" in array:
        pytest.skip("groups are of NetCDF 4")
    path = str(tmp_path / "v.nc")
    with netCDF4.Dataset(path, "w", format=form) as file:
        for name, centres in {"x": X, "y": Y[::-1], "z": Z, "time": np.arange(2.0)}.items():
            file.createDimension(name, len(centres))
            file.createVariable(name, "f8", (name,))[:] = centres
        file["time"].units = "days since 2020-01-01"
        values = np.stack([VALUES, -VALUES])[:, :, ::-1].transpose(1, 0, 3, 2)  # z, time, x, y
        file.createVariable("plain", "f4", ("z", "time", "x", "y"))[:] = values
        if form == "NETCDF4":
            how = {"zlib": True, "chunksizes": (2, 1, 3, 2), "fill_value": -32768}
            packed = file.createGroup("inner").createVariable("packed", "i2", ("z", "time", "x", "y"), **how)
            packed.scale_factor, packed.add_offset = 0.5, 5000.0
            values[1, :, 2, 3] = np.nan
            packed[:] = np.ma.array(values, mask=np.isnan(values))
    whole = read_volume(path, ReadOptions(array=array, time=1))
    lazy = read_volume(path, ReadOptions(array=array, time=1, stored=True))
    assert isinstance(lazy.data, Stored)
    assert (lazy.origin, lazy.spacing, lazy.slope, lazy.data.dtype) == (
        whole.origin, whole.spacing, whole.slope, whole.data.dtype
    )  # fmt: skip
    np.testing.assert_array_equal(read_block(lazy, np.array([1, 0, 1]), np.array([4, 3, 3])), whole.data[1:3, :3, 1:4])
    if array == "plain":
        assert lazy.data.chunks == ((1, 4, 5) if form != "NETCDF4" else lazy.data.chunks)
        np.testing.assert_allclose(whole.data, -VALUES, rtol=1e-6)
    else:
        assert lazy.data.chunks == (2, 2, 3)


def test_netcdf_in_blocks_may_still_be_resampled(tmp_path: Path) -> None:
    path = write_netcdf(tmp_path / "v.nc", axes=AXES | {"z": np.array([10.0, 11.0, 14.0])})
    assert read_volume(path, ReadOptions(dims=(4, 4, 4), stored=True)).dims == (4, 4, 4)


@pytest.mark.parametrize("form", ["NETCDF3_CLASSIC", "NETCDF3_64BIT_OFFSET", "NETCDF3_64BIT_DATA"])
@pytest.mark.parametrize("others", [0, 2])
def test_netcdf_classic_variables_are_where_the_library_has_them(tmp_path: Path, form: str, others: int) -> None:
    """Of fixed length, and records: alone they are not padded, with others they take turns."""
    with netCDF4.Dataset(tmp_path / "v.nc", "w", format=form) as file:
        for name, size in (("time", None), ("y", 3), ("x", 5)):
            file.createDimension(name, size)
        file.createVariable("fixed", "f8", ("y", "x"))[:] = VALUES[0, :3]
        rows = file.createVariable("rows", "i1", ("time", "y", "x"))
        rows.units, rows.limits = "K", np.array([1.5, 2.5])
        rows[:] = np.arange(60).reshape(4, 3, 5)
        for k in range(others):
            file.createVariable(f"other{k}", "i2", ("time", "x"))[:] = np.arange(20).reshape(4, 5) + k
    found = check_header(tmp_path / "v.nc")
    with netCDF4.Dataset(tmp_path / "v.nc") as file:
        assert set(found) == set(file.variables)
        for name, variable in found.items():
            np.testing.assert_array_equal(variable.mapped(tmp_path / "v.nc"), file[name][:])
            assert variable.dims == file[name].dimensions
    assert found["rows"].attributes["units"] == "K"
    assert found["rows"].attributes["limits"].tolist() == [1.5, 2.5]
