"""The look of ParaView's active view as options of ``vvgt``; runs in ParaView's Python."""

from __future__ import annotations

import json
from typing import Any

from vvgt_cli.integrations.vtk_property import property_json
from vvgt_cli.integrations.vtk_scene import drawn
from vvgt_cli.integrations.vtk_view import camera_of, lights_of

LIGHTS = ("as drawn", "none", "headlight")


def representation_of(source: Any) -> tuple[Any, Any]:
    """Return the visible representation of a vtkAlgorithm's output in the active view, and the view; None for none.

    A remote server sees no view.
    """
    from paraview import servermanager, simple

    connection = servermanager.ActiveConnection
    view = None if connection is None or connection.IsRemote() else simple.GetActiveView()
    if view is None or not hasattr(view.SMProxy, "GetRenderer"):
        return None, None
    upstream = []  # nearest first
    while source is not None:
        upstream.append(source)
        source = source.GetInputAlgorithm(0, 0) if source.GetNumberOfInputPorts() else None
    inputs = [(getattr(one, "Input", None), one) for one in view.Representations]
    shown = [(made.SMProxy.GetClientSideObject(), one) for made, one in inputs if made is not None and one.Visibility]
    return next((one for at in upstream for made, one in shown if made is at), None), view


def look(source: Any, options: dict[str, Any], function: str) -> tuple[list[str], list[float] | None, list[str]]:
    """Return the look of what a vtkAlgorithm makes.

    Args:
        source: the algorithm.
        options: those of the plugin.
        function: file to write the function to.

    Returns:
        Words for the command, the volume's matrix (16 numbers; None for none), and notes on what they leave out.
    """
    shown, view = representation_of(source)
    words: list[str] = []
    notes: list[str] = []
    matrix, shaded = None, False
    if view is not None:
        camera, up, notes = camera_of(view.SMProxy.GetRenderer())
        words += ["--camera", camera, "--up", up]
    if options["Function"]:
        words += ["--tf", options["Function"]]
    if shown is not None:
        volume, more = _volume(shown)
        seen = drawn(volume, source.GetOutputDataObject(0))
        matrix = [volume.GetMatrix().GetElement(k // 4, k % 4) for k in range(16)]
        notes += more + seen.notes + ["clipping planes"] * (seen.mask is not None)
        words += _array(shown)
        if not options["Function"] and volume.GetProperty().GetRGBTransferFunction(0) and shown.ColorArrayName[1]:
            made, more = property_json(volume.GetProperty(), 0, seen.scale)
            notes += more
            shaded = bool(volume.GetProperty().GetShade())
            words += ["--tf", function]
            with open(function, "w", encoding="utf-8") as file:
                json.dump(made, file)
    if "--tf" not in words:
        notes.append("a function, since no view colours the data (chosen from them)")
    if options["Light"]:
        words += ["--light", LIGHTS[options["Light"]]]
    elif shaded:
        lights, more = lights_of(view.SMProxy.GetRenderer())
        notes += more
        words += [word for light in lights for word in ("--light", light)]
    return words, matrix, notes


def _array(shown: Any) -> list[str]:
    """Return the options that choose what a representation is coloured by."""
    where, name = shown.ColorArrayName
    if not name:
        return []
    array = (shown.Input.CellData if where == "CELLS" else shown.Input.PointData)[name]
    if array is None or array.GetNumberOfComponents() == 1:
        return ["--array", name]
    table = shown.LookupTable
    component = "magnitude" if table.VectorMode == "Magnitude" else str(table.VectorComponent)
    return ["--array", name, "--component", component]


def _volume(shown: Any) -> tuple[Any, list[str]]:
    """Return a representation's vtkVolume, and notes; one with the same functions where it draws something else."""
    from vtkmodules.vtkRenderingCore import vtkVolume, vtkVolumeProperty
    from vtkmodules.vtkRenderingVolume import vtkFixedPointVolumeRayCastMapper

    notes: list[str] = []
    composite = shown.SMProxy.GetClientSideObject()
    active: Any = composite.GetActiveRepresentation() if hasattr(composite, "GetActiveRepresentation") else None
    volume = active.GetActor() if hasattr(active, "GetActor") else None
    if getattr(shown, "UseCropping", 0):
        notes.append("cropping")
    if getattr(shown, "UseTransfer2D", 0):
        notes.append("two-dimensional transfer function")
    if getattr(shown, "UseSeparateOpacityArray", 0) or getattr(shown, "MultiComponentsMapping", 0):
        notes.append("opacity by another array")
    blend = str(getattr(shown, "BlendMode", "Composite")).strip("'")
    if blend != "Composite":
        notes.append(f"blending by {blend} (composited instead)")
    if volume is not None and volume.IsA("vtkVolume"):
        return volume, notes
    made, prop = vtkVolume(), vtkVolumeProperty()
    if shown.ColorArrayName[1]:
        prop.SetColor(shown.LookupTable.SMProxy.GetClientSideObject())
        prop.SetScalarOpacity(shown.ScalarOpacityFunction.SMProxy.GetClientSideObject())
    prop.SetScalarOpacityUnitDistance(shown.ScalarOpacityUnitDistance)
    prop.SetInterpolationTypeToLinear()
    made.SetProperty(prop)
    made.SetMapper(vtkFixedPointVolumeRayCastMapper())
    for name in ("Position", "Orientation", "Scale", "Origin"):
        getattr(made, "Set" + name)(*getattr(shown, name))
    return made, notes
