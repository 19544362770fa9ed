"""The rows of benchmarks/readers.py: what writes a file of each format, and what reads it without vvgt."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from readers import LPS, ORIGIN, SPACING, Row, world
from readers_layouts import LAYOUTS
from readers_simulations import SIMULATIONS
from readers_vtk import by_vtk, hexahedra, vtk_class, vtk_image, write_vtk

BOHR = 0.529177210903  # angstroms


def _nibabel(kind: str, name: str) -> Any:
    def write(folder: Path, values: np.ndarray) -> Path:
        import nibabel

        image = getattr(nibabel, kind)(values.T, world())
        if hasattr(image.header, "set_xyzt_units"):
            image.header.set_xyzt_units("mm")
        nibabel.save(image, folder / name)
        return folder / name

    return write


def _by_nibabel(path: Path) -> Any:
    import nibabel

    return np.asanyarray(nibabel.load(path).dataobj)


def _itk(name: str, packed: bool = False) -> Any:
    def write(folder: Path, values: np.ndarray) -> Path:
        import SimpleITK

        image = SimpleITK.GetImageFromArray(values)
        image.SetSpacing(SPACING)
        image.SetOrigin(ORIGIN)
        SimpleITK.WriteImage(image, str(folder / name), packed)
        return folder / name

    return write


def _by_itk(path: Path) -> Any:
    import SimpleITK

    return SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(path)))


def _vtk(writer: str, name: str, *settings: str, mesh: bool = False) -> Any:
    """By a writer of VTK, ``MODULE.CLASS``; of cells of six faces where it is a ``mesh``."""

    def write(folder: Path, values: np.ndarray) -> Path:
        made = vtk_class(writer)
        for setting in settings:
            getattr(made, setting)()
        if hasattr(made, "SetEndPiece"):
            made.SetNumberOfPieces(4)
            made.SetEndPiece(3)
        return write_vtk(made, hexahedra(values) if mesh else vtk_image(values), folder / name)

    return write


def _mrc(folder: Path, values: np.ndarray) -> Path:
    import mrcfile

    path = folder / "v.mrc"
    with mrcfile.new(path, values) as file:
        file.voxel_size = SPACING
        file.header.origin = ORIGIN
    return path


def _by_mrcfile(path: Path) -> Any:
    import mrcfile

    with mrcfile.open(path) as file:
        return np.array(file.data)


def _h5(folder: Path, values: np.ndarray, packed: bool = True) -> Path:
    import h5py

    with h5py.File(folder / "v.h5", "w") as file:
        more = {"chunks": (64, 64, 64), "compression": "gzip", "compression_opts": 1} if packed else {}
        shape = values.shape
        chunks = tuple(min(64, n) for n in shape)
        data = file.create_dataset("values", data=values, **(more | ({"chunks": chunks} if packed else {})))
        for axis, name in enumerate("zyx"):
            file[name] = ORIGIN[2 - axis] + SPACING[2 - axis] * np.arange(shape[axis])
            file[name].make_scale(name)
            data.dims[axis].attach_scale(file[name])
    return folder / "v.h5"


def _by_h5py(name: str) -> Any:
    def read(path: Path) -> Any:
        import h5py

        with h5py.File(path) as file:
            return file[name][()]

    return read


def _array(values: np.ndarray) -> Any:
    import xarray

    axes = {n: ("xyz".index(n), values.shape["zyx".index(n)]) for n in "zyx"}
    places = {n: (n, ORIGIN[k] + SPACING[k] * np.arange(size), {"units": "mm"}) for n, (k, size) in axes.items()}
    return xarray.DataArray(values, dims=("z", "y", "x"), coords=places, name="values").to_dataset()


def _nc(folder: Path, values: np.ndarray) -> Path:
    _array(values).to_netcdf(folder / "v.nc", encoding={"values": {"zlib": True, "complevel": 1}})
    return folder / "v.nc"


def _zarr(folder: Path, values: np.ndarray) -> Path:
    edge = tuple(min(64, n) for n in values.shape)
    _array(values).to_zarr(folder / "v.zarr", encoding={"values": {"chunks": edge}}, zarr_format=2)
    return folder / "v.zarr"


def _by_xarray(path: Path) -> Any:
    import xarray

    opened = xarray.open_zarr(path, chunks=None) if path.is_dir() else xarray.open_dataset(path)
    with opened as found:
        return found["values"].values


def _ome(folder: Path, values: np.ndarray) -> Path:
    import tifffile

    sizes = {f"PhysicalSize{a}": s for a, s in zip("XYZ", SPACING, strict=True)}
    tifffile.imwrite(folder / "v.ome.tif", values, ome=True, metadata={"axes": "ZYX", **sizes}, compression="zlib")
    return folder / "v.ome.tif"


def _by_tifffile(path: Path) -> Any:
    import tifffile

    return tifffile.imread(path)


def _npy(folder: Path, values: np.ndarray) -> Path:
    np.save(folder / "v.npy", values)
    return folder / "v.npy"


def _czi(folder: Path, values: np.ndarray) -> Path:
    from pylibCZIrw import czi

    path = folder / "v.czi"
    with czi.create_czi(str(path), compression_options="zstd1:ExplicitLevel=1") as file:
        for z, plane in enumerate(values.astype(np.uint16)):
            file.write(np.ascontiguousarray(plane[..., None]), plane={"T": 0, "C": 0, "Z": z})
        x, y, z = (s * 1e-6 for s in SPACING)
        file.write_metadata("v", scale_x=x, scale_y=y, scale_z=z)
    return path


def _by_libczi(path: Path) -> Any:
    from pylibCZIrw import czi

    with czi.open_czi(str(path)) as file:
        lo, hi = file.total_bounding_box["Z"]
        return np.stack([file.read(plane={"T": 0, "C": 0, "Z": z})[..., 0] for z in range(lo, hi)])


def _cube(folder: Path, values: np.ndarray) -> Path:
    """As Gaussian writes: bohr, z fastest."""
    steps = [[SPACING[k] / BOHR if k == j else 0.0 for j in range(3)] for k in range(3)]
    head = ["a field", "by numpy", " 0 " + " ".join(f"{o / BOHR:.9f}" for o in ORIGIN)]
    head += [f" {n} " + " ".join(f"{v:.9f}" for v in row) for n, row in zip(values.shape[::-1], steps, strict=True)]
    with open(folder / "v.cube", "w") as file:
        file.write("\n".join(head) + "\n")
        np.savetxt(file, values.T.reshape(-1, 1), fmt="%12.5E")
    return folder / "v.cube"


def _dx(folder: Path, values: np.ndarray) -> Path:
    """As APBS writes."""
    x, y, z = values.shape[::-1]
    head = f"object 1 class gridpositions counts {x} {y} {z}\norigin {' '.join(map(str, ORIGIN))}\n"
    head += "".join(f"delta {' '.join(str(SPACING[k] if k == j else 0.0) for j in range(3))}\n" for k in range(3))
    head += f"object 2 class gridconnections counts {x} {y} {z}\n"
    head += f"object 3 class array type double rank 0 items {values.size} data follows\n"
    with open(folder / "v.dx", "w") as file:
        file.write(head)
        np.savetxt(file, values.T.reshape(-1, 1), fmt="%.6e")
        file.write('attribute "dep" string "positions"\n')
    return folder / "v.dx"


def _by_numpy(skip: int) -> Any:
    return lambda path: np.loadtxt(path, skiprows=skip, comments=["attribute", "#"])


def _dicom(folder: Path, values: np.ndarray) -> Path:
    from tests.anatomy import dicom

    return dicom(folder / "slices", values, world())


def _by_pydicom(path: Path) -> Any:
    import pydicom

    return [pydicom.dcmread(file).pixel_array for file in sorted(path.iterdir())]


IMAGE = "vtkIOXML.vtkXMLImageData"
AT_0 = (0.0, 0.0, 0.0)
ROWS = (
    Row("NIfTI `.nii`", "nibabel", "NIfTI", _nibabel("Nifti1Image", "v.nii"), _by_nibabel),
    Row("NIfTI `.nii.gz`", "nibabel", "NIfTI", _nibabel("Nifti1Image", "v.nii.gz"), _by_nibabel),
    Row("MGH `.mgz`", "nibabel", "MGH", _nibabel("MGHImage", "v.mgz"), _by_nibabel),
    Row("Analyze `.img`", "nibabel", "Analyze", _nibabel("AnalyzeImage", "v.img"), _by_nibabel, placed=False),
    Row("NRRD, gzip", "SimpleITK", "NRRD", _itk("v.nrrd", True), _by_itk, LPS),
    Row("MetaImage `.mha`", "SimpleITK", "MetaImage", _itk("v.mha"), _by_itk, LPS),
    Row("DICOM", "pydicom", "DICOM", _dicom, _by_pydicom),
    Row("MRC `.mrc`", "mrcfile", "MRC", _mrc, _by_mrcfile),
    Row("`.cube`", "numpy", "Gaussian cube", _cube, _by_numpy(6), most=128),
    Row("OpenDX `.dx`", "numpy", "OpenDX", _dx, _by_numpy(7), most=128),
    Row(
        "`.vti`, raw", "VTK", "VTK XML",
        _vtk(f"{IMAGE}Writer", "v.vti", "EncodeAppendedDataOff", "SetCompressorTypeToNone"),
        by_vtk(f"{IMAGE}Reader"),
    ),
    Row("`.vti`, zlib", "VTK", "VTK XML", _vtk(f"{IMAGE}Writer", "v.vti"), by_vtk(f"{IMAGE}Reader")),
    Row(
        "`.pvti`, zlib", "VTK", "parallel VTK image", _vtk("vtkIOParallelXML.vtkXMLPImageDataWriter", "v.pvti"),
        by_vtk("vtkIOXML.vtkXMLPImageDataReader"),
    ),
    Row(
        "legacy `.vtk`", "VTK", "legacy VTK",
        _vtk("vtkIOLegacy.vtkDataSetWriter", "v.vtk", "SetFileTypeToBinary"), by_vtk("vtkIOLegacy.vtkDataSetReader"),
    ),
    Row("VTKHDF image", "VTK", "VTKHDF", _vtk("vtkIOHDF.vtkHDFWriter", "v.vtkhdf"), by_vtk("vtkIOHDF.vtkHDFReader")),
    Row(
        "`.vtu`", "VTK", "VTK grid", _vtk("vtkIOXML.vtkXMLUnstructuredGridWriter", "v.vtu", mesh=True),
        by_vtk("vtkIOXML.vtkXMLUnstructuredGridReader"), most=64,
    ),
    Row(
        "Exodus II", "VTK", "Exodus", _vtk("vtkIOIOSS.vtkIOSSWriter", "v.exo", mesh=True),
        by_vtk("vtkIOExodus.vtkExodusIIReader"), most=64,
    ),
    Row("HDF5, gzip", "h5py", "HDF5", _h5, _by_h5py("values")),
    Row("NetCDF 4, zlib", "xarray, netCDF4", "NetCDF", _nc, _by_xarray),
    Row("Zarr 2", "xarray, zarr", "Zarr", _zarr, _by_xarray),
    Row("OME-TIFF, deflate", "tifffile", "TIFF", _ome, _by_tifffile, origin=AT_0),
    Row("`.npy`", "numpy", "NumPy", _npy, np.load, placed=False),
    Row("CZI, Zstandard", "libCZI", "CZI", _czi, _by_libczi, origin=AT_0),
    *LAYOUTS,
    *SIMULATIONS,
)  # fmt: skip
