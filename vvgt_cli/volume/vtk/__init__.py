"""VTK's own formats, files of simulation programs that VTK reads, and vtk.js folders.

Images are read here, in blocks where the file allows it. Meshes, indexes of several files and files of other programs
are read by VTK in a process of its own (`child`), since its readers trust their files.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from vvgt_cli.volume.headers import MARK
from vvgt_cli.volume.readers import HDF5, Reader, lazy

INDEX, SINGLE, IMAGE = "index", "single", "image"  # what `child` reads beside programs' files: VTK's own
GRIDS = ("UnstructuredGrid", "RectilinearGrid", "StructuredGrid")
LEGACY_GRIDS = ("UNSTRUCTURED_GRID", "RECTILINEAR_GRID", "STRUCTURED_GRID")
INDEXES = (
    *("PImageData", "PUnstructuredGrid", "PRectilinearGrid", "PStructuredGrid", "Collection", "vtkMultiBlockDataSet"),
    *("vtkMultiGroupDataSet", "vtkPartitionedDataSet", "vtkPartitionedDataSetCollection", "vtkOverlappingAMR"),
    *("vtkNonOverlappingAMR", "vtkHierarchicalBoxDataSet", "vtkUniformGridAMR"),
)
_XML = rb"(?:\xef\xbb\xbf)?\s*(?:<\?xml[^>]*>\s*)?(?:<!--.*?-->\s*)*"


def xml_kind(head: bytes) -> str | None:
    """Return the type of dataset that a VTK XML file begins with ("" where it says none), None of any other file."""
    if re.match(_XML + rb"<VTKFile\s", head, re.DOTALL) is None:
        return None
    kind = re.search(rb'<VTKFile\s[^>]*?type\s*=\s*["\'](\w+)["\']', head)
    return "" if kind is None else kind[1].decode()


def is_xml_image(head: bytes) -> bool:
    """Tell whether a VTK XML file is an image, or what no other reader takes."""
    kind = xml_kind(head)
    return kind is not None and kind not in (*GRIDS, *INDEXES)


def is_index(head: bytes) -> bool:
    """Tell whether a file begins as an index of datasets; one of the pieces of an image has its own reader."""
    if head.removeprefix(MARK).lstrip().startswith(b"{"):
        return b'"file-series-version"' in head
    kind = xml_kind(head)
    return kind in INDEXES and kind != "PImageData"


def is_legacy(head: bytes, grid: bool) -> bool:
    """Tell whether a file begins as a legacy VTK file of a mesh or grid (`LEGACY_GRIDS`), or of anything else."""
    kind = re.search(rb"\n\s*DATASET\s+(\w+)", head[:1024], re.IGNORECASE)
    is_grid = kind is not None and kind[1].decode().upper() in LEGACY_GRIDS
    return head[:64].lower().startswith(b"# vtk datafile version") and is_grid == grid


def is_cgns(head: bytes) -> bool:
    """Tell whether a file begins as CGNS does, in HDF5 or ADF."""
    return (head.startswith(HDF5) and b"CGNSLibraryVersion" in head) or head[4:32].startswith(b"ADF Database")


def is_ensight(head: bytes) -> bool:
    """Tell whether a file begins as a case of EnSight does."""
    return re.search(rb"^\s*FORMAT\s*$(?:\s*#.*$)*\s*type:\s*ensight", head, re.MULTILINE) is not None


def is_xdmf(head: bytes) -> bool:
    """Tell whether a file begins as XDMF does."""
    return re.match(_XML + rb"(?:<Xdmf[\s>]|<!DOCTYPE\s+Xdmf\s)", head, re.DOTALL) is not None


def _by_vtk(
    name: str, suffixes: tuple[str, ...], sniff: Callable[[bytes], bool] | None, program: str = "", read: str = "",
    takes: tuple[str, ...] = ("array", "time", "dims"), within: tuple[str, ...] = (),
) -> Reader:  # fmt: skip
    """Make the row of a format that VTK reads as ``program``, by default its name; ``read`` may be tried before."""
    program = program or name
    return Reader(
        name, suffixes, lazy(read) if read else lazy("vtk.child.volume_by_child", program), sniff, takes,
        within=within, contents=lazy("vtk.child.contents_by_child", program),
    )  # fmt: skip


FORMATS = (
    Reader("VTK XML", (".vti",), lazy("vtk.xml.read_vti"), is_xml_image, ("array",)),
    Reader("legacy VTK", (".vtk",), lazy("vtk.legacy.read_legacy"), lambda head: is_legacy(head, False), ("array",)),
    _by_vtk(
        "VTK index", (".pvtu", ".pvtr", ".pvts", ".vtm", ".vtmb", ".vtpd", ".vtpc", ".vth", ".vthb", ".pvd", ".series"),
        is_index, INDEX, "vtk.child.read_indexed",
    ),
    _by_vtk(
        "VTKHDF", (".vtkhdf",), lambda head: head.startswith(HDF5) and b"VTKHDF" in head, read="vtk.hdf.read_vtkhdf"
    ),
    _by_vtk("EnSight", (".case", ".encas"), is_ensight),
    _by_vtk(
        "Exodus", (".e", ".ex2", ".exo", ".exii", ".g"),
        lambda head: head.startswith(b"CDF") and b"floating_point_word_size" in head, within=("NetCDF", "HDF5"),
    ),
    _by_vtk("OpenFOAM", (".foam",), None),
    _by_vtk("XDMF", (".xdmf", ".xmf", ".xdmf2", ".xdmf3"), is_xdmf),
    _by_vtk("CGNS", (".cgns",), is_cgns, within=("HDF5",)),
    _by_vtk("Plot3D", (".p3d", ".xyz"), None),
    _by_vtk(
        "VTK grid", (".vtu", ".vtr", ".vts"), lambda head: xml_kind(head) in GRIDS, SINGLE, takes=("array", "dims")
    ),
    _by_vtk("legacy VTK grid", (), lambda head: is_legacy(head, True), SINGLE, takes=("array", "dims")),
    Reader(
        "parallel VTK image", (".pvti",), lazy("vtk.pieces.read_pvti"), lambda head: xml_kind(head) == "PImageData",
        ("array",), contents=lazy("vtk.pieces.contents_of"),
    ),
    Reader("vtk.js", (), lazy("vtk.json.read_vtkjs"), takes=("array",), holds=lazy("vtk.json.holds_vtkjs"), whole=True),
)  # fmt: skip
