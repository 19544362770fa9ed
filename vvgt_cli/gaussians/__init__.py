"""Gaussians and the standard .ply."""

from vvgt_cli.gaussians.types import SH_C0, Gaussians

__all__ = ["SH_C0", "Gaussians"]
