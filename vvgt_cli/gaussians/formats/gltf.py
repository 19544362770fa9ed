"""Binary glTF with KHR_gaussian_splatting: float32 attributes of point meshes, without quantisation.

The data are those of the `.ply`, rotated by 180 degrees about z, to glTF's +y up: means, rotations and harmonics, since
programs turn nodes without their harmonics. The root node, which does not turn, places them in the world in metres,
where that is known. Several clouds are nodes below it, in groups.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.nodes import (
    HALF_TURN,
    ROOT,
    Node,
    common_comments,
    group_names,
    offset_in,
    placed,
    report_off,
)
from vvgt_cli.gaussians.formats.splats import Splats, joined, log_scales_of, opacities_of
from vvgt_cli.gaussians.frames import rotations
from vvgt_cli.gaussians.opacity import logits_of
from vvgt_cli.gaussians.ply import f_dc_to_colors
from vvgt_cli.version import VERSION

EXTENSION, VISIBILITY = "KHR_gaussian_splatting", "KHR_node_visibility"
_KERNEL = {
    "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "sortingMethod": "cameraDistance",
    "projection": "perspective",
}  # fmt: skip
_HIDDEN = {VISIBILITY: {"visible": False}}
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _USHORT, _ARRAY, _POINTS = 5126, 5123, 34962, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_TURN = np.diag([*np.diag(HALF_TURN), 1.0])
_ORDERS = np.array([m for degree in (1, 2, 3) for m in range(-degree, degree + 1)])
_SIGNS = np.where(_ORDERS % 2, -1, 1).astype(np.float32)  # of harmonics, by half a turn about z


def glb(nodes: Sequence[Node], name: str) -> bytes:
    """Encode clouds as a `.glb` with a node each, in groups, below the root, which is a cloud without a name itself."""
    comments, nodes = common_comments(nodes), [replace(node, splats=_turned(node.splats)) for node in nodes]
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"vvgt {VERSION}", "extras": {"comments": list(comments)}},
        "extensionsUsed": [EXTENSION, *([] if all(node.visible for node in nodes) else [VISIBILITY])],
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [_root(comments, name)],
        "meshes": [], "buffers": [], "bufferViews": [], "accessors": [],
    }  # fmt: skip
    arrays: list[np.ndarray] = []
    number: dict[tuple[str, ...], int] = {(): 0}
    for path, group in group_names(nodes).items():
        number[path] = _child(document, number[path[:-1]], {"name": group})
    for node in nodes:
        if not node.name:
            document["nodes"][0]["mesh"] = _mesh(document, arrays, "", node.splats)
            continue
        centre, splats = node.centred()
        own = {"mesh": _mesh(document, arrays, node.name, splats), "name": node.name, "translation": centre.tolist()}
        own |= {"extras": dict(node.facts)} if node.facts else {}
        _child(document, number[node.parents], own if node.visible else own | {"extensions": _HIDDEN})
    size = sum(array.nbytes for array in arrays)
    document["buffers"].append({"byteLength": size})
    head = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    head += b" " * (-len(head) % 4)
    front = struct.pack("<5I", _MAGIC, 2, 12 + 8 + len(head) + 8 + size, len(head), _JSON) + head
    return front + struct.pack("<2I", size, _BINARY) + b"".join(array.tobytes() for array in arrays)


def _root(comments: tuple[str, ...], name: str) -> dict[str, Any]:
    """Return the node that places the turned Gaussians in the world."""
    place = placed(comments, name)
    node: dict[str, Any] = {"name": ROOT}
    if place.world is not None:
        node |= {"translation": place.translation.tolist(), "scale": [place.scale] * 3}
        extras = {"space": place.space, "unit": place.unit, "worldFromScene": place.world.ravel().tolist()}
        node["extras"] = extras  # the matrix is row-major
    return node


def _turned(splats: Splats, back: bool = False) -> Splats:
    """Return the columns rotated by 180 degrees about z, or ``back``, with the same comments."""
    w, x, y, z = splats.quaternions.T if back else -splats.quaternions.T
    signs, turn = _SIGNS[: splats.f_rest.shape[1], None], np.stack([z, y, -x, -w], axis=1)
    return replace(splats, means=splats.means @ HALF_TURN.astype("f4"), quaternions=turn, f_rest=signs * splats.f_rest)


def _fallback(splats: Splats) -> np.ndarray:
    """Return (K, 4) uint16: colours without harmonics, in linear light as glTF has it, and opacities, of 65,535."""
    shown = np.clip(f_dc_to_colors(splats.f_dc), 0, 1)
    light = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    return np.rint(65535 * np.column_stack([light, opacities_of(splats.logits)])).astype("<u2")


def _child(document: dict[str, Any], parent: int, node: dict[str, Any]) -> int:
    """Add a node below another, and return its number."""
    number = len(document["nodes"])
    document["nodes"].append(node)
    document["nodes"][parent].setdefault("children", []).append(number)
    return number


def _mesh(document: dict[str, Any], arrays: list[np.ndarray], name: str, splats: Splats) -> int:
    """Add a mesh and its arrays, and return its number."""
    accessors = document["accessors"]
    columns = {
        "POSITION": splats.means,
        "COLOR_0": _fallback(splats),
        f"{EXTENSION}:ROTATION": splats.quaternions[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.exp(splats.log_scales.astype(np.float64)),
        f"{EXTENSION}:OPACITY": opacities_of(splats.logits)[:, None],
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": splats.f_dc,
    }
    for m in range(splats.f_rest.shape[1]):
        columns[_harmonic(m)] = splats.f_rest[:, m]
    attributes = {attribute: len(accessors) + k for k, attribute in enumerate(columns)}
    bounds = {"min": splats.means.min(axis=0).tolist(), "max": splats.means.max(axis=0).tolist()}
    start = sum(array.nbytes for array in arrays)
    for attribute, column in columns.items():
        packed = attribute == "COLOR_0"
        array = np.ascontiguousarray(column, "<u2" if packed else "<f4")
        accessor = {"bufferView": len(accessors), "count": len(array), "type": _TYPES[array.shape[1]]}
        accessor |= {"componentType": _USHORT, "normalized": True} if packed else {"componentType": _FLOAT}
        accessors.append(accessor | (bounds if attribute == "POSITION" else {}))
        document["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": _ARRAY})
        arrays.append(array)
        start += array.nbytes
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: _KERNEL}}
    document["meshes"].append(({"name": name} if name else {}) | {"primitives": [primitive]})
    return len(document["meshes"]) - 1


def _harmonic(m: int) -> str:
    """Return the attribute of harmonic ``m``, counted from 0 above degree 0."""
    degree = 1 if m < 3 else 2 if m < 8 else 3
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{m - (degree**2 - 1)}"


def read_glb(content: bytes, name: str) -> Splats:
    """Read the columns of a `.glb` that `glb` wrote, all nodes together, or raise DataError."""
    try:
        return _read(content, name)
    except (AttributeError, KeyError, IndexError, TypeError, ValueError, struct.error) as error:
        raise DataError(
            f"{name}: not a .glb of Gaussians ({type(error).__name__}: {error}); expected meshes with {EXTENSION} "
            "in float32, as vvgt writes them"
        ) from None


def _read(content: bytes, name: str) -> Splats:
    magic, _, _, size, kind = struct.unpack_from("<5I", content)
    if (magic, kind) != (_MAGIC, _JSON):
        raise ValueError("no JSON chunk at the beginning")
    document, binary = json.loads(content[20 : 20 + size]), content[28 + size :]
    comments = tuple(str(line).replace("\n", " ") for line in document["asset"].get("extras", {}).get("comments", []))
    found: list[Splats] = []
    roots = document["scenes"][document.get("scene", 0)]["nodes"]
    open_nodes: list[tuple[int, np.ndarray | None, np.ndarray, bool]]
    open_nodes = [(one, None, np.eye(4), True) for one in reversed(roots)]
    off, met = list[str](), 0
    while open_nodes:
        met += 1
        if met > len(document["nodes"]):
            raise ValueError("nodes in a circle, or in several places")
        number, root, above, on = open_nodes.pop()
        node = document["nodes"][number]
        place = above @ _matrix(node)
        root = place if root is None else root
        shown = node.get("extensions", {}).get(VISIBILITY, {}).get("visible", True)
        if not isinstance(shown, bool):
            raise ValueError(f"{VISIBILITY} of node {number}: visible is {shown!r}")
        on = on and shown
        open_nodes += [(child, root, place, on) for child in reversed(node.get("children", []))]
        if "mesh" in node:
            offset = offset_in(root @ _TURN, place @ _TURN, comments, name)
            found.append(_turned(_columns(document, binary, node["mesh"], comments), back=True).moved(offset))
            off += [] if on else [str(node.get("name", number))]
    report_off(name, off)
    return joined(found)


def _columns(document: dict[str, Any], binary: bytes, mesh: int, comments: tuple[str, ...]) -> Splats:
    """Return the Gaussians of a mesh."""
    (primitive,) = document["meshes"][mesh]["primitives"]
    attributes = primitive["attributes"]

    def column(attribute: str, width: int) -> np.ndarray:
        accessor = document["accessors"][attributes[attribute]]
        view = document["bufferViews"][accessor["bufferView"]]
        if accessor["componentType"] != _FLOAT or accessor["type"] != _TYPES[width] or "byteStride" in view:
            raise ValueError(f"{attribute} has type {accessor['componentType']} {accessor['type']}")
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        values = np.frombuffer(binary, "<f4", accessor["count"] * width, start)
        return values.reshape(-1, width) if width > 1 else values

    known = [m for m in range(15) if _harmonic(m) in attributes]
    means, count = column("POSITION", 3), len(column("POSITION", 3))
    f_rest = [column(_harmonic(m), 3) for m in known]
    return Splats(
        means,
        log_scales_of(column(f"{EXTENSION}:SCALE", 3)),
        column(f"{EXTENSION}:ROTATION", 4)[:, [3, 0, 1, 2]],
        logits_of(column(f"{EXTENSION}:OPACITY", 1)),
        column(f"{EXTENSION}:SH_DEGREE_0_COEF_0", 3),
        np.stack(f_rest, axis=1) if f_rest else np.zeros((count, 0, 3), np.float32),
        comments,
    )


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """Return a node's matrix (4, 4), which applies to column vectors."""
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T.astype(np.float64)
    x, y, z, w = node.get("rotation", [0.0, 0.0, 0.0, 1.0])
    result = np.eye(4)
    result[:3, :3] = rotations(np.array([[w, x, y, z]], np.float64))[0] * np.array(node.get("scale", [1.0] * 3))
    result[:3, 3] = node.get("translation", [0.0] * 3)
    return result
