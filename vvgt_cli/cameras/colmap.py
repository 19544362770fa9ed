"""View sets in COLMAP's format, `cameras.bin`, `images.bin` and `points3D.bin`, and points as a `.ply`.

COLMAP has the same conventions as vvgt: world-to-camera poses, OpenCV axes, the upper left pixel's centre at (0.5,
0.5). The layout is that of COLMAP's documentation, "Output Format", binary.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from vvgt_cli.cameras.quaternions import quaternion
from vvgt_cli.cameras.types import Camera

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
    result: np.ndarray = np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)
    return result
