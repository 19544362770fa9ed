"""Gaussians and the standard `.ply`."""

from vvgt_cli.gaussians.header import PlyHeader
from vvgt_cli.gaussians.ply import PlyOptions, as_ply, as_stored, describe, in_unit_frame, read_ply, write_ply
from vvgt_cli.gaussians.types import SH_C0, Gaussians

__all__ = ["SH_C0", "Gaussians", "PlyHeader", "PlyOptions", "as_ply", "as_stored"]
__all__ += ["describe", "in_unit_frame", "read_ply", "write_ply"]
