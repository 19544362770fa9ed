"""VTK's GPU volume mapper, off screen: for those who want VTK's picture, lit or not.

Classification after sampling, front to back, 8 bits a channel (`vtkGPUVolumeRayCastMapper`). VTK's frame buffer holds
premultiplied colour and alpha over a transparent background, so alpha is read from it and nothing is divided.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.dvr.render import RenderSettings
from vvgt_cli.dvr.scene import Scene
from vvgt_cli.errors import DataError, UsageError

NODES = 4096  # of the functions handed to VTK: it tabulates them anyway
REFLECTED = 0.25  # of the power: of the angle to the reflected ray, twice that to the half vector
NEAR = 1e-3  # unit-frame lengths: an eye inside the volume sees what is around it
EYE_NORMALS = (  # in the fragment shader: VTK's own, and without the box's extents along the screen's axes
    "in_textureToEye[0] * vec4(shading_gradient.xyz, 0.0)",
    "in_modelViewMatrix * in_volumeMatrix[0] * vec4(shading_gradient.xyz, 0.0)",
)
MODULES = ("vtkRenderingOpenGL2", "vtkRenderingVolumeOpenGL2")  # their import registers what the classes below become
PROBE = (
    "import vtkmodules.vtkRenderingOpenGL2\n"
    "from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow\n"
    "w = vtkRenderWindow(); w.SetOffScreenRendering(1); w.SetSize(8, 8); w.AddRenderer(vtkRenderer()); w.Render()\n"
    "raise SystemExit(0 if w.SupportsOpenGL() else 3)\n"
)


def require_opengl() -> None:
    """Check an off-screen window in another process, because VTK ends the process where it finds no OpenGL.

    Raises:
        DataError: there is none.
    """
    done = subprocess.run([sys.executable, "-c", PROBE], stdin=subprocess.DEVNULL, capture_output=True)
    if done.returncode:
        raise DataError(
            "the vtk renderer found no off-screen OpenGL; install EGL or OSMesa "
            "(Debian: libegl1 and libgl1-mesa-dri, or libosmesa6), or use the vvgt renderer"
        )


def view_renderer(
    scene: Scene, settings: RenderSettings | None = None, mended: bool = False
) -> Callable[[Camera], np.ndarray]:
    """Return a function from a camera to VTK's view, (height, width, 4) float32, premultiplied in steps of 1/255.

    One ray a pixel at ``settings.step`` voxels of the mean edge. The volume is padded by its edge voxels and cropped to
    the box, because VTK's own bounds end at the outermost voxel centres. ``mended`` turns normals to the eye without
    stretching them, which VTK does under lights from directions where the box is no cube (docs/light.md).

    Raises:
        UsageError: the scene is a label map, layers or colours, or under a sky.
        DataError: no off-screen OpenGL here.
    """
    import importlib

    if scene.grid is not None:
        raise UsageError(f"the vtk renderer draws one volume under a function; of {scene.tf.name} try vvgt")
    if scene.light is not None and scene.light.traced:
        raise UsageError("the vtk renderer has no skies; use the vvgt renderer")
    settings = settings or RenderSettings()
    require_opengl()
    for name in MODULES:
        importlib.import_module(f"vtkmodules.{name}")
    from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow, vtkVolume
    from vtkmodules.vtkRenderingVolume import vtkGPUVolumeRayCastMapper

    mapper: Any = vtkGPUVolumeRayCastMapper()
    mapper.SetInputData(image_data(scene, padded=True))
    mapper.SetAutoAdjustSampleDistances(False)
    mapper.SetSampleDistance(settings.step * float(scene.step.mean()))
    mapper.SetBlendModeToComposite()
    mapper.SetCropping(True)
    mapper.SetCroppingRegionFlagsToSubVolume()
    mapper.SetCroppingRegionPlanes(*(side * h for h in _cropped(scene) for side in (-1, 1)))
    volume = vtkVolume()
    volume.SetMapper(mapper)
    volume.SetProperty(volume_property(scene))
    if mended:
        volume.GetShaderProperty().AddFragmentShaderReplacement(EYE_NORMALS[0], False, EYE_NORMALS[1], True)
    renderer = vtkRenderer()
    renderer.SetBackground(0, 0, 0)
    renderer.SetBackgroundAlpha(0)
    renderer.AddVolume(volume)
    add_lights(renderer, scene)
    window = vtkRenderWindow()
    window.SetOffScreenRendering(True)
    window.SetAlphaBitPlanes(True)
    window.SetMultiSamples(0)
    window.AddRenderer(renderer)

    def draw(camera: Camera) -> np.ndarray:
        window.SetSize(camera.width, camera.height)
        aim(renderer, camera)
        window.Render()
        return read_pixels(window, camera.width, camera.height)

    return draw


def _cropped(scene: Scene) -> np.ndarray:
    """Return the (3,) half extents of cropping planes that leave the box.

    VTK's shader compares a plane's place between the first and the last of n voxel centres with a texture's coordinate,
    which is 0 and 1 half a voxel beyond them: at the planes of the box itself it would leave half a voxel too much.
    """
    count = np.array(scene.values.shape[::-1]) + 2
    return scene.half - 0.5 * scene.step * (1 - 2 / count)


def image_data(scene: Scene, padded: bool) -> Any:
    """Return stored values as vtkImageData in the unit frame; ``padded`` by one voxel of the edge's value."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData

    values = np.pad(scene.values, 1, mode="edge") if padded else scene.values
    if values.dtype.kind == "f":  # what is not drawn must not reach the interpolation
        values = np.where(np.isfinite(values), values, scene.optics.lo).astype(np.float32)
    image = vtkImageData()
    image.SetDimensions(*values.shape[::-1])
    image.SetSpacing(*scene.step)
    image.SetOrigin(*(scene.step * (-0.5 if padded else 0.5) - scene.half))
    image.GetPointData().SetScalars(numpy_to_vtk(values.ravel(), deep=True))
    return image


def add_lights(renderer: Any, scene: Scene) -> None:
    """Add the scene's lights if some are at infinity; else VTK makes its head-light, the one that it handles well.

    With others its mapper takes the ambient colour from the lights, not from the volume: there is none (docs/light.md).
    """
    from vtkmodules.vtkRenderingCore import vtkLight

    if scene.light is None or not len(scene.light.directions):
        return
    renderer.SetAutomaticLightCreation(False)
    for direction in [*scene.light.directions, *([None] if scene.light.head else [])]:
        light = vtkLight()
        if direction is None:
            light.SetLightTypeToHeadlight()
        else:
            light.SetLightTypeToSceneLight()
            light.SetFocalPoint(0, 0, 0)
            light.SetPosition(*direction)
        renderer.AddLight(light)


def volume_property(scene: Scene, highlight: float = REFLECTED) -> Any:
    """Return a vtkVolumeProperty over stored values: the scene's function, unit distance, shading; linear.

    ``highlight``: what the power of highlights is multiplied with.
    """
    from vtkmodules.vtkCommonDataModel import vtkPiecewiseFunction
    from vtkmodules.vtkRenderingCore import vtkColorTransferFunction, vtkVolumeProperty

    tables = scene.optics
    edges = np.arange(tables.bins + 1)
    u = np.linspace(0, tables.bins, min(tables.bins, NODES) + 1)
    stored = tables.lo + u / tables.inv_width
    length = scene.unit_distance * scene.volume.unit_frame().scale
    tau = tables.nodes[:, 3]
    seen = tau > 0  # elsewhere the tables hold no colour: the neighbours' is taken
    opacity, color = vtkPiecewiseFunction(), vtkColorTransferFunction()
    depth = np.interp(u, edges, tau) * length
    rgb = [np.interp(u, edges[seen], tables.nodes[seen, k] / tau[seen]) if seen.any() else 0 * u for k in range(3)]
    for x, a, *c in zip(stored, -np.expm1(-depth), *rgb, strict=True):
        opacity.AddPoint(x, a)
        color.AddRGBPoint(x, *c)
    made = vtkVolumeProperty()
    made.SetScalarOpacity(opacity)
    made.SetColor(color)
    made.SetScalarOpacityUnitDistance(length)
    made.SetInterpolationTypeToLinear()
    if scene.light is not None:
        made.SetShade(True)
        made.SetAmbient(scene.light.ambient)
        made.SetDiffuse(scene.light.diffuse)
        made.SetSpecular(scene.light.specular)
        made.SetSpecularPower(highlight * scene.light.power)
    return made


def aim(renderer: Any, camera: Camera) -> None:
    """Give the renderer the camera's pose and pinhole; world space is the unit frame."""
    from vtkmodules.vtkCommonMath import vtkMatrix4x4

    eye, pose = camera.position, camera.rotation
    target = renderer.GetActiveCamera()
    target.SetPosition(*eye)
    target.SetFocalPoint(*(eye + pose[2]))
    target.SetViewUp(*-pose[1])
    near, far = NEAR, float(np.linalg.norm(eye)) + 4.0
    target.SetClippingRange(near, far)
    matrix = vtkMatrix4x4()  # OpenGL's frustum; rows of the image downwards
    rows: list[list[float]] = [
        [2 * camera.fx / camera.width, 0, 1 - 2 * camera.cx / camera.width, 0],
        [0, 2 * camera.fy / camera.height, 2 * camera.cy / camera.height - 1, 0],
        [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
        [0, 0, -1, 0],
    ]
    for i, j in np.ndindex(4, 4):
        matrix.SetElement(i, j, rows[i][j])
    target.SetExplicitProjectionTransformMatrix(matrix)
    target.SetUseExplicitProjectionTransformMatrix(True)


def read_pixels(window: Any, width: int, height: int) -> np.ndarray:
    """Return the window's frame buffer, (height, width, 4) float32 in [0, 1], top row first."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

    pixels = vtkUnsignedCharArray()
    window.GetRGBACharPixelData(0, 0, width - 1, height - 1, 0, pixels)
    return vtk_to_numpy(pixels).reshape(height, width, 4)[::-1].astype(np.float32) / 255
