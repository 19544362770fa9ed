"""What is taken from a VTK scene: the functions of a volume property, the volume's place, camera and lights."""

import sys

import numpy as np
import pytest
import vtkmodules.vtkRenderingVolumeOpenGL2  # noqa: F401  # registers what the classes below become
from vtkmodules.vtkCommonCore import vtkFloatArray
from vtkmodules.vtkCommonDataModel import vtkImageData, vtkPiecewiseFunction, vtkPlane
from vtkmodules.vtkCommonTransforms import vtkTransform
from vtkmodules.vtkRenderingCore import (
    vtkColorTransferFunction,
    vtkLight,
    vtkRenderer,
    vtkVolume,
    vtkVolumeProperty,
)
from vtkmodules.vtkRenderingVolume import vtkFixedPointVolumeRayCastMapper

from vvgt_cli.integrations import command
from vvgt_cli.integrations.vtk_property import property_json
from vvgt_cli.integrations.vtk_scene import drawn
from vvgt_cli.integrations.vtk_view import camera_of, lights_of, volumes_of
from vvgt_cli.library.inputs import volume_in_memory
from vvgt_cli.look import read_transfer_function
from vvgt_cli.look.function import SPACES
from vvgt_cli.version import VERSION
from vvgt_cli.volume import ReadOptions

SHARP = [(-1.0, 0.0, 0.3, 0.4), (0.5, 0.9, 0.7, 0.0), (2.0, 0.2, 0.5, 1.0), (3.0, 0.6, 0.5, 0.0)]
COLOURS = [(-1.0, 0.1, 0.2, 0.9, 0.3, 0.5), (1.0, 0.9, 0.4, 0.1, 0.5, 0.0), (3.0, 0.2, 0.8, 0.3, 0.5, 0.0)]


def made(opacity=SHARP, colors=COLOURS) -> tuple[vtkVolumeProperty, vtkPiecewiseFunction, vtkColorTransferFunction]:
    """A property with functions of many kinds of nodes."""
    prop, piecewise, color = vtkVolumeProperty(), vtkPiecewiseFunction(), vtkColorTransferFunction()
    for node in opacity:
        piecewise.AddPoint(*node)
    for node in colors:
        color.AddRGBPoint(*node)
    prop.SetScalarOpacity(piecewise)
    prop.SetColor(color)
    prop.SetInterpolationTypeToLinear()
    return prop, piecewise, color


def agrees(prop, piecewise, color, x, within=1e-9):
    found, notes = property_json(prop)
    function = read_transfer_function(found)
    assert function.opacity(x) == pytest.approx([piecewise.GetValue(v) for v in x], abs=within)
    assert function.color(x) == pytest.approx(np.array([color.GetColor(v) for v in x]), abs=max(within, 1e-6))
    return function, notes


@pytest.mark.parametrize("space", SPACES)
def test_functions_are_those_of_vtk_at_every_value(space):
    prop, piecewise, color = made()
    getattr(color, f"SetColorSpaceTo{space.replace('/', '')}")()
    # a path of CIEDE2000 is kept in 1,025 colours
    x = np.linspace(-2, 4, 61) + 0.003
    _, notes = agrees(prop, piecewise, color, x, within=3e-3 if space == "Lab/CIEDE2000" else 1e-9)
    assert not notes


def test_values_beyond_the_ends_are_as_in_vtk():
    prop, piecewise, color = made()
    piecewise.ClampingOff()
    color.SetUseBelowRangeColor(True)
    color.SetBelowRangeColor(0, 1, 0)
    color.SetUseAboveRangeColor(True)
    color.SetAboveRangeColor(1, 0, 1)
    function, _ = agrees(prop, piecewise, color, np.array([-0.99, 0.2, 2.99]))
    assert function.opacity(np.array([-1.01, 3.01])).tolist() == [0, 0]
    assert function.color(np.array([-1.01, 3.01])).tolist() == [[0, 1, 0], [1, 0, 1]]  # GetColor has the ends' instead


def test_logarithmic_axes():
    prop, piecewise, color = made([(0.01, 0.1, 0.5, 0), (10, 0.9, 0.5, 0)], [(0.01, 0, 0, 0), (10, 1, 1, 1)])
    piecewise.SetUseLogScale(True)
    color.SetScaleToLog10()
    agrees(prop, piecewise, color, np.geomspace(0.012, 9.7, 50), within=1e-4)


def test_the_rest_of_a_property_is_taken_or_named():
    prop, *_ = made()
    prop.SetScalarOpacityUnitDistance(2.5)
    prop.SetShade(True)
    prop.SetAmbient(0.3)
    prop.SetSpecularPower(8)
    prop.GetGradientOpacity().AddPoint(0, 0)
    prop.GetGradientOpacity().AddPoint(1, 1)
    prop.SetInterpolationTypeToNearest()
    found, notes = property_json(prop, scale=2.0)
    function = read_transfer_function(found)
    assert function.opacity_unit_distance == 5.0
    assert (function.lighting.ambient, function.lighting.specular_power) == (0.3, 32)
    assert notes == ["gradient opacity", "nearest-neighbour interpolation (linear instead)"]


def image(dims=(5, 6, 7), extent_from=(2, 0, -1)) -> vtkImageData:
    """An image whose values are 1 + 2 x + 30 y + 500 z at world positions."""
    from vtkmodules.util.numpy_support import numpy_to_vtk

    made = vtkImageData()
    made.SetExtent(*(v for low, n in zip(extent_from, dims, strict=True) for v in (low, low + n - 1)))
    made.SetOrigin(10, -20, 30)
    made.SetSpacing(0.5, 0.75, 2)
    made.SetDirectionMatrix(0, -1, 0, 0.6, 0, -0.8, 0.8, 0, 0.6)
    places = np.array([made.GetPoint(k) for k in range(made.GetNumberOfPoints())])
    array = numpy_to_vtk(1 + places @ (2, 30, 500), deep=True)
    array.SetName("ramp")
    made.GetPointData().SetScalars(array)
    return made


def shown(data, prop=None) -> tuple[vtkRenderer, vtkVolume]:
    renderer, volume, mapper = vtkRenderer(), vtkVolume(), vtkFixedPointVolumeRayCastMapper()
    mapper.SetInputData(data)
    volume.SetMapper(mapper)
    volume.SetProperty(prop or made()[0])
    renderer.AddVolume(volume)
    return renderer, volume


def test_a_moved_volume_is_where_vtk_draws_it():
    renderer, volume = shown(image())
    volume.SetOrientation(10, 20, 30)
    volume.SetPosition(3, -2, 1)
    volume.SetScale(1.5)
    move = vtkTransform()
    move.RotateWXYZ(40, 1, 2, 3)
    volume.SetUserTransform(move)
    found = drawn(*volumes_of(renderer))
    assert found.scale == pytest.approx(1.5)
    assert not found.notes
    taken = volume_in_memory(found.data, ReadOptions())
    for k in (0, 37, 209):
        i = np.unravel_index(k, taken.data.shape)[::-1]
        ours = taken.origin + np.reshape(taken.direction, (3, 3)) @ (np.array(taken.spacing) * i)
        assert ours == pytest.approx(
            np.array(volume.GetMatrix().MultiplyPoint((*image().GetPoint(k), 1))[:3]), abs=1e-9
        )


def test_the_array_is_the_mappers_own():
    """Of cells beside active scalars of points, of the same name; a mapper without data draws nothing."""
    data, cells = image(), vtkFloatArray()
    cells.SetName("ramp")
    cells.SetNumberOfTuples(data.GetNumberOfCells())
    cells.Fill(7)
    data.GetCellData().AddArray(cells)
    renderer, volume = shown(data)
    assert drawn(volume).array is data.GetPointData().GetScalars()
    volume.GetMapper().SetScalarModeToUseCellFieldData()
    volume.GetMapper().SelectScalarArray("ramp")
    found = drawn(volume)
    assert found.array is cells
    assert (volume_in_memory(found.data, ReadOptions()).data == 7).all()
    volume.GetMapper().SelectScalarArray("other")
    assert drawn(volume).array is None
    empty = vtkVolume()
    empty.SetMapper(vtkFixedPointVolumeRayCastMapper())
    renderer.AddVolume(empty)
    assert volumes_of(renderer) == [volume]


def test_an_uneven_scale_is_named():
    _, volume = shown(image())
    volume.SetScale(1, 1, 8)
    found = drawn(volume)
    assert found.scale == pytest.approx(2)
    assert found.notes == ["uneven scale: opacity is per mean length"]


def test_hidden_voxels_are_those_that_planes_cut_off():
    data = image()
    data.SetDirectionMatrix(1, 0, 0, 0, 1, 0, 0, 0, 1)
    _, volume = shown(data)
    volume.SetPosition(5, 0, 0)
    mapper = volume.GetMapper()
    centre = np.array(data.GetPoint(100))
    plane = vtkPlane()
    plane.SetOrigin(*(centre + np.array([5, 0, 0])))
    plane.SetNormal(1, 2, -1)
    mapper.AddClippingPlane(plane)
    mapper.SetCropping(True)
    mapper.SetCroppingRegionPlanes(*(v for c in centre for v in (c - 1, c + 1)))
    mapper.SetCroppingRegionFlagsToFence()
    mask = drawn(volume).mask
    assert 0 < mask.sum() < mask.size
    for k, kept in enumerate(mask.ravel()):
        place = np.array(data.GetPoint(k))
        amid = np.abs(place - centre) <= 1
        fence = 1 << int(((place >= centre - 1).astype(int) + (place > centre + 1)) @ (1, 3, 9))
        assert kept == (bool(fence & mapper.GetCroppingRegionFlags()) and (place - centre) @ (1, 2, -1) >= 0), amid
    data.SetDirectionMatrix(0, -1, 0, 1, 0, 0, 0, 0, 1)
    found = drawn(volume)
    assert found.notes == ["cropping regions of an oblique image (VTK places them along its axes)"]
    assert found.mask is not None  # the clipping plane's
    for k, kept in enumerate(found.mask.ravel()):
        assert kept == ((np.array(data.GetPoint(k)) - centre) @ (1, 2, -1) >= 0)


def test_camera_and_lights():
    renderer, _ = shown(image())
    camera = renderer.GetActiveCamera()
    camera.SetPosition(1, 2, 3)
    camera.SetFocalPoint(0, 0, 1)
    camera.SetViewUp(-0.1, -1.2, -0.2)  # upright: -y, and a tenth of the line of sight
    camera.SetViewAngle(25)
    assert camera_of(renderer) == ("1.0,2.0,3.0,0.0,0.0,1.0,25.0", "-y", [])
    camera.Roll(20)
    assert camera_of(renderer)[2] in (["roll of the camera, 20 degrees"], ["roll of the camera, -20 degrees"])
    camera.Roll(-20)
    camera.SetParallelProjection(True)
    camera.SetParallelScale(np.tan(np.radians(12.5)) * 6)
    text, _, notes = camera_of(renderer)
    assert np.array(text.split(","), float) == pytest.approx([2, 4, 5, 0, 0, 1, 25])
    assert notes == ["parallel projection (perspective instead)"]
    assert lights_of(renderer) == (["headlight"], [])
    light = vtkLight()
    light.SetLightTypeToSceneLight()
    light.SetPosition(3, 0, 1)
    light.SetFocalPoint(0, 0, 0)
    renderer.AddLight(light)
    assert lights_of(renderer) == (["3.0,0.0,1.0"], [])
    light.SwitchOff()
    assert lights_of(renderer) == (["headlight"], [])  # which VTK makes when it draws
    renderer.AutomaticLightCreationOff()
    assert lights_of(renderer) == (["headlight"], ["absence of lights (headlight instead)"])
    light.SwitchOn()
    light.SetIntensity(0.5)
    light.SetPositional(True)
    assert len(lights_of(renderer)[1]) == 2


def test_the_command_is_found_by_variable_and_path(monkeypatch, tmp_path):
    monkeypatch.setenv("VVGT", "/bin/echo -n")
    heard = []
    command.run(["convert", "a"], heard.append)
    assert heard == ["convert a"]
    monkeypatch.setenv("VVGT", "sh -c 'echo vvgt: error: no such file >&2; exit 1'")
    with pytest.raises(RuntimeError, match="no such file"):
        command.run([], heard.append)
    assert heard == ["convert a"]  # an error is raised, not told as well
    place = tmp_path / "my \\programs" / "vvgt"
    place.parent.mkdir()
    place.symlink_to("/bin/echo")
    monkeypatch.setenv("VVGT", str(place))
    assert command.command() == [str(place)]
    monkeypatch.delenv("VVGT")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RuntimeError, match="not in PATH; install it"):
        command.run(["convert"])


def test_a_kept_process_reads_a_file_again_and_ends_where_a_message_is_not_taken(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("VVGT", f"{sys.executable} -m vvgt_cli.commands.main")
    kept, file = command.Kept(), tmp_path / "a.npy"
    for size in (24, 36):
        np.save(file, np.full((size, size, size), size, np.float32) * np.linspace(0, 1, size, dtype=np.float32))
        more = ["--max-gaussians", "50", "--overwrite", "-o", f"{tmp_path}/a.ply"]
        kept.run(["init", str(file), "--blocks", "16", *more])
    assert "values 0 to 36" in capsys.readouterr().out
    monkeypatch.setattr("builtins.print", lambda line: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        kept.run(["--version"])
    monkeypatch.undo()
    monkeypatch.setenv("VVGT", f"{sys.executable} -m vvgt_cli.commands.main")
    with pytest.raises(RuntimeError, match=r"^no such file"):  # not the status of the one before
        kept.run(["info", "no such file"])
    kept.close()


def test_a_kept_process_runs_commands_one_after_another(monkeypatch, capsys):
    """Each with its own messages and error, also after the process was killed."""
    monkeypatch.setenv("VVGT", f"{sys.executable} -m vvgt_cli.commands.main")
    kept = command.Kept()
    kept.run(["--version"])
    first = kept.process
    with pytest.raises(RuntimeError, match=r"^no such file"):
        kept.run(["info", "no such file"])
    kept.run(["--version"])
    assert kept.process is first
    first.kill()
    first.wait()
    kept.run(["--version"])
    assert capsys.readouterr().out == 3 * f"vvgt {VERSION}\n"
    kept.close()
    assert first is not kept.process
    assert kept.process.returncode == 0
