"""Direct volume rendering."""

from vvgt_cli.dvr.reference import render_view_reference
from vvgt_cli.dvr.render import REFERENCE, RenderSettings, render_view, render_views
from vvgt_cli.dvr.scene import Scene

__all__ = ["REFERENCE", "RenderSettings", "Scene", "render_view", "render_view_reference", "render_views"]
