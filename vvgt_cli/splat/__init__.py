"""EWA splatting."""

from vvgt_cli.splat.reference import gather_reference, render_reference
from vvgt_cli.splat.render import Projection, blend, gather, project, render

__all__ = ["Projection", "blend", "gather", "gather_reference", "project", "render", "render_reference"]
