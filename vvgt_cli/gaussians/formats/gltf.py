"""Binary glTF with KHR_gaussian_splatting: float32 attributes of a point mesh, without quantisation.

The data are those of the `.ply`, in its axes. The node rotates them by 180 degrees about z, to glTF's +y up, and places
them in the world in metres, where that is known.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.metres import placed, same_place
from vvgt_cli.gaussians.formats.splats import Splats, logits_of, opacities_of
from vvgt_cli.gaussians.frames import rotations
from vvgt_cli.version import VERSION

EXTENSION = "KHR_gaussian_splatting"
_KERNEL = {
    "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "sortingMethod": "cameraDistance",
    "projection": "perspective",
}  # fmt: skip
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _ARRAY, _POINTS = 5126, 34962, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_HALF_TURN = [0.0, 0.0, 1.0, 0.0]  # about z, (x, y, z, w)


def glb(splats: Splats, name: str) -> bytes:
    """Encode columns as a `.glb`."""
    columns = {
        "POSITION": splats.means,
        f"{EXTENSION}:ROTATION": splats.quaternions[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.exp(splats.log_scales.astype(np.float64)),
        f"{EXTENSION}:OPACITY": opacities_of(splats.logits)[:, None],
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": splats.f_dc,
    }
    for m in range(splats.f_rest.shape[1]):
        columns[_harmonic(m)] = splats.f_rest[:, m]
    arrays = [np.ascontiguousarray(column, "<f4") for column in columns.values()]
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    start = 0
    for array in arrays:
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": _ARRAY})
        view, kind = len(accessors), _TYPES[array.shape[1]]
        accessors.append({"bufferView": view, "componentType": _FLOAT, "count": len(array), "type": kind})
        start += array.nbytes
    accessors[0] |= {"min": splats.means.min(axis=0).tolist(), "max": splats.means.max(axis=0).tolist()}
    attributes = {attribute: k for k, attribute in enumerate(columns)}
    place = placed(splats.comments, name)
    node: dict[str, Any] = {"mesh": 0, "rotation": _HALF_TURN}
    if place.world is not None:
        node |= {"translation": place.translation.tolist(), "scale": [place.scale] * 3}
        extras = {"space": place.space, "unit": place.unit, "worldFromScene": place.world.ravel().tolist()}
        node["extras"] = extras  # the matrix is row-major
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: _KERNEL}}
    document = {
        "asset": {"version": "2.0", "generator": f"vvgt {VERSION}", "extras": {"comments": list(splats.comments)}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": accessors,
    }
    head = json.dumps(document, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    length = 12 + 8 + len(head) + 8 + start
    front = struct.pack("<5I", _MAGIC, 2, length, len(head), _JSON) + head + struct.pack("<2I", start, _BINARY)
    return front + b"".join(array.tobytes() for array in arrays)


def _harmonic(m: int) -> str:
    """Return the attribute of harmonic ``m``, counted from 0 above degree 0."""
    degree = 1 if m < 3 else 2 if m < 8 else 3
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{m - (degree**2 - 1)}"


def read_glb(content: bytes, name: str) -> Splats:
    """Read the columns of a `.glb` as written by `glb`: one mesh, float32.

    Raises:
        DataError: the file is not such a `.glb`.
    """
    try:
        return _read(content, name)
    except (KeyError, IndexError, TypeError, ValueError, struct.error) as error:
        raise DataError(
            f"{name}: not a .glb of Gaussians ({type(error).__name__}: {error}); expected one mesh with {EXTENSION} "
            "in float32, as vvgt writes it"
        ) from None


def _read(content: bytes, name: str) -> Splats:
    magic, _, _, size, kind = struct.unpack_from("<5I", content)
    if (magic, kind) != (_MAGIC, _JSON):
        raise ValueError("no JSON chunk at the beginning")
    document, binary = json.loads(content[20 : 20 + size]), content[28 + size :]
    attributes = document["meshes"][0]["primitives"][0]["attributes"]

    def column(attribute: str, width: int) -> np.ndarray:
        accessor = document["accessors"][attributes[attribute]]
        view = document["bufferViews"][accessor["bufferView"]]
        if accessor["componentType"] != _FLOAT or accessor["type"] != _TYPES[width] or "byteStride" in view:
            raise ValueError(f"{attribute} has type {accessor['componentType']} {accessor['type']}")
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        values = np.frombuffer(binary, "<f4", accessor["count"] * width, start)
        return values.reshape(-1, width) if width > 1 else values

    comments = tuple(str(line).replace("\n", " ") for line in document["asset"].get("extras", {}).get("comments", []))
    (node,) = document["nodes"]
    same_place(_matrix(node), comments, name)
    known = [m for m in range(15) if _harmonic(m) in attributes]
    means, count = column("POSITION", 3), len(column("POSITION", 3))
    f_rest = [column(_harmonic(m), 3) for m in known]
    with np.errstate(divide="ignore"):
        log_scales = np.log(column(f"{EXTENSION}:SCALE", 3).astype(np.float64))
    return Splats(
        means,
        np.maximum(log_scales, -80).astype(np.float32),
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
