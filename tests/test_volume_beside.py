"""Coordinates that lie beside an array whose axes nothing states, and arrays of particles, which lie on no grid."""

import json
import warnings
from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest
import zarr

from tests.ramps import X, Y, Z, check_grid, ramp
from tests.refused import refused
from vvgt_cli.errors import DataError, SeveralSteps, UsageError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.stored import loaded

VALUES = ramp(X, Y, Z)
PLACES = np.random.default_rng(0).random((50, 3))
LINES = {"x": X, "y": Y, "z": Z}


def write(folder: Path, form: str, arrays: dict, attributes: dict | None = None) -> str:
    """Arrays by path in a file or folder of a form, and attributes of some of them."""
    path = folder / f"v.{form}"
    if form == "h5":
        with h5py.File(path, "w") as file:
            for name, values in arrays.items():
                file[name] = values
                file[name].attrs.update((attributes or {}).get(name, {}))
    elif form == "npz":
        np.savez(path, **arrays)
    elif form == "nc":
        with netCDF4.Dataset(path, "w") as file:
            sizes = sorted({n for values in arrays.values() for n in values.shape})
            for n in sizes:
                file.createDimension(f"n{n}", n)
            for name, values in arrays.items():
                file.createVariable(name, values.dtype, [f"n{n}" for n in values.shape])[:] = values
    else:
        group = zarr.open_group(path, mode="w", zarr_format=2 if form == "zarr" else 3)
        for name, values in arrays.items():
            group.create_array(name, data=values)
    return str(path)


@pytest.mark.parametrize("form", ["h5", "npz", "nc", "zarr", "v3.zarr"])
def test_coordinates_beside_an_array_place_it(tmp_path: Path, form: str) -> None:
    named = {f"{letter}_coords": line for letter, line in LINES.items()}
    path = write(tmp_path, form, {"field": VALUES, **named})
    check_grid(read_volume(path))
    check_grid(loaded(read_volume(path, ReadOptions(stored=True))))
    assert read_volume(path, ReadOptions(spacing=(1, 2, 3))).spacing == (1, 2, 3)


def test_members_that_are_no_numbers_are_no_coordinates(tmp_path: Path) -> None:
    np.savez(tmp_path / "v.npz", field=VALUES, facts=np.array({"a": 1}, object), **LINES)
    check_grid(read_volume(str(tmp_path / "v.npz")))


@pytest.mark.parametrize("form", ["h5", "npz", "nc", "zarr"])
def test_arrays_that_may_be_coordinates_are_named(tmp_path: Path, form: str) -> None:
    path = write(tmp_path, form, {"field": VALUES, "energies": Z, "other": np.arange(7.0)})
    with pytest.warns(
        UserWarning, match=r"states no spacing.* lie, as long as its axes, energies \(step 2\); --spacing"
    ):
        assert read_volume(path).spacing == (1, 1, 1)


@pytest.mark.parametrize(
    ("arrays", "attributes", "unit"),
    [
        ({"field": VALUES[:, ::-1], "x": X, "y": Y[::-1], "z": Z}, {}, ""),
        ({"field": VALUES, "X (um)": X, "Y (um)": Y, "Z (um)": Z}, {}, "um"),
        ({"field": VALUES.T, "x_mm": X, "y_mm": Y, "z_mm": Z}, {}, "mm"),
        ({"field": VALUES, "x": X[None], "y": Y[None], "z": Z[:, None]}, {key: {"units": "nm"} for key in "xyz"}, "nm"),
        ({"fields/rho": VALUES, "coords/x": X, "coords/y": Y, "coords/z": Z}, {}, ""),
        ({"data": VALUES} | {f"dim{k}": line for k, line in enumerate((Z, Y, X), 1)},
         {"dim3": {"name": "x", "units": "[n_m]"}, "dim1": {"name": "z", "units": "[n_m]"},
          "dim2": {"name": "y", "units": "[n_m]"}}, "nm"),
        ({"data": VALUES} | {f"dim{k}": line[:2] for k, line in enumerate((Z, Y, X))}, {}, ""),
    ],
)  # fmt: skip
def test_names_of_coordinates_in_hdf5(tmp_path: Path, arrays: dict, attributes: dict, unit: str) -> None:
    path = write(tmp_path, "h5", arrays, attributes)
    volume = read_volume(path)
    check_grid(volume)
    assert volume.unit == unit


def test_coordinates_that_fit_in_several_ways_are_named(tmp_path: Path) -> None:
    cube = ramp(X[:3], Y[:3], Z[:3])
    path = write(tmp_path, "h5", {"field": cube, "x": X[:3], "y": Y[:3], "z": Z[:3]})
    with pytest.warns(UserWarning, match="states no spacing"):
        assert read_volume(path).spacing == (1, 1, 1)
    same = write(tmp_path, "npz", {"field": cube, "x": Z[:3], "y": Z[:3], "z": Z[:3]})
    assert read_volume(same).spacing == (2, 2, 2)
    uneven = write(tmp_path, "npz", {"field": VALUES, "x": X, "y": Y, "z": Z**2})
    refused(UsageError, "axis z has steps .*--dims X Y Z", read_volume, uneven)


@pytest.mark.parametrize(
    ("form", "arrays"),
    [
        *((form, {"Coordinates": PLACES, "Masses": PLACES[:, 0]}) for form in ("h5", "npz", "nc", "zarr")),
        ("h5", {"PartType0/POS": PLACES.T.astype("f4"), "PartType0/Velocities": PLACES, "table": np.ones((4, 5))}),
        ("h5", {"particles/all/position/value": np.stack([PLACES] * 4), "particles/all/velocity/value": PLACES[None]}),
        ("nc", {"coordinates": np.stack([PLACES[:, :2]] * 4)}),  # AMBER
        *((form, {"position_x": PLACES[:, 0], "position_y": PLACES[:, 1]}) for form in ("h5", "npz", "nc", "zarr")),
        ("h5", {f"data/0/particles/e/position/{k}": PLACES[:, 0] for k in "xyz"}),  # openPMD
    ],
)
def test_particles_are_no_picture(tmp_path: Path, form: str, arrays: dict) -> None:
    path = write(tmp_path, form, arrays)
    refused(DataError, "particles .*, which lie on no grid; .*deposit them first", read_volume, path)
    first = next(iter(arrays))
    if arrays[first].ndim > 1:
        refused(DataError, f"particles .*{first}", read_volume, path, ReadOptions(array=first))
    beside = write(tmp_path, form, arrays | {"density": VALUES})
    assert read_volume(beside).dims == VALUES.shape[::-1]


@pytest.mark.parametrize("blocks", [False, True])
def test_frames_of_velox_are_time_steps(tmp_path: Path, blocks: bool) -> None:
    frames = np.arange(4 * 5 * 3, dtype="u2").reshape(4, 5, 3)
    facts = {"BinaryResult": {"PixelSize": {"width": "2e-10", "height": "5e-10"}, "PixelUnitX": "m", "PixelUnitY": "m"}}
    text = np.frombuffer(json.dumps(facts).encode().ljust(300, b"\0"), np.uint8)
    path = write(tmp_path, "h5", {"Data/Image/1a/Data": frames, "Data/Image/1a/Metadata": np.stack([text] * 3, 1)})
    refused(SeveralSteps, "3 time steps", read_volume, path)
    volume = read_volume(path, ReadOptions(time=2, stored=blocks))
    np.testing.assert_array_equal(volume.data[:][0], frames[:, :, 2])
    np.testing.assert_allclose((*volume.spacing[:2], volume.unit == "m"), (2e-10, 5e-10, 1))


@pytest.mark.parametrize("form", ["h5", "npz", "zarr"])
def test_places_in_forms_that_are_not_read_are_named(tmp_path: Path, form: str) -> None:
    path = write(tmp_path, form, {"field": VALUES, "voxel_size": np.array([0.3]), "affine": np.eye(4)})
    with pytest.warns(UserWarning, match="taken as 1; beside it lie, in forms that are not read, (v|a)"):
        assert read_volume(path).spacing == (1, 1, 1)
    placed = write(tmp_path, form, {"field": VALUES, "voxel_size": np.array([0.3]), **LINES})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_grid(read_volume(placed))


def test_xdmf_beside_hdf5_is_named(tmp_path: Path) -> None:
    path = write(tmp_path, "h5", {"field": VALUES})
    (tmp_path / "v.xdmf").write_text("<Xdmf/>")
    with pytest.warns(UserWarning, match=r"states no spacing, which is taken as 1; v\.xdmf may: give that file"):
        read_volume(path)


@pytest.mark.parametrize("form", ["nc", "enum.nc", "h5"])
def test_flags_and_enumerations_are_labels(tmp_path: Path, form: str) -> None:
    values, names = np.arange(60).reshape(3, 4, 5) % 3, {"air": 0, "sea ice": 1, "land": 2}
    path = tmp_path / f"v.{form}"
    if form == "h5":
        with h5py.File(path, "w") as file:
            file.create_dataset("kind", data=values.astype("u1"), dtype=h5py.enum_dtype(names, basetype="u1"))
    else:
        with netCDF4.Dataset(path, "w") as file:
            for name, size in zip("zyx", values.shape, strict=True):
                file.createDimension(name, size)
            plain = {name.replace(" ", "_"): number for name, number in names.items()}
            kind = file.createEnumType("u1", "kinds", plain) if "enum" in form else "u1"
            file.createVariable("kind", kind, ("z", "y", "x"))[:] = values.astype("u1")
            if "enum" not in form:
                file["kind"].setncatts({"flag_values": np.arange(3, dtype="u1"), "flag_meanings": " ".join(plain)})
    for stored in (False, True):
        segments = read_volume(str(path), ReadOptions(stored=stored)).segments
        assert {one.name.replace("_", " "): one.number for one in segments} == names
    if form == "nc":  # of bits
        with netCDF4.Dataset(path, "a") as file:
            file["kind"].flag_masks = np.arange(3, dtype="u1")
        assert read_volume(str(path)).segments is None


@pytest.mark.parametrize(
    "stated",
    [
        {"scale_factor": 0.01}, {"units": "percent"}, {"valid_range": np.array([0, 100], "u1")}, {"dtype": "f4"},
        {"flag_meanings": "land"},
    ],
)  # fmt: skip
def test_flags_of_a_quantity_and_damaged_ones_make_no_labels(tmp_path: Path, stated: dict) -> None:
    stated = {"dtype": "u1", "flag_values": np.array([251, 253], "u1"), "flag_meanings": "land coast", **stated}
    with netCDF4.Dataset(tmp_path / "v.nc", "w") as file:
        for name, size in zip("zyx", (3, 4, 5), strict=True):
            file.createDimension(name, size)
        for name in ("whole", "holed"):
            one = file.createVariable(name, stated["dtype"], ("z", "y", "x"), fill_value=255)
            one[:] = np.where((np.arange(60) == 0) & (name == "holed"), 255, np.arange(60)).reshape(3, 4, 5)
            one.setncatts({key: value for key, value in stated.items() if key != "dtype"})
    for name in ("whole", "holed"):
        for stored in (False, True):
            assert read_volume(str(tmp_path / "v.nc"), ReadOptions(array=name, stored=stored)).segments is None


def test_flags_have_the_sign_of_their_values(tmp_path: Path) -> None:
    flags = np.array([0, 251], "u1").view("i1")
    with netCDF4.Dataset(tmp_path / "v.nc", "w") as file:
        for name, size in zip("zyx", (3, 4, 5), strict=True):
            file.createDimension(name, size)
        file.createVariable("kind", "i1", ("z", "y", "x"))[:] = flags[np.arange(60).reshape(3, 4, 5) % 2]
        told = {"_Unsigned": "true", "valid_max": flags[1], "flag_values": flags, "flag_meanings": "sea land"}
        file["kind"].setncatts(told)
    for stored in (False, True):
        volume = read_volume(str(tmp_path / "v.nc"), ReadOptions(stored=stored))
        assert [one.number for one in volume.segments or ()] == np.unique(volume.data[:]).tolist() == [0, 251]
