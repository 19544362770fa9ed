"""Volumes and their readers."""

from vvgt_cli.volume import (  # noqa: F401  each registers its formats
    amira,
    analyze,
    dicom,
    examples,
    grid_text,
    hdf5,
    inviwo,
    leica,
    metaimage,
    mgh,
    minc,
    mrc,
    n5,
    netcdf,
    nibabel_pairs,
    nifti,
    nikon,
    nrrd,
    numpy_file,
    openvdb,
    raw,
    remote,
    slc,
    slices,
    tiff,
    vtk_family,
    vtk_legacy,
    vtk_pieces,
    vtk_xml,
    vtkjs,
    zarr_store,
    zarr_zip,
    zeiss,
)
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.registry import read_volume
from vvgt_cli.volume.stats import Statistics, slabs, statistics
from vvgt_cli.volume.types import UnitFrame, Volume

__all__ = ["ReadOptions", "Statistics", "UnitFrame", "Volume", "read_volume", "slabs", "statistics"]
