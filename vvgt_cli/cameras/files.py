"""View sets in files: nerfstudio's `transforms.json`, and the Blender style that it is derived from.

Matrices in files are OpenGL camera-to-world (+x right, +y up, looking along -z); those of `Camera` are OpenCV
world-to-camera. The world is the unit frame, which is what `vvgt` writes by default.

View sets in COLMAP's format, `cameras.bin`, `images.bin` and `points3D.bin`, and points as a `.ply`.

COLMAP has the same conventions as vvgt: world-to-camera poses, OpenCV axes, the upper left pixel's centre at (0.5,
0.5). The layout is that of COLMAP's documentation, "Output Format", binary.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from vvgt_cli.cameras.types import Camera, quaternion
from vvgt_cli.errors import DataError, naming
from vvgt_cli.files import read_text

OPENGL = np.diag([1.0, -1.0, -1.0])  # camera axes OpenCV <-> OpenGL
MAX_SIDE = 16384  # pixels; 4 GiB of float RGBA
_PINHOLE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def camera_to_opengl(camera: Camera) -> np.ndarray:
    """Return the OpenGL camera-to-world matrix (4, 4) float64 of an OpenCV world-to-camera pose."""
    matrix = np.eye(4)
    matrix[:3, :3] = camera.rotation.T @ OPENGL
    matrix[:3, 3] = camera.position
    return matrix


def opengl_to_pose(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the OpenCV world-to-camera rotation (3, 3) and translation (3,) of an OpenGL camera-to-world matrix."""
    rotation = OPENGL @ matrix[:3, :3].T
    return rotation, -rotation @ matrix[:3, 3]


@dataclass(frozen=True)
class Frame:
    """One view of a view-set file.

    Attributes:
        camera: pose and lens, unit frame.
        file_path: its image as named in the file, in the Blender style without the suffix.
        test: whether the file reserves it for testing (nerfstudio's ``test_filenames``).
    """

    camera: Camera
    file_path: str
    test: bool = False


def transforms_json(
    cameras: Sequence[Camera],
    *,
    ply_file_path: str | None = None,
    paths: Sequence[str] | None = None,
    splits: dict[str, list[str]] | None = None,
) -> str:
    """Return the text of a `transforms.json` for ``cameras``.

    Intrinsics are written once if all cameras share them, else per frame.

    Args:
        cameras: cameras in the order of the frames.
        ply_file_path: initial point cloud (nerfstudio, OpenSplat).
        paths: image paths, by default ``NAME.png`` next to the file.
        splits: nerfstudio's splits: ``{"train": paths, "val": paths, "test": paths}``.
    """
    paths = [f"{camera.name}.png" for camera in cameras] if paths is None else paths
    document: dict[str, Any] = {"camera_model": "OPENCV"}
    if ply_file_path:
        document["ply_file_path"] = ply_file_path
    document.update({f"{split}_filenames": names for split, names in (splits or {}).items()})
    return _document(document, cameras, paths, [_lens_record(camera) for camera in cameras])


def blender_json(cameras: Sequence[Camera], paths: Sequence[str]) -> str:
    """Return the text of a Blender-style `transforms_train.json`, with ``camera_angle_x`` and paths without suffix.

    Sizes and focal lengths are written too, for programs that read them.
    """
    angle = [{"camera_angle_x": 2 * math.atan(c.width / (2 * c.fx))} for c in cameras]
    lenses = [a | _lens_record(camera) for a, camera in zip(angle, cameras, strict=True)]
    return _document({}, cameras, paths, lenses)


def _lens_record(c: Camera) -> dict[str, Any]:
    return {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height}


def _document(
    head: dict[str, Any], cameras: Sequence[Camera], paths: Sequence[str], lenses: Sequence[dict[str, Any]]
) -> str:
    shared = bool(lenses) and all(lens == lenses[0] for lens in lenses)
    document = head | (lenses[0] if shared else {})
    document["frames"] = [
        {"file_path": path, **({} if shared else lens), "transform_matrix": camera_to_opengl(camera).tolist()}
        for camera, path, lens in zip(cameras, paths, lenses, strict=True)
    ]
    return json.dumps(document, indent=1) + "\n"


def read_cameras(path: str | Path, size: int | None = None) -> list[Camera]:
    """Read the cameras of a `transforms.json`; see `read_frames`."""
    return [frame.camera for frame in read_frames(path, size)]


def read_frames(path: str | Path, size: int | None = None) -> list[Frame]:
    """Read the views of a `transforms.json` (nerfstudio or Blender style), in the file's order.

    Args:
        path: the file.
        size: image height in pixels that views are scaled to; required if the file has no ``w`` and ``h``.

    Raises:
        DataError: the file is not JSON or has no frames, a lens has distortion, a pose is not a rigid motion, the image
            size is missing, or two images have the same name.
    """
    name = Path(path).name
    try:
        document = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{name}: not JSON ({error}); expected a transforms.json") from None
    entries = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(entries, list) or not entries:
        raise DataError(f"{name}: no list 'frames'; expected a transforms.json (nerfstudio or Blender style)")
    kept = document.get("test_filenames") or []
    frames: list[Frame] = []
    taken: set[str] = set()
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise DataError(f"{name}: frame {i} is {type(entry).__name__}; expected an object")
        camera = _camera(document | entry, f"{name}: frame {i}", i, size)
        if camera.name in taken:
            raise DataError(f"{name}: frame {i}: a second image named {camera.name!r}; expected one name per view")
        taken.add(camera.name)
        file_path = str(entry.get("file_path", camera.name))
        frames.append(Frame(camera, file_path, isinstance(kept, list) and file_path in kept))
    return frames


def _camera(entry: dict[str, Any], name: str, index: int, size: int | None) -> Camera:
    """Return the camera of one frame, whose entries override the document's."""
    model = str(entry.get("camera_model", "OPENCV"))
    if model not in _PINHOLE:
        raise DataError(f"{name}: camera model {model!r}; expected a pinhole ({', '.join(_PINHOLE)})")
    bent = [key for key in _DISTORTION if entry.get(key)]
    if bent:
        raise DataError(f"{name}: lens distortion ({', '.join(bent)}); expected a pinhole: undistort the images first")
    matrix = _matrix(entry.get("transform_matrix"), name)
    width, height, fx, fy, cx, cy = _lens(entry, name, size)
    stem = PurePosixPath(str(entry.get("file_path", f"view_{index:03d}"))).stem or f"view_{index:03d}"
    if not stem.isprintable() or "\\" in stem:  # it becomes the name of a file
        raise DataError(f"{name}: image {stem!r}; expected a plain file name")
    rotation, translation = opengl_to_pose(matrix)
    with naming(name):
        camera = Camera(rotation, translation, fx, fy, cx, cy, width, height, stem)
    return camera if size is None or size == height else camera.resized(size / height)


def _matrix(value: Any, name: str) -> np.ndarray:
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, (0, 0, 0, 1)])
    if matrix.shape != (4, 4) or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise DataError(f"{name}: 'transform_matrix' is not a 4 x 4 camera-to-world matrix with last row 0 0 0 1")
    return matrix


def _number(entry: dict[str, Any], key: str, name: str) -> float | None:
    value = entry.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise DataError(f"{name}: {key} is {value!r}; expected a number")
    return float(value)


def _lens(entry: dict[str, Any], name: str, size: int | None) -> tuple[int, int, float, float, float, float]:
    """Return width, height, fx, fy, cx, cy in pixels."""
    width, height = _number(entry, "w", name), _number(entry, "h", name)
    if width is None or height is None:
        if size is None:
            raise DataError(f"{name}: no image size 'w' and 'h'; expected both, or --size")
        width = height = float(size)
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise DataError(f"{name}: {width:g} x {height:g} px; expected 1 to {MAX_SIDE} per side")
    fx, fy = _number(entry, "fl_x", name), _number(entry, "fl_y", name)
    angle_x, angle_y = _number(entry, "camera_angle_x", name), _number(entry, "camera_angle_y", name)
    if fx is None and angle_x is not None and 0 < angle_x < math.pi:
        fx = width / (2 * math.tan(angle_x / 2))
    if fy is None and angle_y is not None and 0 < angle_y < math.pi:
        fy = height / (2 * math.tan(angle_y / 2))
    fx, fy = fx or fy, fy or fx
    if fx is None or fy is None:
        raise DataError(f"{name}: no focal length; expected 'fl_x' in pixels, or 'camera_angle_x' in radians")
    cx, cy = _number(entry, "cx", name), _number(entry, "cy", name)
    return (round(width), round(height), fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy)


PINHOLE = 1  # COLMAP's number of the camera model with fx, fy, cx, cy


def colmap_model(
    cameras: Sequence[Camera], names: Sequence[str], points: np.ndarray, colors: np.ndarray
) -> dict[str, bytes]:
    """Return the three files of a COLMAP model by name; the points have empty tracks.

    Args:
        cameras: views; views with the same lens share a COLMAP camera.
        names: image files, relative to COLMAP's folder of images.
        points: (n, 3) positions, unit frame.
        colors: (n, 3) RGB in [0, 1], clipped.
    """
    keys = [(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras]
    numbers = {key: number for number, key in enumerate(dict.fromkeys(keys), 1)}
    intrinsics = [struct.pack("<iiQQ4d", number, PINHOLE, *key) for key, number in numbers.items()]
    images = [
        struct.pack("<i7di", i, *quaternion(camera.rotation), *camera.translation, numbers[key])
        + name.encode() + b"\0" + struct.pack("<Q", 0)
        for i, (camera, key, name) in enumerate(zip(cameras, keys, names, strict=True), 1)
    ]  # fmt: skip
    table = np.zeros(len(points), [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("n", "<u8")])
    table["id"] = np.arange(1, len(points) + 1)
    table["xyz"], table["rgb"] = points, _bytes(colors)
    count = struct.Struct("<Q").pack
    return {
        "cameras.bin": count(len(intrinsics)) + b"".join(intrinsics),
        "images.bin": count(len(images)) + b"".join(images),
        "points3D.bin": count(len(table)) + table.tobytes(),
    }


def point_cloud_ply(points: np.ndarray, colors: np.ndarray) -> bytes:
    """Return a `.ply` point cloud: x y z nx ny nz (float, normals zero) and red green blue (uchar), little-endian.

    In this order, nerfstudio, OpenSplat and the original 3DGS code (which requires normals) can all read it.

    Args:
        points: (n, 3) positions, unit frame.
        colors: (n, 3) RGB in [0, 1], clipped.
    """
    table = np.zeros(len(points), [("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    table["xyz"], table["rgb"] = points, _bytes(colors)
    properties = [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *properties, "end_header", ""]
    return "\n".join(header).encode() + table.tobytes()


def _bytes(colors: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)
