"""One switch over the programs that can render a `Scene`: our own ray caster, VTK."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.dvr.render import RenderSettings, render_view
from vvgt_cli.dvr.scene import Scene
from vvgt_cli.errors import UsageError

RENDERERS = ("vvgt", "vtk")


def view_renderer(
    renderer: str, scene: Scene, settings: RenderSettings | None = None
) -> Callable[[Camera], np.ndarray]:
    """Return a function from a camera to its view, (height, width, 4) float32, premultiplied RGBA over nothing.

    What a renderer prepares once a scene (uploads, pipelines) is prepared here, so views can be asked for one by one.

    Args:
        renderer: ``vvgt`` (on the scene's device) or ``vtk`` (VTK's own picture).
        scene: the volume under its function, and its light: ``vtk`` knows of no sky.
        settings: step and rays a pixel; VTK takes the step and shoots one ray a pixel.

    Raises:
        UsageError: an unknown renderer, a light that it does not know, a package that is not installed.
        DataError: no off-screen OpenGL on this machine.
    """
    settings = settings or RenderSettings()
    if renderer not in RENDERERS:
        raise UsageError(f"renderer {renderer!r}; expected one of {', '.join(RENDERERS)}")
    if renderer == "vvgt":
        return lambda camera: render_view(scene, camera, settings)
    if scene.grid is not None:
        raise UsageError(f"the vtk renderer draws one volume under a function; of {scene.tf.name} try vvgt")
    if scene.light is not None and scene.light.traced:
        raise UsageError("the vtk renderer has no skies; use the vvgt renderer")
    from vvgt_cli.dvr import vtk

    return vtk.view_renderer(scene, settings)
