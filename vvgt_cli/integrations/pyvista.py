"""PyVista: the volumes of a plotter as a file of Gaussians, with functions, light and camera (docs/programs.md).

Tried: PyVista 0.49
Enable:
    vvgt.export_plotter(plotter, "page.html")
"""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from typing import Any

from vvgt_cli.conversion.result import Conversion
from vvgt_cli.errors import UsageError
from vvgt_cli.field.layered import OpenedFile
from vvgt_cli.gaussians.header import camera_of as camera_in
from vvgt_cli.integrations.layers import Layer, together
from vvgt_cli.integrations.vtk_property import property_json
from vvgt_cli.integrations.vtk_scene import Drawn, drawn
from vvgt_cli.integrations.vtk_view import camera_of, lights_of, volumes_of
from vvgt_cli.library.inputs import Look, Reading, volume_of
from vvgt_cli.look import LightOptions, read_transfer_function
from vvgt_cli.look.lighting import COEFFICIENTS


def export_plotter(plotter: Any, path: str | os.PathLike[str], *, overwrite: bool = True, **options: Any) -> Conversion:
    """Write the volumes that a pyvista.Plotter shows as Gaussians: functions, light and camera are the plotter's.

    Args:
        plotter: pyvista.Plotter, of whose active subplot visible volumes are taken, several as layers.
        path: the file, as in `Result.save`.
        overwrite: replace an existing file.
        **options: further ones of `convert`, as ``max_gaussians`` and ``live``.

    Returns:
        The conversion, whose file opens at the plotter's camera. One warning names what was not taken.

    Raises:
        DataError, UsageError: see `convert` and `Result.save`; the plotter shows no volume.
    """
    renderer = plotter.renderer
    shown = volumes_of(renderer)
    if not shown:
        raise UsageError("plotter: shows no volume; call plotter.add_volume(...) first")
    layers, notes, shaded = [], _others(renderer), [v.GetProperty() for v in shown if v.GetProperty().GetShade()]
    for volume in shown:
        seen = drawn(volume)
        more, about = _layers(seen, volume.GetProperty())
        layers += more
        notes += seen.notes + about
    lights, unlike = lights_of(renderer) if shaded else (["none"], [])
    if 0 < len(shaded) < len(shown):
        notes.append("volumes without shading beside shaded ones")
    light = LightOptions(tuple(lights))
    if shaded:
        lighting, *others = [read_transfer_function(property_json(one)[0]).lighting for one in shaded]
        light = replace(light, **{name: getattr(lighting, name) for name in COEFFICIENTS})
        if any(getattr(one, name) != getattr(lighting, name) for one in others for name in COEFFICIENTS):
            notes.append("ambient, diffuse, specular and power of other volumes than the first shaded one")
    if not renderer.camera.is_set:  # before anything was drawn; the same happens in show()
        renderer.camera_position = renderer.get_default_cam_pos()
        renderer.ResetCamera()
    camera, up, askew = camera_of(renderer)
    notes += unlike + askew
    if notes:
        warnings.warn(f"not taken from the plotter: {'; '.join(dict.fromkeys(notes))}", stacklevel=2)
    result = together(layers, light, **options)
    result.ply = replace(result.ply, camera=camera_in(camera.split(",")), up=up)
    result.save(path, overwrite=overwrite)
    return result


def _others(renderer: Any) -> list[str]:
    """Return notes on visible surfaces, which are not volumes."""
    actors = renderer.GetActors()
    count = sum(bool(actors.GetItemAsObject(k).GetVisibility()) for k in range(actors.GetNumberOfItems()))
    return [f"{count} surface{'s' * (count > 1)}"] if count else []


def _layers(seen: Drawn, prop: Any) -> tuple[list[Layer], list[str]]:
    """Return a volume's components, or its own colours, each with its function, and notes.

    Raises:
        UsageError: nothing that is drawn, or opacity of another component than that of the colours.
    """
    array = seen.array
    if array is None:
        what = f"a {seen.data.GetClassName()} without an array that its mapper draws"
        raise UsageError(f"plotter: {what}; expected one image, grid or mesh with active scalars")
    count, colored = array.GetNumberOfComponents(), not prop.GetIndependentComponents()
    if count == 2 and colored:
        raise UsageError(f"{array.GetName()}: two dependent components; expected one, independent ones, or colours")
    reading: Reading = {"array": array.GetName()}
    if seen.mask is not None:
        reading["mask"] = seen.mask
    each: list[Reading] = [reading] if count == 1 else [{**reading, "component": k} for k in range(count)]
    parts = [volume_of(seen.data, one) for one in each]
    mixed = count > 1 and colored
    contents = [OpenedFile(tuple(parts), color=True)] if mixed else [OpenedFile((part,)) for part in parts]
    functions = [property_json(prop, k, seen.scale) for k in range(len(contents))]
    notes = [note for _, some in functions for note in some]
    if len(contents) > 1:
        notes.append("mixing of components (by extinction instead)")
    return [(one, Look(read_transfer_function(f))) for one, (f, _) in zip(contents, functions, strict=True)], notes
