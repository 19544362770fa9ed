"""Formats of arrays with named axes: HDF5, NetCDF, GRIB, Zarr, N5 and NumPy."""

from __future__ import annotations

from vvgt_cli.volume.readers import HDF5, Reader, lazy

MAX_CHUNK = 1 << 31  # bytes of one chunk, decompressed
_OTHERS = (b"VTKHDF", b"_NCProperties", b"minc-2.0")  # what tells formats that are HDF5 files, too
_ALL = ("array", "time", "dims")


def is_hdf5(head: bytes) -> bool:
    """Tell whether a file begins as HDF5 does, and as no other format that is HDF5."""
    return HDF5 in (head[:8], head[512:520]) and not any(other in head for other in _OTHERS)


def is_netcdf(head: bytes) -> bool:
    """Tell whether a file begins as NetCDF does, classic or version 4, and is no Exodus file."""
    classic = head[:4] in (b"CDF\x01", b"CDF\x02", b"CDF\x05") and b"floating_point_word_size" not in head
    return classic or (head.startswith(HDF5) and b"_NCProperties" in head)


def is_zipped_zarr(head: bytes) -> bool:
    """Tell whether a zip file begins with the metadata of a Zarr store."""
    return head[:4] == b"PK\3\4" and any(name in head for name in (b".zgroup", b".zarray", b"zarr.json"))


FORMATS = (
    Reader(
        "HDF5", (".h5", ".hdf5", ".he5", ".hdf", ".ims"), lazy("arrays.hdf5.read_hdf5"), is_hdf5, _ALL,
        levels=True,
    ),
    Reader("NetCDF", (".nc", ".nc4", ".cdf"), lazy("arrays.netcdf.read_netcdf"), is_netcdf, _ALL, within=("HDF5",)),
    Reader(
        "Zarr", (".zarr",), lazy("arrays.zarr.read_zarr"), takes=_ALL, holds=lazy("arrays.zarr.holds_zarr"), whole=True,
        levels=True,
    ),
    Reader(
        "N5", (".n5",), lazy("arrays.n5.read_n5"), takes=_ALL, holds=lazy("arrays.n5.holds_n5"), whole=True,
        levels=True,
    ),
    Reader("NumPy", (".npy",), lazy("arrays.npy.read_npy"), lambda head: head.startswith(b"\x93NUMPY"), ("time",)),
    Reader(
        "NumPy archive", (".npz",), lazy("arrays.npy.read_npz"),
        lambda head: head.startswith(b"PK\x03\x04") and b".npy" in head[:512], ("array", "time"),
    ),
    Reader(
        "zipped Zarr", (".zarr.zip", ".ozx"), lazy("arrays.remote.read_zipped"), is_zipped_zarr, _ALL, by_name=True,
        levels=True,
    ),
    Reader(
        "GRIB", (".grib", ".grib1", ".grib2", ".grb", ".grb1", ".grb2"), lazy("vtk.child.volume_by_child", "GRIB"),
        lambda head: b"GRIB" in head[:64], _ALL,
    ),
)  # fmt: skip
