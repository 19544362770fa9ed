"""Direct volume rendering."""

from vvgt_cli.dvr.reference import render_view_reference
from vvgt_cli.dvr.render import FIT_VIEWS, REFERENCE, BoxFrame, RenderSettings, Viewed, render_view, render_views
from vvgt_cli.dvr.scene import PreparedVolume, Scene

__all__ = ["FIT_VIEWS", "REFERENCE", "BoxFrame", "PreparedVolume", "RenderSettings", "Scene", "Viewed", "render_view"]
__all__ += ["render_view_reference", "render_views"]
