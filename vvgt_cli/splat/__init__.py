"""EWA splatting, with gradients."""

from vvgt_cli.splat.reference import render_reference
from vvgt_cli.splat.render import Gradients, Projection, blend, gather, project, render, render_backward

__all__ = ["Gradients", "Projection", "blend", "gather", "project", "render", "render_backward", "render_reference"]
