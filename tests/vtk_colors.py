"""VTK's picture of an RGBA volume with dependent components: what the tests and benchmarks compare with."""

from typing import Any

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.dvr import Scene
from vvgt_cli.dvr.vtk import aim, read_pixels


def dependent(values: np.ndarray, scene: Scene, top: float, camera: Camera, step: float = 0.25) -> np.ndarray:
    """(h, w, 4) float32 of ``values`` (nz, ny, nx, 4) uint8 over black; alpha 255 is opacity ``top`` a unit distance.

    ``scene`` is the same volume as an optics grid; ``step`` in voxels. VTK's box ends at voxel centres: the volume is
    padded by its edge.
    """
    import vtkmodules.vtkRenderingOpenGL2
    import vtkmodules.vtkRenderingVolumeOpenGL2  # noqa: F401
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData, vtkPiecewiseFunction
    from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow, vtkVolume, vtkVolumeProperty
    from vtkmodules.vtkRenderingVolume import vtkFixedPointVolumeRayCastMapper

    padded = np.pad(values, [(1, 1)] * 3 + [(0, 0)], mode="edge")
    image: Any = vtkImageData()
    image.SetDimensions(*padded.shape[2::-1])
    image.SetSpacing(*scene.step)
    image.SetOrigin(*(scene.step * -0.5 - scene.half))
    image.GetPointData().SetScalars(numpy_to_vtk(padded.reshape(-1, 4), deep=True))
    opacity: Any = vtkPiecewiseFunction()
    opacity.AddPoint(0, 0)
    opacity.AddPoint(255, top)
    look: Any = vtkVolumeProperty()
    look.IndependentComponentsOff()
    look.SetScalarOpacity(opacity)
    look.SetScalarOpacityUnitDistance(scene.unit_distance * scene.volume.unit_frame().scale)
    look.SetInterpolationTypeToLinear()
    mapper: Any = vtkFixedPointVolumeRayCastMapper()
    mapper.SetInputData(image)
    mapper.SetAutoAdjustSampleDistances(False)
    mapper.SetImageSampleDistance(1)
    mapper.SetCropping(True)
    mapper.SetCroppingRegionFlagsToSubVolume()
    mapper.SetCroppingRegionPlanes(*(side * h for h in scene.half for side in (-1, 1)))
    mapper.SetSampleDistance(step * float(scene.step.min()))
    volume: Any = vtkVolume()
    volume.SetMapper(mapper)
    volume.SetProperty(look)
    renderer: Any = vtkRenderer()
    renderer.AddVolume(volume)
    renderer.SetBackground(0, 0, 0)
    window: Any = vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetAlphaBitPlanes(1)
    window.SetMultiSamples(0)
    window.AddRenderer(renderer)
    window.SetSize(camera.width, camera.height)
    aim(renderer, camera)
    window.Render()
    return read_pixels(window, camera.width, camera.height)
