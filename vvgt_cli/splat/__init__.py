"""EWA splatting."""

from vvgt_cli.splat.render import Projection, blend, gather, project, render
from vvgt_cli.splat.reference import render_reference

__all__ = ["Projection", "blend", "gather", "project", "render", "render_reference"]
