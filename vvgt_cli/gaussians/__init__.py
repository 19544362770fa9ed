"""Gaussians and the standard `.ply`."""

from vvgt_cli.gaussians.constants import DILATION, MAX_ALPHA, MIN_ALPHA, NEAR, TILE
from vvgt_cli.gaussians.header import PlyHeader
from vvgt_cli.gaussians.ply import PlyOptions, as_ply, as_stored, describe, in_unit_frame, read_ply, write_ply
from vvgt_cli.gaussians.rules import INRIA, Rule, rule_of
from vvgt_cli.gaussians.types import SH_C0, Gaussians, concatenate

__all__ = ["DILATION", "INRIA", "MAX_ALPHA", "MIN_ALPHA", "NEAR", "SH_C0", "TILE", "Gaussians", "PlyHeader"]
__all__ += ["PlyOptions", "Rule", "as_ply", "as_stored", "concatenate", "describe", "in_unit_frame", "read_ply"]
__all__ += ["rule_of", "write_ply"]
