"""How VTK's mappers shade, beside ours."""

import numpy as np
import pytest

from tests.vtk_views import drawn_by_vtk
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.dvr import vtk as vtk_renderer
from vvgt_cli.look import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.volume import Volume

SLANTED = (0.6, -0.48, 0.64)
BY_VTK = """
import sys
import numpy as np
from tests.test_light_vtk import both, long_box, STEP, by_cpu_mapper, distant
from vvgt_cli.dvr.vtk import view_renderer
found = {}
for name in ("stretched", "mended"):
    found[name] = view_renderer(long_box(), STEP, mended=name == "mended")(distant())
for name, (scene, step) in both().items():
    found[name] = view_renderer(scene, STEP)(distant())
    found[name + " cpu"] = by_cpu_mapper(scene, distant())
np.savez(sys.argv[1], **found)
"""
STEP = RenderSettings(step=0.25, samples=1)
NODES = np.array([0.3, 0.5, 1.2])
SHELL = TransferFunction(
    "t", PiecewiseOpacity(NODES, np.array([0, 0.9, 0.9])), ColorMap(NODES, np.array([[1, 0.5, 0.2]] * 3))
)


def distant():
    """VTK's CPU mapper takes the camera's axis for the direction of rays, and its pixels lie a part of one aside."""
    return look_at((22.0, -16.0, 11.0), width=384, height=384, fov=4)


def smooth_ball(long=1):
    """A ball with a soft edge: values far from zero gradients where it is seen; the box is ``long`` times as high."""
    z, y, x = np.meshgrid(np.linspace(-long, long, 32 * long), *[np.linspace(-1, 1, 32)] * 2, indexing="ij")
    return Scene.build(Volume((1.2 - np.sqrt(x * x + y * y + z * z)).astype(np.float32)), SHELL, 1.0)


def both():
    ball = smooth_ball()
    fixed = Lighting(False, (SLANTED,), 0, 0.9, 0)
    return {"headlight": (ball.lit(Lighting()), STEP), "fixed": (ball.lit(fixed), STEP)}


def long_box():
    return smooth_ball(2).lit(Lighting(False, (SLANTED,), 0, 0.9, 0))


def by_cpu_mapper(scene, view):
    import vtkmodules.vtkRenderingOpenGL2
    import vtkmodules.vtkRenderingVolumeOpenGL2  # noqa: F401
    from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow, vtkVolume
    from vtkmodules.vtkRenderingVolume import vtkFixedPointVolumeRayCastMapper

    mapper, volume, renderer, window = (
        vtkFixedPointVolumeRayCastMapper(), vtkVolume(), vtkRenderer(), vtkRenderWindow(),
    )  # fmt: skip
    mapper.SetInputData(vtk_renderer.image_data(scene, padded=False))
    mapper.SetAutoAdjustSampleDistances(False)
    mapper.SetLockSampleDistanceToInputSpacing(False)
    mapper.SetImageSampleDistance(1)
    mapper.SetSampleDistance(0.25 * float(scene.step.mean()))
    volume.SetMapper(mapper)
    volume.SetProperty(vtk_renderer.volume_property(scene, 1.0))
    renderer.SetBackgroundAlpha(0)
    renderer.AddVolume(volume)
    vtk_renderer.add_lights(renderer, scene)
    if not len(scene.light.directions):
        renderer.CreateLight()
    renderer.GetLights().GetItemAsObject(0).SetAmbientColor(1, 1, 1)  # 0 is the default, with which there is no ambient
    window.SetOffScreenRendering(True)
    window.SetAlphaBitPlanes(True)
    window.SetMultiSamples(0)
    window.AddRenderer(renderer)
    window.SetSize(view.width, view.height)
    vtk_renderer.aim(renderer, view)
    window.Render()
    return vtk_renderer.read_pixels(window, view.width, view.height)


@pytest.fixture(scope="module")
def from_vtk(tmp_path_factory):
    return drawn_by_vtk(BY_VTK, tmp_path_factory.mktemp("vtk"))


@pytest.mark.parametrize("mapper", ["", " cpu"])
@pytest.mark.parametrize("name", ["headlight", "fixed"])
def test_both_mappers_of_vtk_shade_alike(from_vtk, name, mapper):
    ours = render_view(both()[name][0], distant(), STEP)
    theirs = from_vtk[name + mapper]
    seen = ours[..., 3] > 0.01
    assert seen.mean() > 0.2
    if name == "fixed" and mapper:  # it lights no surface from behind: what is turned away stays dark
        seen &= theirs[..., 0] > 0.1
    assert decibels(theirs, ours, seen) > 39.5


def decibels(theirs, ours, seen):
    a, b = (np.round(255 * np.clip(i[..., :3], 0, 1)) / 255 for i in (theirs, ours))
    return -10 * np.log10(np.mean((a - b)[seen] ** 2))


def test_vtk_stretches_normals_along_the_screen_where_the_box_is_no_cube(from_vtk):
    ours = render_view(long_box(), distant(), STEP)
    seen = ours[..., 3] > 0.01
    assert decibels(from_vtk["stretched"], ours, seen) < 25
    assert decibels(from_vtk["mended"], ours, seen) > 40
