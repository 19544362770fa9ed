"""What 3D Slicer's scene (MRML) shows, as files and the words of a `vvgt convert` command.

Runs in Slicer's Python, with the modules beside it loaded by their paths: imports MRML and VTK alone.
"""

from __future__ import annotations

import json
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import slicer


def neighbour(name: str) -> Any:
    """Return a module of this folder, by its path: Slicer's Python need not know the package."""
    spec: Any = spec_from_file_location(f"vvgt_{name}", Path(__file__).parent / f"{name}.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def words(folder: Path, volume: Any = None, segmentation: Any = None, renderer: Any = None, steps: bool = False) -> Any:
    """Write the nodes into an empty ``folder``; return the command's words without ``-o``, and notes on what is lost.

    Args:
        folder: where to.
        volume: vtkMRMLScalarVolumeNode, shown by its volume rendering.
        segmentation: vtkMRMLSegmentationNode; its visible segments.
        renderer: vtkRenderer whose camera and, of a shaded volume, lights are taken.
        steps: take all steps of the sequence that the volume shows one of.

    Raises:
        RuntimeError: a node cannot be placed, or nothing of it is visible; what to do.
    """
    taken, notes = list[str](), list[str]()
    if volume is not None:
        display = rendering(volume)
        nodes = frames(volume, steps)
        for k, node in enumerate(nodes):
            _written(node.GetImageData(), _affine(node, volume), folder / f"volume_{k:04d}.nrrd")
        taken = [str(folder / ("volume_*.nrrd" if len(nodes) > 1 else "volume_0000.nrrd"))]
        if display is not None:
            made, notes = neighbour("vtk_property").property_json(display.GetVolumePropertyNode().GetVolumeProperty())
            (folder / "function.json").write_text(json.dumps(made), "utf-8")
            taken += ["--tf", str(folder / "function.json")]
            if display.GetCroppingEnabled() and display.GetROINode() is not None:
                image = _inside(volume, display.GetROINode())
                taken += ["--mask", _written(image, _affine(volume, volume), folder / "mask.nrrd")]
            if renderer is not None and made["volumeProperties"][0]["components"][0]["shade"]:
                lights, more = neighbour("vtk_view").lights_of(renderer)
                taken += [word for light in lights for word in ("--light", light)]
                notes = notes + more
    if segmentation is not None:
        path, more = _segments(segmentation, folder / "segments.seg.nrrd")
        taken += ["--layer", path] if taken else [path]
        notes = notes + more
    if renderer is not None:
        camera, up, more = neighbour("vtk_view").camera_of(renderer)
        taken += ["--camera", camera, "--up", up]
        notes = notes + more
    return taken, notes


def rendering(volume: Any) -> Any:
    """Return the volume rendering's display node of a volume, None where it has none."""
    nodes = [volume.GetNthDisplayNode(k) for k in range(volume.GetNumberOfDisplayNodes())]
    return next((n for n in nodes if n is not None and n.IsA("vtkMRMLVolumeRenderingDisplayNode")), None)


def frames(volume: Any, steps: bool) -> list[Any]:
    """Return a volume node for each step of the sequence that ``volume`` is a proxy of, else ``volume`` alone."""
    scene, kind = volume.GetScene(), "vtkMRMLSequenceBrowserNode"
    browsers = [scene.GetNthNodeByClass(k, kind) for k in range(scene.GetNumberOfNodesByClass(kind) if steps else 0)]
    node = next((s for browser in browsers if (s := browser.GetSequenceNode(volume)) is not None), None)
    return [volume] if node is None else [node.GetNthDataNode(k) for k in range(node.GetNumberOfDataNodes())]


def _world(node: Any) -> Any:
    """Return the matrix of a node's parent transforms."""
    from vtk import vtkMatrix4x4

    matrix, parent = vtkMatrix4x4(), node.GetParentTransformNode()
    if not slicer.vtkMRMLTransformNode.GetMatrixTransformBetweenNodes(parent, None, matrix):
        name = f"{node.GetName()}: its transform {parent.GetName()}"
        raise RuntimeError(f"{name} is not linear; harden it (Data, right click, Harden transform) or take it away")
    return matrix


def _affine(node: Any, placed: Any) -> Any:
    """Return the matrix of volume ``node`` from IJK to RAS, moved by the transforms of ``placed``."""
    matrix, world = _world(placed), _world(placed)
    node.GetIJKToRASMatrix(matrix)
    world.Multiply4x4(world, matrix, matrix)
    return matrix


def _written(image: Any, matrix: Any, path: Path) -> str:
    writer = slicer.vtkTeemNRRDWriter()
    writer.SetInputData(image)
    writer.SetIJKToRASMatrix(matrix)
    writer.SetUseCompression(False)
    writer.SetFileName(str(path))
    writer.Write()
    if writer.GetWriteError():
        raise RuntimeError(f"{path}: cannot be written")
    return str(path)


def _inside(volume: Any, roi: Any) -> Any:
    """Return an image of the voxels that a region of interest leaves, 1, and hides, 0."""
    import vtk

    planes, place = vtk.vtkPlanes(), vtk.vtkTransform()
    roi.GetPlanesWorld(planes)
    place.SetMatrix(_affine(volume, volume))
    planes.SetTransform(place)  # takes points in IJK
    stencil, image = vtk.vtkImplicitFunctionToImageStencil(), vtk.vtkImageStencilToImage()
    stencil.SetInput(planes)
    stencil.SetInformationInput(volume.GetImageData())
    image.SetInputConnection(stencil.GetOutputPort())
    image.SetOutputScalarTypeToUnsignedChar()
    image.Update()
    return image.GetOutput()


def _segments(node: Any, path: Path) -> tuple[str, list[str]]:
    """Write the visible segments of a segmentation, with names and colours, and note what is not taken."""
    display, world = node.GetDisplayNode(), _world(node)
    copy = slicer.vtkMRMLSegmentationNode()
    copy.GetSegmentation().DeepCopy(node.GetSegmentation())
    names = [node.GetSegmentation().GetNthSegmentID(k) for k in range(node.GetSegmentation().GetNumberOfSegments())]
    hidden = [] if display is None else [name for name in names if not display.GetSegmentVisibility(name)]
    for name in hidden:
        copy.GetSegmentation().RemoveSegment(name)
    if len(hidden) == len(names):
        raise RuntimeError(f"{node.GetName()}: no visible segment; show one, or take no segmentation")
    copy.ApplyTransformMatrix(world)
    copy.GetSegmentation().CollapseBinaryLabelmaps(False)  # a layer where segments do not overlap
    storage = slicer.vtkMRMLSegmentationStorageNode()
    storage.SetCropToMinimumExtent(False)  # else a segment ends at the centres of its own outermost voxels
    storage.SetFileName(str(path))
    if not storage.WriteData(copy):
        raise RuntimeError(f"{path}: cannot be written")
    faded = display is not None and any(display.GetSegmentOpacity3D(n) < 1 for n in names if n not in hidden)
    return str(path), ["opacity of segments (solid instead)"] if faded else []
