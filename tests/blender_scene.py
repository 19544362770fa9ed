"""Run in Blender's Python (bpy): the add-on as Preferences enable it, on the files of a folder; facts and pictures."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Euler, Matrix, Vector

FOLDER, ADDONS = Path(sys.argv[1]), Path(sys.argv[2])
SIZE = 128


def camera(scene: Any, eye: tuple[float, ...], target: tuple[float, ...], angle: float) -> None:
    made = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(made)
    turn = (Vector(target) - Vector(eye)).to_track_quat("-Z", "Y")
    made.matrix_world = Matrix.LocRotScale(eye, turn, None)
    made.data.angle, made.data.clip_end = np.radians(angle), 1e5
    scene.camera = made
    bpy.context.view_layer.update()


def picture(scene: Any, name: str, samples: int) -> None:
    scene.cycles.samples = samples
    scene.render.filepath = str(FOLDER / name)
    bpy.ops.render.render(write_still=True)


def points(item: Any) -> dict[str, Any]:
    """Places in the world (float64), and the attributes."""
    attributes, found = item.data.attributes, {}
    matrix = np.array(item.matrix_world)
    found["places"] = values(attributes["position"], "vector", 3).astype(float) @ matrix[:3, :3].T + matrix[:3, 3]
    if item.type == "POINTCLOUD":  # Blender's own splats: display colour of degree 0, and opacity
        base = values(attributes["radiance:base"], "vector", 4)
        display = 0.5 + 0.28209479177387814 * base[:, :3]
        linear = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
        return found | {"color": linear, "opacity": base[:, 3:]}
    return found | {key: values(attributes[key], *how) for key, how in
                    {"color": ("color", 4), "opacity": ("value", 1)}.items()}  # fmt: skip


def values(attribute: Any, field: str, width: int) -> np.ndarray:
    """(K, width) float32."""
    found = np.empty(width * len(attribute.data), np.float32)
    attribute.data.foreach_get(field, found)
    return found.reshape(-1, width)


def ramp(item: Any, nodes: list[tuple[float, tuple[float, ...]]], strength: float) -> None:
    """Emission coloured by a ramp of the value, and density in proportion to it, from 0.1 on."""
    made = bpy.data.materials.new("ramped")
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    shader, value, colours, density, out = (
        tree.nodes.new(f"ShaderNode{kind}")
        for kind in ("VolumePrincipled", "Attribute", "ValToRGB", "MapRange", "OutputMaterial")
    )
    value.attribute_name = "fog"
    elements = colours.color_ramp.elements
    for k, (at, colour) in enumerate(nodes):
        element = elements[k] if k < 2 else elements.new(at)
        element.position, element.color = at, (*colour, 1)
    density.inputs["From Min"].default_value, density.inputs["To Max"].default_value = 0.1, strength
    scaled = tree.nodes.new("ShaderNodeMath")
    scaled.operation = "MULTIPLY"
    scaled.inputs[1].default_value = 0.8
    shader.inputs["Color"].default_value = (0, 0, 0, 1)
    for a, b in (
        (value.outputs["Fac"], density.inputs["Value"]), (value.outputs["Fac"], colours.inputs["Fac"]),
        (density.outputs["Result"], shader.inputs["Density"]), (density.outputs["Result"], scaled.inputs[0]),
        (scaled.outputs[0], shader.inputs["Emission Strength"]),
        (colours.outputs["Color"], shader.inputs["Emission Color"]),
        (shader.outputs["Volume"], out.inputs["Volume"]),
    ):  # fmt: skip
        tree.links.new(a, b)
    item.data.materials.append(made)


def main() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.preferences.extensions.repos.new(name="vvgt", module="vvgt", custom_directory=str(ADDONS))
    bpy.ops.preferences.addon_enable(module="bl_ext.vvgt.gaussian_splats")
    addon = sys.modules["bl_ext.vvgt.gaussian_splats"]
    scene = bpy.context.scene
    scene.render.engine, scene.render.film_transparent, scene.render.dither_intensity = "CYCLES", True, 0
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.cycles.pixel_filter_type, scene.cycles.use_denoising = "BOX", False
    views = json.loads((FOLDER / "views.json").read_text())
    for name, view in views.items():
        bpy.ops.import_scene.gaussian_splats(filepath=str(FOLDER / name))
        item = bpy.context.view_layer.objects[-1]
        np.savez(FOLDER / f"{name}.npz", **points(item))
        if view:
            camera(scene, *view)
            picture(scene, f"{name}.png", 16)
        item.hide_render = True
    facts: dict[str, Any] = {"transform": scene.view_settings.view_transform}
    volume = bpy.data.objects.new("cloud", bpy.data.volumes.new("cloud"))
    volume.data.filepath = str(FOLDER / "sphere.vdb")
    scene.collection.objects.link(volume)
    volume.matrix_world = Matrix.LocRotScale((120, -40, 15), Euler((0.3, 0.5, 1.1)), (2, -1, 0.5))
    ramp(volume, [(0.0, (0.8, 0.1, 0.05)), (1.0, (0.02, 0.1, 0.6)), (0.5, (0.1, 0.5, 0.1))], 0.4)
    facts["camera"] = [[195, -100, 60], [120, -40, 15], 40]
    camera(scene, *facts["camera"])
    picture(scene, "volume.png", 64)
    words = ["--max-gaussians", "3000", "--screen", str(SIZE), "--steps", "0"]
    facts["without"] = addon.converted(scene, volume, str(FOLDER / "volume.ply"), words)
    bpy.ops.import_scene.gaussian_splats(filepath=str(FOLDER / "volume.ply"))
    volume.hide_render = True
    np.savez(FOLDER / "volume.ply.npz", **points(bpy.context.view_layer.objects[-1]))
    picture(scene, "volume.ply.png", 64)
    facts["matrix"] = [list(row) for row in volume.matrix_world]
    shader = next(node for node in volume.active_material.node_tree.nodes if node.type == "PRINCIPLED_VOLUME")
    shader.inputs["Color"].default_value = (0.5, 0.5, 0.5, 1)
    shader.inputs["Blackbody Intensity"].default_value = 1
    facts["more"] = addon.volume.Material(volume, ["fog", "surface"]).function(0, 1, volume)[1]
    tree = volume.active_material.node_tree
    tree.links.new(tree.nodes.new("ShaderNodeTexNoise").outputs[0], shader.inputs["Density"])
    bpy.context.view_layer.objects.active = volume
    try:
        bpy.ops.export_scene.gaussian_splats(filepath=str(FOLDER / "refused.ply"))
    except RuntimeError as error:
        facts["refused"] = str(error).strip()
    (FOLDER / "facts.json").write_text(json.dumps(facts))


main()
