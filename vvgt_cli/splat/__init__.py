"""EWA splatting."""

from vvgt_cli.splat.reference import render_reference
from vvgt_cli.splat.render import Projection, blend, gather, project, render

__all__ = ["Projection", "blend", "gather", "project", "render", "render_reference"]
