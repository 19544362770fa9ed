"""Formats that are known and not read, with a way out of each."""

from __future__ import annotations

import re
from pathlib import Path

_MAT = (
    "in Python: numpy.save('{stem}.npy', scipy.io.loadmat('{name}')['VARIABLE']); in MATLAB: save -v7.3, which is HDF5"
)
_BIO = "convert it with Bio-Formats: bfconvert '{name}' '{stem}.ome.tiff'"
_VIEW = "open it in ParaView and save it as .vtu or .vtm"

# how the file begins ("": its name decides), how its name ends, what it is, what to do
ROWS = (
    (rb"ply\r?\n", "", "a .ply (Gaussians, points or a mesh)", "give the volume that it was made from (see also "
     "'vvgt info', 'vvgt render' and 'vvgt evaluate {name} --volume VOLUME')"),
    (rb"NanoVDB", "", "NanoVDB, which is laid out for GPUs", "nanovdb_convert {name} {stem}.vdb (comes with OpenVDB)"),
    (rb"7z\xbc\xaf|\xfd7zXZ|\x28\xb5\x2f\xfd|Rar!", "", "an archive or packed", "unpack it first"),
    (rb"SIMPLE  =", "", "FITS", "in Python: numpy.save('{stem}.npy', astropy.io.fits.getdata('{name}'))"),
    (rb"MATLAB 5", "", "a MATLAB file before version 7.3", _MAT),
    (rb"\x0e\x03\x13\x01", "", "HDF4", "h4toh5convert '{name}' '{stem}.h5' (HDF Group's h4h5tools)"),
    (rb"EHFA_HEADER_TAG", "", "an ERDAS image", "gdal_translate -of netCDF '{name}' '{stem}.nc'"),
    (rb"MATRIX7\dv", "", "ECAT 7", "in Python: nibabel.save(nibabel.Nifti1Image.from_image(nibabel.load('{name}')), "
     "'{stem}.nii')"),
    (rb"# AVS", "", "an AVS field", "state what its header says: --dims X Y Z --dtype TYPE --header-bytes N"),
    (rb"ncaa", r"\.vff", "VFF", "3D Slicer with SlicerRT opens it; save it as .nrrd"),
    (rb"#!SZPLT", "", "Tecplot's SZL", "save it as .plt in Tecplot, and that with ParaView as .vtu"),
    (rb"#!TDV|\(0 \"", "", "a Tecplot or Fluent file", _VIEW),
    (b"", r"\.(plt|tec|cas|d3plot)(\.gz)?|d3plot", "a file of a simulation program", _VIEW),
    (b"", r"\.(msh|inp|bdf|med|su2)", "a mesh", "meshio convert '{name}' '{stem}.vtu'"),
    (b"", r"\.(stl|obj|off|gltf|glb|3mf)", "a surface, with no values inside", "give the volume that it was made from"),
    (b"", r"\.(oib|oif|vsi|scn|dv|r3d|ics|ids|sld|lsm|zvi|mvd2)", "a microscope's file", _BIO),
    (b"", r"\.(txm|txrm|xrm)", "Zeiss Xradia", "export it as TIFF, or in Python: dxchange.read_txrm('{name}')"),
    (b"", r"\.dm[34]", "Gatan DigitalMicrograph", "dm2mrc '{name}' '{stem}.mrc' (IMOD)"),
    (b"", r"\.(em|spi|hed)", "EM, SPIDER or IMAGIC", "e2proc3d.py '{name}' '{stem}.mrc' (EMAN2)"),
    (b"", r"\.(dsn6|brix|omap|xplor|cns)", "an electron density", "open it in ChimeraX and: save '{stem}.mrc'"),
    (b"", r"(^|[/\\])2dseq", "Bruker ParaVision", "brkraw tonii STUDY, or Bru2Nii, make NIfTI of the study's folder"),
    (b"", r"(^|[/\\])(fid|ser)", "signals of a scanner before reconstruction", "give the reconstructed images"),
    (b"", r"\.(vol|vgi|pca|xtekct)", "a CT scanner's raw values or their description", "read the raw file with "
     "--dims X Y Z --dtype TYPE --spacing X Y Z as the text file beside it states them"),
)  # fmt: skip


def way_out(path: Path, head: bytes, by_name: bool) -> str | None:
    """Return what a file is and what to do with it, None where that is not known.

    Args:
        path: the file.
        head: its first bytes.
        by_name: its name may decide, too.
    """
    for begins, ends, what, way in ROWS:
        if not re.match(begins, head) or not (begins or by_name) or not re.search(f"(?:{ends})$", path.name, re.I):
            continue
        return f"{what}; expected a format that is read: {way.format(name=path.name, stem=path.stem)}"
    return None
