"""Arrays with named axes: HDF5, NetCDF, Zarr and NumPy, written by their own libraries."""

import gc
import itertools
import json
import sys
import threading
from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest
import zarr

from tests.ramps import X, Y, Z, check_grid, check_ramp, ramp
from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.arrays.hdf5 import read_dataset
from vvgt_cli.volume.arrays.netcdf import _TURN, check_header
from vvgt_cli.volume.labelled import even

VALUES = ramp(X, Y, Z)
AXES = {"x": X, "y": Y, "z": Z}


def write_netcdf(path: Path, order: str = "zyx", axes: dict | None = None, units: dict | None = None, **how) -> str:
    """The ramp on axes named after their letters, in the given order."""
    axes = axes or AXES
    with netCDF4.Dataset(path, "w", format=how.pop("format", "NETCDF4")) as file:
        for name, centres in axes.items():
            file.createDimension(name, len(centres))
            variable = file.createVariable(name, "f8", (name,))
            variable[:] = centres
            variable.units = (units or {}).get(name, "m")
        values = np.transpose(ramp(axes["x"], axes["y"], axes["z"]), ["zyx".index(name) for name in order])
        file.createVariable("field", how.pop("dtype", "f4"), tuple(order), **how)[:] = values
    return str(path)


@pytest.mark.parametrize("order", ["".join(order) for order in itertools.permutations("zyx")])
def test_netcdf_axes_in_any_order(tmp_path: Path, order: str) -> None:
    check_grid(read_volume(write_netcdf(tmp_path / "v.nc", order)))


@pytest.mark.parametrize("form", ["NETCDF3_CLASSIC", "NETCDF3_64BIT_OFFSET", "NETCDF3_64BIT_DATA", "NETCDF4_CLASSIC"])
def test_netcdf_versions_by_content(tmp_path: Path, form: str) -> None:
    check_grid(read_volume(write_netcdf(tmp_path / "v.nc", format=form)))


def test_netcdf4_is_hdf5_with_dimension_scales(tmp_path: Path) -> None:
    path = write_netcdf(tmp_path / "v.h5", "xzy")
    with h5py.File(path, "a") as file:
        del file.attrs["_NCProperties"]
    check_grid(read_volume(path))


@pytest.mark.parametrize("name", ["v.nc", "v.h5"])
def test_values_have_the_name_and_unit_of_their_file(tmp_path: Path, name: str) -> None:
    path = write_netcdf(tmp_path / name)
    with netCDF4.Dataset(path, "a") as file:
        file["field"].setncatts({"units": "K", "long_name": "air temperature"})
    volume = read_volume(path)
    assert (volume.quantity, volume.values_in) == ("air temperature", "K")


def test_empty_attributes_of_hdf5_say_nothing(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "v.h5", "w") as file:
        file.create_dataset("field", data=VALUES).attrs.update(
            {"units": h5py.Empty("S1"), "long_name": h5py.Empty("S1")}
        )
    volume = read_volume(str(tmp_path / "v.h5"))
    assert (volume.quantity, volume.values_in) == ("", "")


@pytest.mark.parametrize("how", ["label", "NAME"])
def test_names_of_hdf5_dimensions_order_their_axes(tmp_path: Path, how: str) -> None:
    with h5py.File(tmp_path / "v.h5", "w") as file:
        field = file.create_dataset("field", data=VALUES.T)
        for k, (name, values) in enumerate(AXES.items()):
            file[f"scale_{name}"] = values
            file[f"scale_{name}"].make_scale(name if how == "NAME" else "")
            field.dims[k].attach_scale(file[f"scale_{name}"])
            field.dims[k].label = name if how == "label" else ""
    check_grid(read_volume(str(tmp_path / "v.h5")))
    with h5py.File(tmp_path / "v.h5", "a") as file:
        file["z_index"] = np.arange(len(AXES["z"]))
        file["z_index"].make_scale("z_index")
        file["field"].dims[2].attach_scale(file["z_index"])
    with pytest.warns(UserWarning, match="/field: coordinates are those of scale_z, not of /z_index"):
        check_grid(read_volume(str(tmp_path / "v.h5")))


def test_netcdf_descending_axes_are_turned(tmp_path: Path) -> None:
    turned = {"x": X[::-1], "y": Y, "z": Z[::-1]}
    check_grid(read_volume(write_netcdf(tmp_path / "v.nc", axes=turned)))


def test_netcdf_units_of_length_become_those_of_x(tmp_path: Path) -> None:
    volume = read_volume(write_netcdf(tmp_path / "v.nc", units={"x": "km", "y": "m", "z": "cm"}))
    np.testing.assert_allclose(volume.spacing, (0.25, 0.5e-3, 2e-5))
    np.testing.assert_allclose(volume.origin, (0.5, -3e-3, 1e-4))


def test_netcdf_units_that_do_not_compare(tmp_path: Path) -> None:
    path = write_netcdf(tmp_path / "v.nc", units={"x": "degrees_east", "y": "degrees_north", "z": "hPa"})
    refused(UsageError, r"axes x in degrees, y in degrees, z in hpa; .*try --spacing X Y Z", read_volume, path)
    assert read_volume(path, ReadOptions(spacing=(1, 2, 3))).spacing == (1, 2, 3)
    same = write_netcdf(tmp_path / "w.nc", units={"x": "degrees_east", "y": "degrees_north", "z": "degree"})
    check_grid(read_volume(same))


def test_netcdf_irregular_axes_are_refused_or_resampled(tmp_path: Path) -> None:
    axes = {"x": X, "y": Y, "z": np.array([10.0, 11.0, 13.0, 20.0])}
    path = write_netcdf(tmp_path / "v.nc", axes=axes)
    refused(UsageError, r"axis z has steps from 1 to 7; .*--dims X Y Z .*--spacing X Y Z", read_volume, path)
    volume = read_volume(path, ReadOptions(dims=(6, 5, 20)))
    assert volume.dims == (6, 5, 20)
    assert (volume.name, volume.unit) == ("v:field (resampled to 6 x 5 x 20)", "m")
    np.testing.assert_allclose(volume.spacing, (1 / 6, 0.3, 0.5))
    check_ramp(volume, atol=2e-3)
    assert np.isfinite(volume.data).all()
    with pytest.raises(UsageError, match="evenly spaced; leave out --dims"):
        read_volume(write_netcdf(tmp_path / "w.nc"), ReadOptions(dims=(6, 5, 20)))
    with pytest.raises(DataError, match="coordinates of axis z neither ascend nor descend"):
        read_volume(write_netcdf(tmp_path / "u.nc", axes=AXES | {"z": np.array([1.0, 3.0, 2.0])}))


def test_netcdf_scaling_and_missing_values(tmp_path: Path) -> None:
    path = tmp_path / "v.nc"
    with netCDF4.Dataset(path, "w") as file:
        for name, size in zip("zyx", VALUES.shape, strict=True):
            file.createDimension(name, size)
        packed = file.createVariable("packed", "i2", ("z", "y", "x"), fill_value=-32768)
        packed.scale_factor, packed.add_offset = 0.5, 5000.0
        packed.set_auto_maskandscale(False)
        stored = np.round((VALUES - 5000) / 0.5).astype("i2")
        packed[:] = stored
        holed = file.createVariable("holed", "i2", ("z", "y", "x"), fill_value=-32768)
        holed.scale_factor, holed.add_offset, holed.valid_max = 0.5, 5000.0, np.int16(stored.max() - 1)
        holed.set_auto_maskandscale(False)
        stored[0, 0, 0] = -32768
        holed[:] = stored
        file.createVariable("unwritten", "f4", ("z", "y", "x"))[1:] = VALUES[1:]
    volume = read_volume(str(path), ReadOptions(array="packed"))
    assert (volume.data.dtype, volume.slope, volume.intercept) == (np.int16, 0.5, 5000)
    np.testing.assert_allclose(volume.data * volume.slope + volume.intercept, VALUES, atol=0.26)
    volume = read_volume(str(path), ReadOptions(array="holed"))
    assert (volume.data.dtype, volume.slope, volume.intercept) == (np.float32, 0.5, 5000)
    assert np.argwhere(np.isnan(volume.data)).tolist() == [[0, 0, 0], [2, 3, 4]]
    np.testing.assert_allclose(volume.data[1] * volume.slope + volume.intercept, VALUES[1], atol=0.26)
    volume = read_volume(str(path), ReadOptions(array="unwritten"))
    assert np.isnan(volume.data[0]).all()
    np.testing.assert_allclose(volume.data[1:], VALUES[1:], rtol=1e-6)
    refused(UsageError, r"several variables: packed \(z, y, x: 3 x 4 x 5\); holed", read_volume, str(path))
    refused(UsageError, "no variable 'none'; it has packed", read_volume, str(path), ReadOptions(array="none"))


@pytest.mark.parametrize("kind", ["i1", "u1"])
def test_netcdf_bytes_have_no_value_for_unwritten(tmp_path: Path, kind: str) -> None:
    """Every byte is a value, of the library's default fill too (-127, 255), unless the file says otherwise."""
    every = np.arange(256, dtype="u1").view(kind).reshape(4, 8, 8)
    with netCDF4.Dataset(tmp_path / "v.nc", "w") as file:
        for name, size in zip("zyx", every.shape, strict=True):
            file.createDimension(name, size)
        file.createVariable("bytes", kind, ("z", "y", "x"))[:] = every
    volume = read_volume(str(tmp_path / "v.nc"))
    assert volume.data.dtype == kind
    assert np.array_equal(volume.data, every)


def test_netcdf_time_steps_are_chosen_by_component(tmp_path: Path) -> None:
    path = tmp_path / "v.nc"
    with netCDF4.Dataset(path, "w") as file:
        for name, centres in (AXES | {"time": np.arange(2.0)}).items():
            file.createDimension(name, len(centres))
            file.createVariable(name, "f8", (name,))[:] = centres
        file["time"].units = "hours since 2020-01-01"
        steps = file.createVariable("field", "f4", ("time", "z", "y", "x"))
        steps[0], steps[1] = VALUES, -VALUES
    check_grid(read_volume(str(path), ReadOptions(component=0)))
    np.testing.assert_allclose(read_volume(str(path), ReadOptions(component=1)).data, -VALUES, rtol=1e-6)
    np.testing.assert_allclose(read_volume(str(path), ReadOptions(time=1)).data, -VALUES, rtol=1e-6)
    refused(UsageError, r"2 time steps; .*--time N", read_volume, str(path))
    refused(UsageError, r"--time 2: expected a time step from 0 to 1", read_volume, str(path), ReadOptions(time=2))
    refused(UsageError, "along time 2 .*not component 2; .* 0 to 1", read_volume, str(path), ReadOptions(component=2))


@pytest.mark.parametrize("how", [{}, {"chunks": (2, 2, 2), "compression": "gzip", "shuffle": True}])
@pytest.mark.parametrize("dtype", ["<f4", ">f8", "i2", "u1"])
def test_hdf5_datasets(tmp_path: Path, how: dict, dtype: str) -> None:
    values = (VALUES / 100).astype(dtype)
    with h5py.File(tmp_path / "v.h5", "w") as file:
        file.create_dataset("deep/field", data=values, **how)
        file["deep/points"] = np.zeros((9, 3))
        file["text"] = "not a number"
    volume = read_volume(str(tmp_path / "v.h5"))
    assert volume.name == "v:deep/field"
    assert volume.data.dtype == values.dtype
    assert isinstance(volume.data, np.memmap) == (not how)
    np.testing.assert_array_equal(volume.data, values)
    again = read_volume(f"{tmp_path / 'v.h5'}:/deep/field", ReadOptions(spacing=(1, 2, 3)))
    np.testing.assert_array_equal(again.data, values)
    assert again.spacing == (1, 2, 3)


def test_hdf5_choices(tmp_path: Path) -> None:
    path = tmp_path / "v.h5"
    with h5py.File(path, "w") as file:
        file["a/one"], file["b/two"] = VALUES, VALUES + 1
    refused(
        UsageError, r"several datasets: /a/one \(3 x 4 x 5 float64\); /b/two .*choose one as", read_volume, str(path)
    )
    refused(UsageError, r"no dataset '/c'; it has /a/one", read_volume, f"{path}:/c")
    refused(UsageError, "choose both", read_volume, f"{path}:/a/one", ReadOptions(array="/a/one"))
    assert read_volume(f"{path}:/b").name == "v:b/two"
    refused(DataError, "no such file", read_volume, f"{tmp_path / 'none.h5'}:/a")


def test_hdf5_stays_in_its_folder(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    with h5py.File(tmp_path / "outside.h5", "w") as file:
        file["field"] = VALUES
    path = tmp_path / "inner" / "v.h5"
    layout = h5py.VirtualLayout((3, 4, 5), "f8")
    layout[:] = h5py.VirtualSource("../outside.h5", "field", (3, 4, 5))
    with h5py.File(path, "w") as file:
        file["link"], file["soft"] = h5py.ExternalLink("../outside.h5", "/field"), h5py.SoftLink("/link")
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("raw", (3, 4, 5), "f8", external=[("../outside.h5", 0, h5py.h5f.UNLIMITED)])
        for name, there in (("far", "far"), ("near", "/virtual"), ("other", "field")):
            file[name] = h5py.ExternalLink("beside.h5", there)
        file["a"], file["b"] = h5py.SoftLink("/b"), h5py.SoftLink("/a")
        nested = h5py.VirtualLayout((3, 4, 5), "f8")
        nested[:] = h5py.VirtualSource("beside.h5", "virtual", (3, 4, 5))
        file.create_virtual_dataset("nested", nested)
    with h5py.File(path.with_name("beside.h5"), "w") as file:
        file["before"], file["field"], file["far"] = VALUES[0], VALUES, h5py.ExternalLink("../outside.h5", "/field")
        file.create_virtual_dataset("virtual", layout)
        near = h5py.VirtualLayout((3, 4, 5), "f8")
        near[:] = h5py.VirtualSource(".", "field", (3, 4, 5))
        file.create_virtual_dataset("inner", near)
    with h5py.File(path, "a") as file:
        twice = h5py.VirtualLayout((3, 4, 5), "f8")
        twice[:] = h5py.VirtualSource("beside.h5", "inner", (3, 4, 5))
        file.create_virtual_dataset("twice", twice)
        own = h5py.VirtualLayout((3, 4, 5), "f8")
        own[:] = h5py.VirtualSource("v.h5", "own", (3, 4, 5))
        file.create_virtual_dataset("own", own)
    told = {"raw": "other files", "a": "too many links", "own": "no values"}
    for name in ("link", "soft", "virtual", "raw", "far", "near", ".//link", "a", "nested", "own"):
        refused(DataError, told.get(name, "own folder"), read_volume, f"{path}:/{name}")
    for stored in (False, True):
        for name in ("other", "twice"):
            np.testing.assert_array_equal(read_volume(f"{path}:/{name}", ReadOptions(stored=stored)).data[:], VALUES)


def test_scales_of_hdf5_stay_in_its_folder(tmp_path: Path) -> None:
    (tmp_path / "outside.raw").write_bytes(np.arange(5.0).tobytes())
    (tmp_path / "inner").mkdir()
    path = tmp_path / "inner" / "v.h5"
    with h5py.File(path, "w") as file:
        file["field"] = VALUES
        file.create_dataset("x", (5,), "f8", external=[("../outside.raw", 0, 40)]).make_scale()
        file["field"].dims[2].attach_scale(file["x"])
    refused(DataError, "external storage", read_volume, f"{path}:/field")


@pytest.mark.parametrize("place", ["ITKImage/0/VoxelData", "c/p/v", "t00000/s00/0/cells", "Data/Image/1/Data"])
def test_facts_of_hdf5_that_are_missing_are_named(tmp_path: Path, place: str) -> None:
    with h5py.File(tmp_path / "v.h5", "w") as file:
        file[place] = VALUES
        file.create_group("s00")
        file["Data/Image/1/Metadata/x" if "Data" in place else "c/_SIMPL_GEOMETRY/SPACING"] = np.ones(3)
        if "ITK" in place:
            file["ITKImage/0/Spacing"], file["ITKImage/0/Origin"] = np.ones(3), np.zeros(3)
    refused(
        DataError,
        "(Directions|ORIGIN|resolutions|Metadata): no dataset",
        read_dataset,
        tmp_path / "v.h5",
        ReadOptions(array=place),
    )


def test_netcdf_files_are_closed_in_turn(tmp_path: Path) -> None:
    """The garbage collector closes them, in any thread."""
    volume = read_volume(write_netcdf(tmp_path / "v.nc"), ReadOptions(stored=True))
    volume.data[:]
    with _TURN:
        closer = threading.Thread(target=lambda volumes: (volumes.clear(), gc.collect()), args=[[volume]])
        del volume
        closer.start()
        closer.join(0.5)
        assert closer.is_alive()
    closer.join()


def test_numpy_numbers_of_components(tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", np.stack([VALUES, VALUES + 1], -1))
    volume = read_volume(str(tmp_path / "v.npy"), ReadOptions(component=np.int64(1)))
    np.testing.assert_allclose(volume.data, VALUES + 1)


@pytest.mark.parametrize("place", ["x", "scaling_factor"])
def test_facts_of_nexus_stay_in_the_folder(place: str, tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    for name in ("outside.h5", "inner/beside.h5"):
        with h5py.File(tmp_path / name, "w") as file:
            file["x"], file["scaling_factor"] = np.arange(5) * 0.5, 2.0
    path = tmp_path / "inner" / "v.h5"
    for there in ("beside.h5", "../outside.h5"):
        with h5py.File(path, "w") as file:
            group = file.create_group("entry/data")
            group.attrs.update({"NX_class": "NXdata", "axes": ["z", "y", "x"]})
            group["counts"], group["z"], group["y"] = VALUES, np.arange(3), np.arange(4)
            group[place] = h5py.ExternalLink(there, place)
        if there == "beside.h5":
            volume = read_volume(str(path))
            assert (volume.spacing[0], volume.slope) == ((0.5, 1) if place == "x" else (1, 2))
    refused(DataError, "own folder", read_volume, str(path))


@pytest.mark.parametrize("version", [2, 3])
def test_zarr_with_coordinates(tmp_path: Path, version: int) -> None:
    store = tmp_path / "v.zarr"
    group = zarr.open_group(str(store), mode="w", zarr_format=version)
    for name, centres in AXES.items():
        names = {"dimension_names": [name]} if version == 3 else {}
        array = group.create_array(name, data=centres, **names)
        array.attrs.update({"units": "mm"} | ({"_ARRAY_DIMENSIONS": [name]} if version == 2 else {}))
    names = {"dimension_names": ["x", "z", "y"]} if version == 3 else {}
    stored = np.round(VALUES.transpose(2, 0, 1) * 2).astype("i4")
    stored[0, 0, 0] = -1
    array = group.create_array("deep/field", data=stored, chunks=(2, 2, 2), **names)
    told = {"scale_factor": 0.5, "_FillValue": -1} | ({"_ARRAY_DIMENSIONS": ["x", "z", "y"]} if version == 2 else {})
    array.attrs.update(told)
    refused(UsageError, r"no array .*it has deep/field \(5 x 3 x 4 (<i4|int32)", read_volume, f"{store}:/none")
    bare = read_volume(str(store))
    assert bare.name == "v:deep/field"
    assert bare.spacing == (1, 1, 1)  # the coordinates lie in another group
    (store / "deep" / "field").rename(store / "field")
    volume = read_volume(f"{store}:/field")
    check_grid(volume, atol=0.26)
    assert np.argwhere(np.isnan(volume.data)).tolist() == [[0, 0, 0]]


def test_zarr_array_by_itself_and_sharded(tmp_path: Path) -> None:
    store = tmp_path / "v.zarr"
    zarr.create_array(str(store), data=VALUES.astype("f4"), chunks=(1, 2, 5), shards=(3, 4, 5))
    volume = read_volume(str(store))
    assert volume.name == "v"
    np.testing.assert_array_equal(volume.data, VALUES.astype("f4"))


def test_the_axis_that_is_not_of_space_holds_components(tmp_path: Path) -> None:
    store, both = str(tmp_path / "v.zarr"), np.stack([VALUES, -VALUES], axis=2).astype("f4")
    zarr.create_array(store, data=both, dimension_names=["z", "y", "run", "x"])
    np.testing.assert_array_equal(read_volume(store, ReadOptions(component=1)).data, both[:, :, 1])


def test_ome_zarr(tmp_path: Path) -> None:
    store = tmp_path / "v.ome.zarr"
    group = zarr.open_group(str(store), mode="w", zarr_format=2)
    group.create_array("0", data=np.stack([VALUES, -VALUES]).astype("f4"))
    group.create_array("1", data=VALUES[None, :, ::2, ::2].astype("f4"))
    axes = [{"name": "c", "type": "channel"}, *({"name": n, "type": "space", "unit": "micrometer"} for n in "zyx")]
    moves = [{"type": "scale", "scale": [1, 2, 0.5, 0.25]}, {"type": "translation", "translation": [0, 10, -3, 0.5]}]
    level = {"path": "0", "coordinateTransformations": moves}
    group.attrs["multiscales"] = [{"version": "0.4", "axes": axes, "datasets": [level, {"path": "1"}]}]
    check_grid(read_volume(str(store), ReadOptions(component=0)))
    refused(UsageError, "along c 2 channels of type float32; .* --channel 0 to 1, all", read_volume, str(store))
    assert read_volume(f"{store}:/1").dims == (3, 2, 3)
    refused(UsageError, "none of time; leave out --time 1", read_volume, str(store), ReadOptions(time=1))


def test_a_magnitude_of_one_slice(tmp_path: Path) -> None:
    group = zarr.open_group(str(tmp_path / "v.zarr"), mode="w", zarr_format=3)
    group.create_array("v", data=np.stack([VALUES[0], 2 * VALUES[0]]), dimension_names=["c", "y", "x"])
    group["v"].attrs["scale_factor"] = 0.5
    group.attrs["ome"] = {"multiscales": [{"axes": [{"name": n} for n in "cyx"], "datasets": [{"path": "v"}]}]}
    volume = read_volume(f"{tmp_path / 'v.zarr'}:/v", ReadOptions(component="magnitude"))
    np.testing.assert_allclose(volume.data, 0.5 * np.sqrt(5) * np.abs(VALUES[:1]), rtol=1e-6)


def test_ome_zarr_of_channels_over_time(tmp_path: Path) -> None:
    store = tmp_path / "v.ome.zarr"
    values = np.stack([np.stack([VALUES + 10 * t + 100 * c for c in range(2)]) for t in range(3)]).astype("f4")
    group = zarr.open_group(str(store), mode="w", zarr_format=2)
    group.create_array("0", data=values)
    kinds = {"t": "time", "c": "channel"}
    axes = [{"name": n, "type": kinds.get(n, "space")} for n in "tczyx"]
    level = {"path": "0", "coordinateTransformations": [{"type": "scale", "scale": [1, 1, 2, 0.5, 0.25]}]}
    group.attrs["multiscales"] = [{"version": "0.4", "axes": axes, "datasets": [level]}]
    for time in range(3):
        volume = read_volume(str(store), ReadOptions(time=time, component=1))
        np.testing.assert_array_equal(volume.data, values[time, 1])
    refused(UsageError, "3 time steps", read_volume, str(store), ReadOptions(component=1))
    refused(UsageError, "along c 2 channels of .* --channel 0 to 1", read_volume, str(store), ReadOptions(time=1))


def test_zarr_refuses_codecs_that_run_code(tmp_path: Path) -> None:
    store = tmp_path / "v.zarr"
    zarr.create_array(str(store), data=VALUES, zarr_format=2)
    facts = json.loads((store / ".zarray").read_text())
    (store / ".zarray").write_text(json.dumps(facts | {"filters": [{"id": "pickle"}]}))
    refused(DataError, "codec 'pickle'; expected one of", read_volume, str(store))
    (store / ".zarray").write_text(json.dumps(facts | {"shape": [1 << 20] * 3, "chunks": [1 << 20] * 3}))
    refused(DataError, "chunks of", read_volume, str(store))


@pytest.mark.parametrize("order", ["C", "F"])
def test_npy(tmp_path: Path, order: str) -> None:
    np.save(tmp_path / "v.npy", np.asarray(VALUES, ">f4", order=order))
    volume = read_volume(str(tmp_path / "v.npy"), ReadOptions(spacing=(1, 2, 3)))
    np.testing.assert_array_equal(volume.data, VALUES.astype("f4"))
    assert volume.spacing == (1, 2, 3)
    assert volume.data.flags.c_contiguous
    assert isinstance(volume.data, np.memmap) == (order == "C")


@pytest.mark.parametrize("axis", [0, 3])
def test_npy_components(tmp_path: Path, axis: int) -> None:
    np.save(tmp_path / "v.npy", np.stack([VALUES, -VALUES], axis))
    np.testing.assert_array_equal(read_volume(str(tmp_path / "v.npy"), ReadOptions(component=1)).data, -VALUES)
    length = read_volume(str(tmp_path / "v.npy"), ReadOptions(component="magnitude"))
    np.testing.assert_allclose(length.data, np.sqrt(2) * VALUES, rtol=1e-6)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz(tmp_path: Path, save) -> None:
    path = tmp_path / "v.npz"
    save(path, field=VALUES, time=np.arange(3.0))
    volume = read_volume(str(path))
    assert volume.name == "v:field"
    np.testing.assert_array_equal(volume.data, VALUES)
    save(path, field=VALUES, other=VALUES + 1)
    refused(UsageError, r"several arrays: field \(.*; other \(.*; choose one with --array", read_volume, str(path))
    np.testing.assert_array_equal(read_volume(str(path), ReadOptions(array="other")).data, VALUES + 1)


def test_npy_lies(tmp_path: Path) -> None:
    np.save(tmp_path / "o.npy", np.array([{}], dtype=object), allow_pickle=True)
    refused(DataError, r"objects are never unpickled|type object", read_volume, str(tmp_path / "o.npy"))
    np.save(tmp_path / "v.npy", VALUES)
    body = (tmp_path / "v.npy").read_bytes()
    (tmp_path / "v.npy").write_bytes(body.replace(b"(3, 4, 5)", b"(9, 9, 9)"))
    refused(DataError, "after 128 bytes need", read_volume, str(tmp_path / "v.npy"))
    np.save(tmp_path / "w.npy", np.zeros(7))
    refused(DataError, r"axes unnamed \(7\); expected two or three axes", read_volume, str(tmp_path / "w.npy"))


@pytest.mark.parametrize(("name", "module"), [("v.h5", "h5py"), ("v.nc", "netCDF4"), ("v.zarr", "zarr")])
def test_a_missing_library_says_how_to_install_it(tmp_path, monkeypatch, name, module) -> None:
    if name == "v.zarr":
        zarr.create_array(str(tmp_path / name), data=VALUES)
    elif name == "v.h5":
        h5py.File(tmp_path / name, "w").create_dataset("field", data=VALUES).file.close()
    else:
        write_netcdf(tmp_path / name)
    monkeypatch.setitem(sys.modules, module, None)
    refused(DataError, rf"needs {module} .*pip install '{module}>=[\d.]+'$", read_volume, str(tmp_path / name))


@pytest.mark.parametrize("form", ["NETCDF3_CLASSIC", "NETCDF3_64BIT_OFFSET", "NETCDF3_64BIT_DATA"])
def test_netcdf_classic_headers_are_checked_before_the_library(tmp_path: Path, form: str) -> None:
    whole = Path(write_netcdf(tmp_path / "w.nc", format=form)).read_bytes()
    path, told = tmp_path / "v.nc", 0
    for at in range(4, 360):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x7F]) + whole[at + 1 :])
        try:
            check_header(path)
        except DataError:
            told += 1
    assert told > 100
    for cut in range(8, len(whole), 5):
        path.write_bytes(whole[:cut])
        refused(DataError, "NetCDF header", read_volume, str(path))


@pytest.mark.parametrize("step", [1e-6, 1.0, 1e6])
def test_coordinates_are_even_whatever_their_unit(step: float) -> None:
    centres = step * np.arange(11.0)
    off = step * (np.arange(11) == 4)
    assert even(centres)
    assert even(centres + 0.005 * off)
    assert not even(centres + 0.02 * off)
    assert not even((centres + 0.02 * off)[::-1])


def test_names_with_line_breaks_are_listed_in_one_line(tmp_path: Path) -> None:
    import h5py

    with h5py.File(tmp_path / "v.h5", "w") as file:
        for name in ("a\nb", "c"):
            file[name] = np.zeros((2, 3, 4))
    refused(UsageError, r"several datasets: /a\?b \(2 x 3 x 4", read_volume, str(tmp_path / "v.h5"))
