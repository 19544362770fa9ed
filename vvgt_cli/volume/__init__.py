"""Volumes and their readers: a folder a family of formats, and what all of them share beside it.

In every folder ``__init__`` is the table of its formats (`readers.Reader`).
"""

from vvgt_cli.volume import arrays, dicom, examples, maps, medical, microscopy, openvdb, plain, readers, tiff, vtk
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.registry import read_volume
from vvgt_cli.volume.stats import BINS, Statistics, check_range, edges_of, integer_statistics, slabs, statistics
from vvgt_cli.volume.types import DENSITY, UnitFrame, Volume, triple

readers.register_scheme("example", examples.open_example)
for _scheme in ("http", "https"):
    readers.register_scheme(_scheme, readers.lazy("arrays.remote.read_scheme", _scheme), times=True)
for _family in (medical, dicom, maps, plain, microscopy, arrays, openvdb, tiff, vtk):
    readers.register(*_family.FORMATS)

__all__ = ["BINS", "DENSITY", "ReadOptions", "Statistics", "UnitFrame", "Volume", "check_range", "edges_of"]
__all__ += ["integer_statistics", "read_volume", "slabs", "statistics", "triple"]
