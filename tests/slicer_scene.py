"""Run by 3D Slicer's Python (slicer-core): a scene, its conversion through the adapter, and Slicer's picture of it.

PYTHON slicer_scene.py FOLDER: needs VVGT, the words that start vvgt; leaves files for test_integrations_slicer.py.
"""

from __future__ import annotations

import json
import runpy
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import slicer
import vtk
from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy

FOLDER, ADAPTER = Path(sys.argv[1]), Path(__file__).parents[1] / "vvgt_cli" / "integrations" / "mrml.py"
DIMS = (40, 44, 36)  # i, j, k
CENTRE = np.array((17, 24, 20))
MATRIX = ((0, -0.9, 0.1, 12), (0.8, 0, 0.2, -30), (0, 0.1, 1.5, 7), (0, 0, 0, 1))  # IJK to RAS, sheared
TURN = ((0.8, -0.6, 0, 5), (0.6, 0.8, 0, -2), (0, 0, 1, 9), (0, 0, 0, 1))
SIZE, ANGLE = 300, 30.0
FAST = ["--max-gaussians", "20000", "--screen", "300", "--steps", "60", "--overwrite", "-q"]
spec = spec_from_file_location("mrml", ADAPTER)
mrml = module_from_spec(spec)
spec.loader.exec_module(mrml)


def matrix(rows):
    found = vtk.vtkMatrix4x4()
    found.DeepCopy([x for row in rows for x in row])
    return found


def image(values):
    made = vtk.vtkImageData()
    made.SetDimensions(values.shape[::-1])
    made.GetPointData().SetScalars(numpy_to_vtk(values.ravel(), deep=True))
    return made


def ball():
    k, j, i = np.indices(DIMS[::-1])
    r = np.sqrt((i - CENTRE[0]) ** 2 + (j - CENTRE[1]) ** 2 + (1.5 * (k - CENTRE[2])) ** 2)
    return np.clip(1000 * (1.4 - r / 9), 0, 1000).astype(np.int16)


def point(shift=0):
    values = np.zeros(DIMS[::-1], np.int16)
    values[CENTRE[2], CENTRE[1], CENTRE[0] + shift] = 1000
    return values


def added(scene, kind, name):
    node = getattr(slicer, kind)()
    node.SetName(name)
    return scene.AddNode(node)


def run(words, name, *more):
    mrml.neighbour("command").run(["convert", *words, "-o", str(FOLDER / name), *FAST, *more])


def convert(name, *args, **kwargs):
    (FOLDER / name).mkdir()
    words, notes = mrml.words(FOLDER / name, *args, **kwargs)
    run(words, f"{name}.ply")
    (FOLDER / f"{name}.json").write_text(json.dumps({"words": words, "notes": notes}))


app, scene = slicer.vtkMRMLApplicationLogic(), slicer.vtkMRMLScene()
app.SetMRMLScene(scene)
logic = slicer.vtkSlicerVolumeRenderingLogic()
logic.SetMRMLApplicationLogic(app)
logic.SetMRMLScene(scene)
for kind in ("vtkMRMLSequenceBrowserNode", "vtkMRMLGridTransformNode"):
    scene.RegisterNodeClass(getattr(slicer, kind)())
rules = slicer.vtkSegmentationConverterFactory.GetInstance()
rules.RegisterConverterRule(slicer.vtkBinaryLabelmapToClosedSurfaceConversionRule())

# a volume under a transform, with its volume rendering
volume = added(scene, "vtkMRMLScalarVolumeNode", "ct")
volume.SetAndObserveImageData(image(ball()))
volume.SetIJKToRASMatrix(matrix(MATRIX))
turn = added(scene, "vtkMRMLLinearTransformNode", "turn")
turn.SetMatrixTransformToParent(matrix(TURN))
volume.SetAndObserveTransformNodeID(turn.GetID())
view = added(scene, "vtkMRMLViewNode", "view")
display = logic.CreateVolumeRenderingDisplayNode("vtkMRMLCPURayCastVolumeRenderingDisplayNode")
scene.AddNode(display)
volume.AddAndObserveDisplayNodeID(display.GetID())
logic.UpdateDisplayNodeFromVolumeNode(display, volume)
display.SetVisibility(1)
held = display.GetVolumePropertyNode().GetVolumeProperty()
opacity, color = vtk.vtkPiecewiseFunction(), vtk.vtkColorTransferFunction()
for x, y, middle, sharpness in ((0, 0, 0.5, 0), (300, 0.02, 0.4, 0.3), (1000, 0.35, 0.5, 0)):
    opacity.AddPoint(x, y, middle, sharpness)
for x, *rgb in ((0, 0.1, 0.2, 0.9), (500, 0.9, 0.9, 0.1), (1000, 1, 0.2, 0.1)):
    color.AddRGBPoint(x, *rgb)
held.SetScalarOpacity(opacity)
held.SetColor(color)
held.SetScalarOpacityUnitDistance(1.3)
held.SetDisableGradientOpacity(1)
held.SetInterpolationTypeToLinear()
held.ShadeOff()

# Slicer's own picture, by its manager of volume renderings
window, renderer = vtk.vtkRenderWindow(), vtk.vtkRenderer()
window.SetOffScreenRendering(1)
window.SetMultiSamples(0)
window.SetSize(SIZE, SIZE)
window.AddRenderer(renderer)
interactor = vtk.vtkRenderWindowInteractor()
interactor.SetRenderWindow(window)
interactor.Initialize()
factory = slicer.vtkMRMLThreeDViewDisplayableManagerFactory.GetInstance()
factory.SetMRMLApplicationLogic(app)
factory.RegisterDisplayableManager("vtkMRMLVolumeRenderingDisplayableManager")
group = slicer.vtkMRMLDisplayableManagerGroup()
group.SetRenderer(renderer)
group.Initialize(factory, renderer)
group.SetMRMLDisplayableNode(view)
at = np.array(TURN) @ np.array(MATRIX) @ (*CENTRE, 1)
camera = renderer.GetActiveCamera()
camera.SetFocalPoint(*at[:3])
camera.SetPosition(*(at[:3] + np.array((42, -36, 24))))
camera.SetViewUp(0, 0, 1)
camera.SetViewAngle(ANGLE)
renderer.SetBackground(0, 0, 0)
renderer.ResetCameraClippingRange()
volumes = renderer.GetVolumes()
for k in range(volumes.GetNumberOfItems()):
    mapper = volumes.GetItemAsObject(k).GetMapper()
    for step in ("SetSampleDistance", "SetImageSampleDistance", "SetMinimumImageSampleDistance"):
        getattr(mapper, step, float)(0.25 if step == "SetSampleDistance" else 1)
    getattr(mapper, "AutoAdjustSampleDistancesOff", float)()
window.Render()
shot = vtk.vtkWindowToImageFilter()
shot.SetInput(window)
shot.SetInputBufferTypeToRGB()
shot.ReadFrontBufferOff()
shot.Update()
pixels = vtk_to_numpy(shot.GetOutput().GetPointData().GetScalars()).reshape(SIZE, SIZE, 3)[::-1]
np.save(FOLDER / "slicer.npy", pixels)
facts = {"volumes": volumes.GetNumberOfItems(), "at": at.tolist(), "eye": camera.GetPosition(), "angle": ANGLE}
facts["affine"] = (np.array(TURN) @ np.array(MATRIX))[:3].ravel().tolist()

convert("volume", volume, renderer=renderer)

# a segmentation: two segments, one of them hidden
segments = added(scene, "vtkMRMLSegmentationNode", "organs")
segments.CreateDefaultDisplayNodes()
segments.SetAndObserveTransformNodeID(turn.GetID())
segments.SetReferenceImageGeometryParameterFromVolumeNode(volume)
parts = {"left kidney, upper": ball() >= 500, "cyst": ball() >= 900, "air": ball() == 0}
parts["left kidney, upper"] &= ~parts["cyst"]
for (name, part), rgb in zip(parts.items(), ((0.2, 0.4, 0.6), (0.9, 0.3, 0.1), (1, 1, 1)), strict=True):
    held = slicer.vtkOrientedImageData()
    held.DeepCopy(image(part.astype(np.uint8)))
    held.SetImageToWorldMatrix(matrix(MATRIX))
    segment = slicer.vtkSegment()
    segment.SetName(name)
    segment.SetColor(*rgb)
    segment.AddRepresentation("Binary labelmap", held)
    segments.GetSegmentation().AddSegment(segment, name)
segments.GetDisplayNode().SetSegmentVisibility("air", False)
convert("segments", None, segments)
convert("both", volume, segments)

# the module's logic, with stand-ins for what slicer-core lacks: Qt, CTK, and the base classes on them
base = ModuleType("slicer.ScriptedLoadableModule")
for kind in ("", "Logic", "Widget"):
    setattr(base, f"ScriptedLoadableModule{kind}", object)
sys.modules |= {"ctk": ModuleType("ctk"), "qt": ModuleType("qt"), base.__name__: base}
part = SimpleNamespace(renderWindow=lambda: window)
slicer.app = SimpleNamespace(
    layoutManager=lambda: SimpleNamespace(
        threeDViewCount=1, threeDWidget=lambda _: SimpleNamespace(threeDView=lambda: part)
    )
)
module = runpy.run_path(str(ADAPTER.parent / "slicer" / "GaussianSplats.py"))
facts["logic"] = module["GaussianSplatsLogic"]().convert(volume, segments, str(FOLDER / "logic.ply"), options=FAST)

# a region of interest: half of the ball
roi = added(scene, "vtkMRMLMarkupsROINode", "roi")
roi.SetCenterWorld(*(at[:3] + np.array((0, 0, 20))))
roi.SetSizeWorld(100, 100, 40)
display.SetAndObserveROINodeID(roi.GetID())
display.SetCroppingEnabled(1)
convert("cropped", volume)
display.SetCroppingEnabled(0)

# a sequence of two steps
sequence = added(scene, "vtkMRMLSequenceNode", "steps")
for k in range(2):
    step = slicer.vtkMRMLScalarVolumeNode()
    step.SetAndObserveImageData(image(point(6 * k)))
    step.SetIJKToRASMatrix(matrix(MATRIX))
    sequence.SetDataNodeAtValue(step, str(k))
browser = added(scene, "vtkMRMLSequenceBrowserNode", "browser")
browser.SetAndObserveMasterSequenceNodeID(sequence.GetID())
browser.AddProxyNode(volume, sequence, False)
(FOLDER / "series").mkdir()
words, _ = mrml.words(FOLDER / "series", volume, steps=True)
run(words, "series_{}.ply", "--steps", "0")

# a transform that is not linear
bent = added(scene, "vtkMRMLGridTransformNode", "bent")
warp = vtk.vtkThinPlateSplineTransform()
bent.SetAndObserveTransformToParent(warp)
volume.SetAndObserveTransformNodeID(bent.GetID())
try:
    mrml.words(FOLDER, volume)
except RuntimeError as error:
    facts["refused"] = str(error)
(FOLDER / "facts.json").write_text(json.dumps(facts))
