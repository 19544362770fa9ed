"""Gaussians in Blender: its own splats from 5.3 on; before, a point each, and nodes that draw it as viewers do."""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

TYPES = {"float": "<f4", "float32": "<f4", "uchar": "u1", "uint8": "u1", "ushort": "<u2", "uint16": "<u2"}
RADIUS = math.sqrt(2 * math.log(255))  # standard deviations, beyond which an opaque Gaussian is below 1/255
NAME = "Gaussian splats"


def read_ply(path: str) -> tuple[dict[str, list[str]], np.ndarray]:
    """Return the facts in a 3DGS `.ply`'s header, words by name, and its rows."""
    with open(path, "rb") as file:
        lines = [file.readline().split()]
        while lines[-1] != [b"end_header"] and lines[0] == [b"ply"] and (line := file.readline()):
            lines.append(line.split())
        words = [[word.decode(errors="replace") for word in line] for line in lines]
        named = [(line[2], TYPES.get(line[1])) for line in words if line[0:1] == ["property"] and len(line) == 3]
        count = [int(line[2]) for line in words if line[:2] == ["element", "vertex"]]
        plain = ["format", "binary_little_endian", "1.0"] in words and {"f_dc_0", "rot_0"} <= dict(named).keys()
        if not plain or None in dict(named).values() or len(count) != 1:
            raise RuntimeError(f"{path}: no binary 3DGS .ply; expected one as vvgt and SuperSplat write it")
        rows = np.fromfile(file, np.dtype(named), count[0])
    if len(rows) != count[0]:
        raise RuntimeError(f"{path}: {len(rows)} of {count[0]} Gaussians; the file is cut off")
    return {line[2]: line[3:] for line in words if line[:2] == ["comment", "vvgt"] and len(line) > 3}, rows


def linear(display: np.ndarray) -> np.ndarray:
    """Return the linear light of sRGB colours, which Blender computes with."""
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def placement(facts: dict[str, list[str]]) -> Matrix:
    """Return the matrix from a file's coordinates to the volume's world, upright (+z).

    A file whose up axis is not the world's z is turned about its centre; files of other programs have PLY -y up.
    """
    upright = Matrix() if facts.get("up") == ["none"] else Matrix.Rotation(-math.pi / 2, 4, "X")
    frame = facts.get("frame", [])
    if frame[:1] != ["unit"] or len(frame) < 7:
        return upright
    return Matrix.LocRotScale(list(map(float, frame[4:7])), upright.to_quaternion(), [1 / float(frame[2])] * 3)


def node(tree: Any, kind: str, *inputs: Any, output: int = 0, **settings: Any) -> Any:
    """Add a node, with values or other nodes' outputs for its first inputs, and return an output."""
    made = tree.nodes.new(kind)
    for key, value in settings.items():
        setattr(made, key, value)
    for socket, value in zip(made.inputs, inputs):  # noqa: B905  # the rest keep their defaults
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, socket)
        elif value is not None:
            socket.default_value = value
    return made.outputs[output]


def material() -> Any:
    """Return the material of all splats: a Gaussian's colour, its opacity by how near the ray comes to its centre."""
    if found := bpy.data.materials.get(NAME):
        return found
    made = bpy.data.materials.new(NAME)
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()

    def maths(operation: str, *inputs: Any) -> Any:
        return node(tree, "ShaderNodeMath", *inputs, operation=operation)

    def dot(*inputs: Any) -> Any:
        return node(tree, "ShaderNodeVectorMath", *inputs, output=1, operation="DOT_PRODUCT")

    place = node(tree, "ShaderNodeTexCoord", output=3)  # object: in standard deviations
    ray = node(tree, "ShaderNodeNewGeometry", output=4)
    ray = node(tree, "ShaderNodeVectorTransform", ray, convert_from="WORLD", convert_to="OBJECT", vector_type="VECTOR")
    ray = node(tree, "ShaderNodeVectorMath", ray, operation="NORMALIZE")
    along = dot(place, ray)
    square = maths("SUBTRACT", maths("MULTIPLY", along, along), dot(place, place))
    own = node(tree, "ShaderNodeAttribute", output=2, attribute_type="INSTANCER", attribute_name="opacity")
    alpha = maths("MINIMUM", maths("MULTIPLY", own, maths("EXPONENT", maths("MULTIPLY", square, 0.5))), 0.99)
    alpha = maths("MULTIPLY", alpha, maths("GREATER_THAN", alpha, 1 / 255))
    front = maths("SUBTRACT", 1.0, node(tree, "ShaderNodeNewGeometry", output=6))
    colour = node(tree, "ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name="color")
    shaders = node(tree, "ShaderNodeBsdfTransparent"), node(tree, "ShaderNodeEmission", colour)
    mixed = node(tree, "ShaderNodeMixShader", maths("MULTIPLY", alpha, front), *shaders)
    tree.links.new(mixed, tree.nodes.new("ShaderNodeOutputMaterial").inputs[0])
    return made


def ellipsoids() -> Any:
    """Return the geometry nodes that put an ellipsoid on each point."""
    if found := bpy.data.node_groups.get(NAME):
        return found
    tree = bpy.data.node_groups.new(NAME, "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    ball = node(tree, "GeometryNodeMeshIcoSphere", 1.03 * RADIUS, 3)  # its faces lie inside of the sphere
    ball = node(tree, "GeometryNodeSetMaterial", ball, None, material())
    turn = node(tree, "GeometryNodeInputNamedAttribute", "rotation", data_type="QUATERNION")
    scale = node(tree, "GeometryNodeInputNamedAttribute", "scale", data_type="FLOAT_VECTOR")
    points = node(tree, "NodeGroupInput")
    placed = node(tree, "GeometryNodeInstanceOnPoints", points, None, ball, None, None, turn, scale)
    tree.links.new(placed, tree.nodes.new("NodeGroupOutput").inputs[0])
    return tree


def add(path: str, name: str) -> tuple[Any, list[str]]:
    """Add the Gaussians of a `.ply` to the scene, and return the object and what is not shown."""
    facts, rows = read_ply(path)
    if "type" in bpy.types.PointCloud.bl_rna.properties:  # Blender 5.3 or newer draws splats itself, with harmonics
        bpy.ops.wm.ply_import(filepath=path, forward_axis="Y", up_axis="Z")
        made = bpy.context.view_layer.objects.active
        made.name, made.matrix_world = name, placement(facts)
        return made, []
    columns = {key: np.stack([rows[f"{key}_{i}"] for i in range(n)], 1) for key, n in
               (("f_dc", 3), ("scale", 3), ("rot", 4))}  # fmt: skip
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(rows))
    mesh.vertices.foreach_set("co", np.stack([rows[key] for key in "xyz"], 1).ravel())
    shown = linear(np.maximum(0.5 + 0.28209479177387814 * columns["f_dc"], 0))
    turn = columns["rot"] / np.linalg.norm(columns["rot"], axis=1, keepdims=True)
    for key, kind, field, values in (
        ("scale", "FLOAT_VECTOR", "vector", np.exp(columns["scale"])), ("rotation", "QUATERNION", "value", turn),
        ("opacity", "FLOAT", "value", 1 / (1 + np.exp(-rows["opacity"]))),
        ("color", "FLOAT_COLOR", "color", np.insert(shown, 3, 1, axis=1)),
    ):  # fmt: skip
        mesh.attributes.new(key, kind, "POINT").data.foreach_set(field, values.astype(np.float32).ravel())
    made = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(made)
    made.matrix_world = placement(facts)
    made.modifiers.new(NAME, "NODES").node_group = ellipsoids()
    harmonics = [key for key in rows.dtype.names or () if key.startswith("f_rest") and rows[key].any()]
    return made, ["colours that depend on the view"] if harmonics else []
