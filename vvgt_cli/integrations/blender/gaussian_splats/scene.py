"""A Volume object's grids as they stand in the scene, and the scene's camera, for ``vvgt``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector


def saved(item: Any, path: Path) -> list[str]:
    """Save the evaluated grids of a Volume object, of this frame, placed in the world, and return their names.

    Raises:
        RuntimeError: Blender cannot load or save them.
    """
    tree = bpy.data.node_groups.new("vvgt", "GeometryNodeTree")
    holder = bpy.data.objects.new("vvgt", bpy.data.volumes.new("vvgt"))
    try:
        tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
        source = tree.nodes.new("GeometryNodeObjectInfo")
        source.transform_space = "RELATIVE"  # to the holder, which is at the world's origin
        source.inputs["Object"].default_value = item
        tree.links.new(source.outputs["Geometry"], tree.nodes.new("NodeGroupOutput").inputs[0])
        bpy.context.scene.collection.objects.link(holder)
        holder.modifiers.new("vvgt", "NODES").node_group = tree
        grids = holder.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.grids
        if not grids.load() or not len(grids) or not grids.save(str(path)):
            raise RuntimeError(f"{item.name}: {item.data.grids.error_message or 'no grid'}; expected an OpenVDB volume")
        return [grid.name for grid in grids]
    finally:
        bpy.data.volumes.remove(holder.data)  # and the holder
        bpy.data.node_groups.remove(tree)


def camera_words(scene: Any, centre: Any) -> tuple[list[str], list[str]]:
    """Return the options that open a page at the scene's camera, looking to the depth of a point, and notes."""
    camera = scene.camera
    if camera is None or camera.data.type != "PERSP":
        return [], [f"camera ({camera.data.type.lower()})"] if camera else []
    eye, ahead = camera.matrix_world.translation, camera.matrix_world.to_3x3() @ Vector((0, 0, -1))
    top, bottom = camera.data.view_frame(scene=scene)[:2]
    target = eye + ahead * max((centre - eye).dot(ahead), 1e-3)
    angle = math.degrees(2 * math.atan(abs((top.y - bottom.y) / (2 * top.z))))
    right, up = (camera.matrix_world.col[k].normalized().z for k in (0, 1))
    roll, shift = abs(right) > 1e-3 or up < 1e-3, camera.data.shift_x or camera.data.shift_y
    notes = [note for note, found in (("the camera's roll", roll), ("the camera's shift", shift)) if found]
    return ["--camera", ",".join(f"{n:.9g}" for n in (*eye, *target, angle))], notes
