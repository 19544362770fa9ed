"""Geometry that files state: directions, conventions, units, spellings, decimal commas."""

import json
import re
import warnings
from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest
import SimpleITK as sitk
import xarray
import zarr

import vvgt_cli as vvgt
from tests.ramps import X, Y, Z, check_grid, ramp
from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, Volume, read_volume
from vvgt_cli.volume.space import metres, one_unit

COUNT = np.arange(120).reshape(4, 5, 6)  # z, y, x
STEPS = 10.0 * np.arange(4)


def write_netcdf(path: Path, name: str, centres: np.ndarray, **attributes: str) -> str:
    """Values that count along a vertical axis, on metres along x and y."""
    across = {"units": "m"}
    axes = ((name, centres, attributes), ("y", 10.0 * np.arange(5), across), ("x", 10.0 * np.arange(6), across))
    with netCDF4.Dataset(path, "w") as file:
        for label, values, stated in axes:
            file.createDimension(label, len(values))
            variable = file.createVariable(label, "f8", (label,))
            variable[:] = values
            variable.setncatts({**stated, "axis": label.upper()} if label in "xy" else stated)
        file.createVariable("field", "f4", (name, "y", "x"))[:] = np.arange(4.0)[:, None, None]
    return str(path)


def write_hdf5(path: Path, name: str, centres: np.ndarray, **attributes: str) -> str:
    with h5py.File(path, "w") as file:
        file["field"] = np.broadcast_to(np.arange(4.0)[:, None, None], (4, 5, 6))
        for k, (label, values, stated) in enumerate(
            ((name, centres, attributes), ("y", 10.0 * np.arange(5), {}), ("x", 10.0 * np.arange(6), {}))
        ):
            scale = file.create_dataset(label, data=values)
            scale.attrs.update({"units": "m"} | stated)
            scale.make_scale(label)
            file["field"].dims[k].attach_scale(scale)
    return f"{path}:/field"


def write_zarr(path: Path, name: str, centres: np.ndarray, **attributes: str) -> str:
    group = zarr.open_group(path, mode="w", zarr_format=2)
    field = group.create_array("field", shape=(4, 5, 6), dtype="f4")
    field[:] = np.arange(4.0)[:, None, None]
    field.attrs["_ARRAY_DIMENSIONS"] = [name, "y", "x"]
    for label, values, stated in (
        (name, centres, attributes), ("y", 10.0 * np.arange(5), {}), ("x", 10.0 * np.arange(6), {}),
    ):  # fmt: skip
        array = group.create_array(label, shape=values.shape, dtype="f8")
        array[:] = values
        array.attrs.update({"units": "m"} | stated)
    return f"{path}:/field"


def read_xarray(path: Path, name: str, centres: np.ndarray, **attributes: str) -> Volume:
    import xarray

    import vvgt_cli as vvgt

    sides = {"y": 10.0 * np.arange(5), "x": 10.0 * np.arange(6)}
    coords = {name: ((name,), centres, {"units": "m"} | attributes)}
    coords |= {k: ((k,), v, {"units": "m"}) for k, v in sides.items()}
    values = np.broadcast_to(np.arange(4.0)[:, None, None], (4, 5, 6))
    return vvgt.read_volume(xarray.DataArray(values, coords, (name, "y", "x")))


WRITERS = {"NetCDF": (write_netcdf, "v.nc"), "HDF5": (write_hdf5, "v.h5"), "Zarr": (write_zarr, "v.zarr")}
DIRECTIONS = [  # name, coordinates, attributes, lowest position, value there
    ("depth", STEPS, {"positive": "down"}, -30.0, 3.0),
    ("z", STEPS, {"positive": "up"}, 0.0, 0.0),
    ("z", STEPS[::-1], {"positive": "down"}, -30.0, 0.0),
    ("deptht", STEPS, {}, -30.0, 3.0),
    ("z", STEPS, {"standard_name": "depth"}, -30.0, 3.0),
    ("height", STEPS[::-1], {}, 0.0, 3.0),
]


@pytest.mark.parametrize("reader", [*WRITERS, "xarray"])
@pytest.mark.parametrize(("name", "centres", "attributes", "lowest", "value"), DIRECTIONS)
@pytest.mark.filterwarnings("ignore:axis dept.*taken as pointing down", "ignore:axis z.*taken as pointing down")
def test_vertical_axes_point_up(tmp_path, reader, name, centres, attributes, lowest, value) -> None:
    if reader == "xarray":
        found = [read_xarray(tmp_path, name, centres, **attributes)]
    else:
        write, file = WRITERS[reader]
        source = write(tmp_path / file, name, centres, **{"units": "m", **attributes})
        found = [read_volume(source, options) for options in (
            ReadOptions(), ReadOptions(spacing=(10, 10, 10)), ReadOptions(stored=True),
        )]  # fmt: skip
    for volume in found:
        assert volume.origin == (0, 0, lowest)
        assert volume.spacing == (10, 10, 10)
        assert np.asarray(volume.data[:1])[0, 0, 0] == value


def test_pressure_points_down_and_other_directions_are_said(tmp_path: Path) -> None:
    """CF 4.3.1: the direction of pressure is implied. Levels of the air lie from the ground up, in any order."""
    levels = np.array([1000.0, 700.0, 400.0, 100.0])
    for centres, ground in ((levels, 0.0), (levels[::-1], 3.0)):
        source = write_netcdf(tmp_path / "v.nc", "isobaric", centres, units="hPa")
        assert read_volume(source, ReadOptions(spacing=(1, 1, 1))).data[0, 0, 0] == ground
    source = write_netcdf(tmp_path / "w.nc", "lev", STEPS, units="m", positive="north")
    with pytest.warns(UserWarning, match="positive is 'north', neither up nor down; taken as up"):
        assert read_volume(source).origin[2] == 0
    with pytest.warns(UserWarning, match="depth: taken as pointing down"):
        read_volume(write_netcdf(tmp_path / "u.nc", "depth", STEPS, units="m"))


@pytest.mark.parametrize(
    ("names", "placed"),
    [("nav_lon nav_lat", "z"), ("lon lat", "zji"), ("lon lat", "zJI"), ("valid_time platform", "z")],
)
def test_curvilinear_places_are_said(tmp_path: Path, names: str, placed: str) -> None:
    with netCDF4.Dataset(tmp_path / "v.nc", "w") as file:
        for name, n in (("z", 4), ("j", 5), ("i", 6)):
            file.createDimension(name, n)
        for letter in placed:  # J and I of a projection, j and i that count cells
            name = letter.lower()
            file.createVariable(name, "f8", (name,))[:] = np.arange(file.dimensions[name].size)
            if letter in "JI":
                file[name].axis = {"J": "Y", "I": "X"}[letter]
        for name in names.split():
            file.createVariable(name, "f4", ("j", "i"))[:] = 0
        file.createVariable("t", "f4", ("z", "j", "i"))[:] = COUNT
        file["t"].coordinates = names
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        read_volume(str(tmp_path / "v.nc"))
    found = [re.search(r"curvilinear \((.*)\), which is not read.*cdo remapbil", str(one.message)) for one in told]
    said = [] if placed == "zJI" or "time" in names else [", ".join(names.split())]
    assert [one[1] for one in found if one] == said


@pytest.mark.parametrize("suffix", [".nc", ".h5"])
def test_bounds_are_no_volumes(tmp_path: Path, suffix: str) -> None:
    """Files of netCDF before 4.4.1 do not say that they are NetCDF."""
    path = tmp_path / f"v{suffix}"
    with netCDF4.Dataset(path, "w") as file:
        for name, n in (("z", 4), ("y", 5), ("x", 6), ("vertex", 4)):
            file.createDimension(name, n)
        file.createVariable("t", "f4", ("z", "y", "x"))[:] = COUNT
        file.createVariable("area", "f4", ("z", "y", "x"))[:] = 1
        file["t"].cell_measures = "area: area"
        for name in ("lon", "lat"):
            file.createVariable(name, "f4", ("y", "x"))[:] = 0
            file[name].bounds = f"{name}_corners"
            file.createVariable(f"{name}_corners", "f4", ("y", "x", "vertex"))[:] = 0
    with h5py.File(path, "r+") as file:
        del file.attrs["_NCProperties"]
    assert read_volume(str(path)).name == "v:t"


def openpmd(path: Path, order: str = "C", **changes: object) -> str:
    """The ramp as a component of a vector; in Fortran's order the labels are reversed."""
    labels, spacing, offset = ["z", "y", "x"], [2.0, 0.5, 0.25], [10.0, -3.0, 0.25]
    turn = slice(None, None, -1 if order == "F" else 1)
    with h5py.File(path, "w") as file:
        file.attrs["openPMD"] = np.bytes_("1.1.0")
        mesh = file.create_group("data/100/meshes/E")
        mesh.attrs.update({
            "axisLabels": np.array(labels[turn], "S1"), "dataOrder": np.bytes_(order), "gridSpacing": spacing[turn],
            "geometry": np.bytes_("cartesian"), "gridGlobalOffset": offset[turn], **changes,
        })  # fmt: skip
        mesh["x"] = ramp(X, Y, Z) / 4
        mesh["x"].attrs.update({"position": [0.0, 0.0, 1.0][turn], "unitSI": 4.0})
    return str(path)


@pytest.mark.parametrize("order", ["C", "F"])
def test_openpmd_axes(tmp_path: Path, order: str) -> None:
    for options in (ReadOptions(), ReadOptions(stored=True)):
        volume = read_volume(openpmd(tmp_path / "v.h5", order), options)
        assert volume.unit == "m"
        if not options.stored:
            check_grid(volume)
        assert volume.origin == (X[0], Y[0], Z[0])


def test_openpmd_that_is_not_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="openPMD geometry 'thetaMode'; expected cartesian"):
        read_volume(openpmd(tmp_path / "v.h5", geometry=np.bytes_("thetaMode")))
    with pytest.raises(DataError, match="openPMD axes z, y for 3 axes of values"):
        read_volume(openpmd(tmp_path / "v.h5", axisLabels=np.array(["z", "y"], "S1")))
    small = read_volume(openpmd(tmp_path / "v.h5", gridUnitSI=1e-6))
    np.testing.assert_allclose(small.spacing, (0.25e-6, 0.5e-6, 2e-6))


def test_nexus_axes(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "v.h5", "w") as file:
        group = file.create_group("entry/data")
        group.attrs.update({"NX_class": "NXdata", "signal": "counts", "axes": ["height", "y", "x"]})
        group["counts"] = ramp(X, Y, Z)
        for name, centres in (("height", Z), ("y", Y), ("x", X)):
            group[name] = centres
            group[name].attrs["units"] = "mm"
    volume = read_volume(str(tmp_path / "v.h5"))
    check_grid(volume)
    assert volume.unit == "mm"


def test_voxel_sizes_of_fiji_and_axes_of_ilastik(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "v.h5", "w") as file:
        file["v"] = COUNT
        file["v"].attrs["element_size_um"] = [2.0, 0.5, 0.25]
        file["w"] = np.stack([COUNT, COUNT + 1000], -1).transpose(2, 1, 0, 3)
        tags = [{"key": k, "resolution": step} for k, step in zip("xyzc", (0.25, 0.5, 2, 0), strict=True)]
        file["w"].attrs["axistags"] = json.dumps({"axes": tags})
        file["u"] = COUNT
        file["u"].attrs["voxel_size"] = [1.0, 2.0, 3.0]
    volume = read_volume(f"{tmp_path}/v.h5:/v")
    assert (volume.spacing, volume.unit) == ((0.25, 0.5, 2), "um")
    volume = read_volume(f"{tmp_path}/v.h5:/w", ReadOptions(component=1))
    assert volume.spacing == (0.25, 0.5, 2)
    np.testing.assert_array_equal(volume.data, COUNT + 1000)
    with pytest.warns(UserWarning, match="attributes voxel_size are not read; --spacing X Y Z"):
        read_volume(f"{tmp_path}/v.h5:/u")


@pytest.mark.parametrize("version", ["0.1", "0.2", None])
def test_ome_zarr_before_0_3_has_times_and_channels(tmp_path: Path, version: str | None) -> None:
    group = zarr.open_group(tmp_path / "v.zarr", mode="w", zarr_format=2)
    image = {"datasets": [{"path": "0"}]} | ({"version": version} if version else {})
    group.attrs["multiscales"] = [image]
    values = np.arange(2 * 3 * 60).reshape(2, 3, 3, 4, 5)
    group.create_array("0", shape=values.shape, dtype="u2")[:] = values
    volume = read_volume(str(tmp_path / "v.zarr"), ReadOptions(time=1, component=2))
    np.testing.assert_array_equal(volume.data, values[1, 2])
    image["axes"] = ["z", "y", "x"]
    group.attrs["multiscales"] = [image]
    with pytest.raises(DataError, match="with 5 axes of values; expected 3"):
        read_volume(str(tmp_path / "v.zarr"), ReadOptions(time=1, component=2))


def nrrd(path: Path, *lines: str) -> str:
    head = "\n".join(["NRRD0005", "type: uchar", "dimension: 3", "sizes: 6 5 4", "encoding: raw", *lines, "", ""])
    path.write_bytes(head.encode() + COUNT.astype("u1").tobytes())
    return str(path)


@pytest.mark.parametrize("lines", [
    ("space: left-posterior-superior", "space directions: (0,2,0)(0,0,1.5) (3,0,0)", "space origin: (10, -20, 5)"),
    ("spacings: 2 1.5 3", "axis mins: 10 20 30"),
    ("spacings: 2 1.5 3", "axis mins: 10 20 30", "centerings: node node node"),
    ("spacings: -2 1.5 3", "axis mins: 10 20 30", "axis maxs: 5 6 7"),
])  # fmt: skip
def test_nrrd_spellings_as_in_itk(tmp_path: Path, lines: tuple[str, ...]) -> None:
    source = nrrd(tmp_path / "v.nrrd", *lines)
    theirs, ours = sitk.ReadImage(source), read_volume(source, ReadOptions(space="LPS" if "LPS" in lines[0] else None))
    turn = np.diag([-1, -1, 1]) if ours.space == "RAS" else np.eye(3)
    for index in ((0, 0, 0), (5, 0, 0), (0, 4, 0), (0, 0, 3)):
        here = ours.affine @ [*index, 1]
        np.testing.assert_allclose(turn @ here[:3], theirs.TransformIndexToPhysicalPoint(index), atol=1e-9)


@pytest.mark.parametrize(("centers", "step", "first"), [("cell", 2.0, 1.0), ("node", 2.4, 0.0), ("", 2.0, 1.0)])
def test_nrrd_steps_by_minimum_and_maximum(tmp_path: Path, centers: str, step: float, first: float) -> None:
    """ITK takes the first position from them, and 1 as the step; the format says both."""
    more = [f"centers: {centers} {centers} {centers}"] if centers else []
    volume = read_volume(nrrd(tmp_path / "v.nrrd", "axis mins: 0 nan 0", "axis maxs: 12 nan 8", *more))
    np.testing.assert_allclose(volume.spacing, (step, 1, 8 / 3 if centers == "node" else 2))
    np.testing.assert_allclose(volume.origin, (first, 0, first))


@pytest.mark.parametrize(("lines", "unit", "spacing"), [
    (["spacings: 2 2 3", 'units: "um" "um" "mm"'], "um", (2, 2, 3000)),
    (["spacings: 2 2 3", 'units: "microns" "micrometers" ""'], "um", (2, 2, 3)),
    (["space dimension: 3", "space directions: (2,0,0) (0,2,0) (0,0,3)", 'space units: "microns" "microns" "microns"'],
     "um", (2, 2, 3)),
    (["space: RAS", "space directions: (2,0,0) (0,2,0) (0,0,3)", 'space units: "cm" "cm" "cm"'], "", (20, 20, 30)),
])  # fmt: skip
def test_nrrd_units(tmp_path: Path, lines: list[str], unit: str, spacing: tuple[float, ...]) -> None:
    volume = read_volume(nrrd(tmp_path / "v.nrrd", *lines))
    assert volume.unit == unit
    np.testing.assert_allclose(volume.spacing, spacing)


def test_units_that_do_not_compare_or_are_not_known() -> None:
    with pytest.raises(UsageError, match="lengths in um, um, s; expected one unit of length: try --spacing"):
        one_unit(["um", "um", "s"], "v", False)
    with pytest.warns(UserWarning, match="unit 'um' is not a known|unit 'parsec' is not a known unit of length"):
        factors, unit = one_unit(["parsec"] * 3, "v", False)
    assert (factors.tolist(), unit) == ([1, 1, 1], "")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert one_unit(["", "", ""], "v", False)[1] == ""


def test_metaimage_units_and_scaling(tmp_path: Path) -> None:
    def write(*lines: str) -> str:
        text = ["ObjectType = Image", "NDims = 3", "BinaryData = True", "DimSize = 6 5 4", "ElementType = MET_UCHAR"]
        path = tmp_path / "v.mha"
        head = "\n".join([*text, *lines, "ElementDataFile = LOCAL", ""]).encode()
        path.write_bytes(head + COUNT.astype("u1").tobytes())
        return str(path)

    volume = read_volume(write("ElementSpacing = 2 2 3", "DistanceUnits = um"))
    assert (volume.spacing, volume.unit) == ((2, 2, 3), "um")
    source = write(
        "ElementSpacing = 2 2 3", "DistanceUnits = cm", "Offset = 1 0 0", "TransformMatrix = 1 0 0 0 1 0 0 0 1"
    )
    volume = read_volume(source, ReadOptions(space="LPS"))
    assert (volume.spacing, volume.unit, volume.origin) == ((20, 20, 30), "", (10, 0, 0))
    with pytest.warns(UserWarning, match="ElementToIntensityFunction is not applied"):
        ours = read_volume(source := write("ElementSpacing = 1 1 1", "ElementToIntensityFunctionSlope = 2"))
    assert ours.data.max() == sitk.GetArrayFromImage(sitk.ReadImage(source)).max()


DECIMALS = {  # a header with one field that a decimal comma is put in
    "v.mha": "ObjectType = Image\nNDims = 3\nDimSize = 6 5 4\nElementType = MET_UCHAR\n{}\nElementDataFile = LOCAL\n",
    "v.nrrd": "NRRD0005\ntype: uchar\ndimension: 3\nsizes: 6 5 4\nencoding: raw\n{}\n\n",
    "v.dat": "RawFile: v.raw\nResolution: 6 5 4\nFormat: UINT8\n{}\n",
    "v.vtk": "# vtk DataFile Version 3.0\nv\nBINARY\nDATASET STRUCTURED_POINTS\nDIMENSIONS 6 5 4\n{}\nPOINT_DATA 120\n"
    "SCALARS v unsigned_char\nLOOKUP_TABLE default\n",
    "v.dx": "object 1 class gridpositions counts 4 5 6\n{}\ndelta 0 0 1\ndelta 0 1 0\ndelta 1 0 0\nobject 2 class "
    "gridconnections counts 4 5 6\nobject 3 class array type float rank 0 items 120 data follows\n",
    "v.vti": '<VTKFile type="ImageData" byte_order="LittleEndian">'
    '<ImageData WholeExtent="0 5 0 4 0 3" Origin="0 0 0" {}>'
    '<Piece Extent="0 5 0 4 0 3"><PointData Scalars="v"><DataArray type="UInt8" Name="v" format="ascii">'
    + "1 " * 120 + "</DataArray></PointData></Piece></ImageData></VTKFile>",
}  # fmt: skip
FIELDS = [
    ("v.mha", "ElementSpacing = 1,5 1,5 2,5"), ("v.mha", "ElementSpacing = 1,5, 1,5, 2,5"),
    ("v.mha", "ElementSpacing = 1 1 2,5"), ("v.mha", "Offset = 0,5 0,5 0,5"),
    ("v.mha", "TransformMatrix = 1,0 0 0 0 1,0 0 0 0 1,0"), ("v.mha", "ElementSize = 1,5,1,5,2,5"),
    ("v.nrrd", "spacings: 1,5 1,5 2,5"), ("v.nrrd", "space: LPS\nspace directions: (1,5,0,0) (0,1,0) (0,0,1)"),
    ("v.nrrd", "space: LPS\nspace directions: (1,5,0,0,0,0) (0,0,1,5,0,0) (0,0,0,0,2,5)"),
    ("v.nrrd", "space: LPS\nspace directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: (0,5,0,5,0,5)"),
    ("v.nrrd", "axis mins: 0,5 0 0"),
    ("v.dat", "Spacing: 1,5 1,5 2,5"), ("v.dat", "SliceThickness: 0,5 0,5 1"), ("v.dat", "Offset: 0,5 0 0"),
    ("v.dat", "BasisVector1: 1,5 0 0\nBasisVector2: 0 1 0\nBasisVector3: 0 0 1"),
    ("v.vtk", "ORIGIN 0 0 0\nSPACING 1,5 1,5 2,5"), ("v.dx", "origin 0,5 0 0"), ("v.vti", 'Spacing="1,5 1,5 2,5"'),
]  # fmt: skip


@pytest.mark.parametrize(("name", "field"), FIELDS)
def test_decimal_commas_are_never_half_a_number(tmp_path: Path, name: str, field: str) -> None:
    (tmp_path / "v.raw").write_bytes(COUNT.astype("u1").tobytes())
    text = DECIMALS[name].format(field)
    values = b"1 " * 120 if name == "v.dx" else COUNT.astype("u1").tobytes() if name != "v.vti" else b""
    (tmp_path / name).write_bytes(text.encode() + values)
    with pytest.raises(DataError, match=r"\d,\d"):
        read_volume(str(tmp_path / name))
    plain = re.sub(r"(?<=[ \"=(:])(\d),(\d)(?=[ \"\n]|$)", r"\1.\2", field)
    if plain != field and "," not in plain:  # the same with points is read
        (tmp_path / name).write_bytes(DECIMALS[name].format(plain).encode() + values)
        read_volume(str(tmp_path / name))


@pytest.mark.parametrize("field", ["ElementSpacing = 1, 1, 2", "ElementSpacing = 1,1,2", "ElementSpacing = 1 1 2"])
def test_commas_between_numbers_are_separators(tmp_path: Path, field: str) -> None:
    (tmp_path / "v.mha").write_bytes(DECIMALS["v.mha"].format(field).encode() + COUNT.astype("u1").tobytes())
    assert read_volume(str(tmp_path / "v.mha")).spacing == (1, 1, 2)


@pytest.mark.parametrize("form", ["openpmd", "fiji", "ilastik", "dream3d", "ome"])
def test_one_slice_is_as_thick_as_its_file_states(tmp_path: Path, form: str) -> None:
    flat, sizes = ramp(X, Y, Z[:1]), [2.0, 0.5, 0.25]
    path = tmp_path / "v.h5"
    if form == "ome":
        group = zarr.open_group(str(tmp_path / "v.zarr"), mode="w", zarr_format=2)
        group.create_array("0", data=flat)
        units = {"z": "micrometer", "y": "millimeter", "x": "millimeter"}
        scale = {"type": "scale", "scale": [2000.0, 0.5, 0.25]}
        level = {"path": "0", "coordinateTransformations": [scale]}
        axes = [{"name": name, "type": "space", "unit": unit} for name, unit in units.items()]
        group.attrs["multiscales"] = [{"version": "0.4", "axes": axes, "datasets": [level]}]
        path = tmp_path / "v.zarr"
    elif form == "openpmd":
        openpmd(path)
        with h5py.File(path, "r+") as file:
            del file["data/100/meshes/E/x"]
            file["data/100/meshes/E/x"] = flat
    else:
        with h5py.File(path, "w") as file:
            data = file.create_dataset("c/cells/v", data=flat)
            tags = [{"key": key, "resolution": step} for key, step in zip("zyx", sizes, strict=True)]
            data.attrs.update({"fiji": {"element_size_um": sizes}, "ilastik": {"axistags": json.dumps({"axes": tags})}}
                              .get(form, {}))  # fmt: skip
            file.update({"c/_SIMPL_GEOMETRY/SPACING": sizes[::-1], "c/_SIMPL_GEOMETRY/ORIGIN": [0.0] * 3}
                        if form == "dream3d" else {})  # fmt: skip
    where = f"{path}:/c/cells/v" if form == "dream3d" else str(path)
    np.testing.assert_allclose(read_volume(where).spacing, (0.25, 0.5, 2.0))


@pytest.mark.parametrize("kind", ["affine", "rotation", "scale"])
def test_transformations_of_ome_zarr_that_are_not_read_are_refused(tmp_path: Path, kind: str) -> None:
    store = str(tmp_path / "v.zarr")
    group = zarr.open_group(store, mode="w", zarr_format=2)
    group.create_array("0", data=COUNT)
    step = {"type": kind, "path": "elsewhere"} if kind == "scale" else {"type": kind, kind: np.eye(3).tolist()}
    axes = [{"name": name, "type": "space"} for name in "zyx"]
    level = {"path": "0", "coordinateTransformations": [{"type": "identity"}, step]}
    group.attrs["multiscales"] = [{"version": "0.4", "axes": axes, "datasets": [level]}]
    refused(UsageError, f"a transformation .*{kind}.*; expected scale and translation .*--spacing", read_volume, store)
    assert read_volume(store, ReadOptions(spacing=(1, 2, 3))).spacing == (1, 2, 3)


def test_images_of_ome_zarr_in_groups_of_their_own(tmp_path: Path) -> None:
    """As ngff-zarr writes them: scale0/image."""
    group = zarr.open_group(str(tmp_path / "v.zarr"), mode="w", zarr_format=2)
    axes = [{"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"]
    levels = []
    for k in range(2):
        group.create_array(f"scale{k}/image", data=COUNT[:: k + 1, :: k + 1, :: k + 1])
        steps = [{"type": "scale", "scale": [2 * (k + 1), 0.5 * (k + 1), 0.25 * (k + 1)]}]
        levels.append({"path": f"scale{k}/image", "coordinateTransformations": steps})
    image = {"version": "0.4", "axes": axes, "datasets": levels, "coordinateTransformations": None}
    group.attrs["multiscales"] = [image]
    for k in range(2):
        volume = read_volume(str(tmp_path / "v.zarr"), ReadOptions(level=k))
        assert (volume.spacing, volume.unit) == ((0.25 * (k + 1), 0.5 * (k + 1), 2.0 * (k + 1)), "um")


@pytest.mark.parametrize("place", ["z", "y"])
def test_an_axis_of_one_value_stays_beside_channels(tmp_path: Path, place: str) -> None:
    values = COUNT[:1] if place == "z" else COUNT[:, :1]
    group = zarr.open_group(str(tmp_path / "v.zarr"), mode="w", zarr_format=2)
    group.create_array("0", data=np.stack([values, values + 1]))
    axes = [{"name": "c", "type": "channel"}, *({"name": n, "type": "space"} for n in "zyx")]
    level = {"path": "0", "coordinateTransformations": [{"type": "scale", "scale": [1, 2, 0.5, 0.25]}]}
    group.attrs["multiscales"] = [{"version": "0.4", "axes": axes, "datasets": [level]}]
    volume = read_volume(str(tmp_path / "v.zarr"), ReadOptions(component=1))
    assert volume.spacing == (0.25, 0.5, 2.0)
    np.testing.assert_array_equal(volume.data, values + 1)


def test_more_axes_of_one_value_than_are_needed(tmp_path: Path) -> None:
    group = zarr.open_group(str(tmp_path / "v.zarr"), mode="w", zarr_format=2)
    array = group.create_array("v", data=np.arange(120).reshape(4, 1, 5, 6).astype(np.uint8))
    array.attrs["_ARRAY_DIMENSIONS"] = ["section", "z", "y", "x"]
    assert read_volume(f"{tmp_path / 'v.zarr'}/v").dims == (6, 5, 4)


def test_times_of_ome_zarr(tmp_path: Path) -> None:
    group = zarr.open_group(str(tmp_path / "v.zarr"), mode="w", zarr_format=2)
    group.create_array("0", data=np.stack([COUNT, COUNT + 1]))
    axes = [{"name": "t", "type": "time", "unit": "second"}, *({"name": n, "type": "space"} for n in "zyx")]
    level = {"path": "0", "coordinateTransformations": [{"type": "scale", "scale": [2.5, 1, 1, 1]}]}
    group.attrs["multiscales"] = [{"version": "0.4", "axes": axes, "datasets": [level]}]
    assert read_volume(str(tmp_path / "v.zarr"), ReadOptions(time=1)).time == (2.5, "second")
    assert read_volume(str(tmp_path / "v.zarr"), ReadOptions(component=1)).time == (2.5, "second")


def test_milliseconds_are_no_lengths() -> None:
    assert [metres(unit) for unit in ("ms", "MS", "meters", "Microns", "mms")] == [None, None, 1.0, 1e-6, 1e-3]


def test_units_that_are_not_known_are_said(tmp_path: Path) -> None:
    axes = {"x": X, "y": Y, "z": Z}
    with netCDF4.Dataset(tmp_path / "v.nc", "w") as file:
        for name, centres in axes.items():
            file.createDimension(name, len(centres))
            file.createVariable(name, "f8", (name,))[:] = centres
            file[name].units = "parsec"
        file.createVariable("t", "f4", ("z", "y", "x"))[:] = ramp(X, Y, Z)
    with pytest.warns(UserWarning, match="unit 'parsec' is not a known unit of length; numbers are kept"):
        check_grid(read_volume(str(tmp_path / "v.nc")))


def test_a_sheet_is_as_thick_as_its_pixels_are_wide() -> None:
    values = np.arange(30, dtype=np.float32).reshape(5, 1, 6)
    at = {"z": 1000.0 * np.arange(5), "y": [3.0], "x": 1000.0 * np.arange(6)}
    sheet = xarray.DataArray(values, dims=("z", "y", "x"), coords=at)
    assert vvgt.read_volume(sheet).spacing == (1000.0, 1000.0, 1000.0)
