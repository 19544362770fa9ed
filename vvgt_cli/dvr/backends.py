"""One switch over the programs that can render a `Scene`: the numba kernel, torch on CUDA, VTK."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.dvr.render import RenderSettings, render_view
from vvgt_cli.dvr.scene import Scene
from vvgt_cli.errors import UsageError

RENDERERS = ("cpu", "cuda", "vtk")


def view_renderer(
    renderer: str, scene: Scene, settings: RenderSettings | None = None
) -> Callable[[Camera], np.ndarray]:
    """Return a function from a camera to its view, (height, width, 4) float32, premultiplied RGBA over nothing.

    What a renderer prepares once a scene (uploads, pipelines) is prepared here, so views can be asked for one by one.

    Args:
        renderer: ``cpu`` (the numba kernel), ``cuda`` (torch, the same definition) or ``vtk`` (VTK's own picture).
        scene: the volume under its function, and its light: ``cuda`` knows of none, ``vtk`` of none that is attenuated.
        settings: step and rays a pixel; VTK takes the step and shoots one ray a pixel.

    Raises:
        UsageError: an unknown renderer, a light that it does not know, a package that is not installed.
        DataError: no CUDA device, or no off-screen OpenGL, on this machine.
    """
    settings = settings or RenderSettings()
    if renderer not in RENDERERS:
        raise UsageError(f"renderer {renderer!r}; expected one of {', '.join(RENDERERS)}")
    if scene.grid is not None and renderer != "cpu":
        raise UsageError(f"the {renderer} renderer draws one volume under a function; of {scene.tf.name} try cpu")
    if scene.light is not None and renderer == "cuda":
        raise UsageError("the cuda renderer has no lighting; use the cpu renderer, or --light none")
    if scene.light is not None and renderer == "vtk" and (scene.light.shadows or scene.light.occlusion):
        raise UsageError("the vtk renderer has neither our shadows nor our ambient occlusion; use the cpu renderer")
    if renderer == "cpu":
        return lambda camera: render_view(scene, camera, settings)
    if renderer == "cuda":
        from vvgt_cli.dvr import cuda

        return cuda.view_renderer(scene, settings)
    from vvgt_cli.dvr import vtk

    return vtk.view_renderer(scene, settings)
